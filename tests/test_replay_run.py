"""A whole durable run with real processes: its replay killed, then the run resumed."""

import contextlib
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.rows import row_spec
from launch.config import read_run
from launch.join import REPLAY
from replay.client import fetch_rows, fetch_stats
from replay.keys import RunKeys
from replay.session import open_session
from replay.spec import ReplayError
from tests.test_run import role_of, training, wait_for

pytestmark = pytest.mark.slow


def stats_of(session: Any, keys: RunKeys) -> dict[str, Any]:
    with contextlib.suppress(ReplayError):
        return fetch_stats(session, keys, timeout=1.0)
    return {}


def test_a_killed_replay_comes_back_and_a_resumed_run_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    endpoint = folder / "endpoint.json"
    told: dict[str, Any] = {}
    with training(folder, "--durable", "--budget.updates", "1500") as process:
        wait_for(endpoint.exists, "the run's endpoint", process)
        place = json.loads(endpoint.read_text())
        keys = RunKeys(place["run_id"])
        spec = row_spec(read_run(folder).config.environment.observation.history)
        with open_session(connect=place["connect"], timeout_s=60) as session:
            wait_for(
                lambda: stats_of(session, keys).get("samples", 0) > 6400,
                "samples",
                process,
            )
            before = stats_of(session, keys)
            replay = role_of(process, "replay")
            assert replay is not None
            replay.send_signal(signal.SIGKILL)
            wait_for(
                lambda: (
                    stats_of(session, keys).get("incarnation", before["incarnation"])
                    != before["incarnation"]
                ),
                "the replay's return",
                process,
            )
            after = wait_for(lambda: stats_of(session, keys), "counters", process)
            assert after["recovered"] >= before["size"]
            assert after["inserts"] >= before["inserts"]
            assert after["samples"] >= before["samples"]
            pages = list(fetch_rows(session=session, keys=keys, spec=spec))
    serials = [p.rows["serial"][p.rows["actor"] == 0] for p in pages]
    kept = np.concatenate(serials)
    np.testing.assert_array_equal(kept, np.arange(len(kept)))  # one life, no hole
    assert (folder / REPLAY / "0" / "meta.json").exists()
    meta = sorted((folder / "checkpoints").glob("*/meta.json"))[-1]
    saved = json.loads(meta.read_text())["extra"]["replay"]
    assert saved["inserts"] > 0
    with training(folder, "--resume", "--budget.updates", "2000") as process:
        wait_for(endpoint.exists, "the run's endpoint", process)
        place = json.loads(endpoint.read_text())
        with open_session(connect=place["connect"], timeout_s=60) as session:
            told = wait_for(lambda: stats_of(session, keys), "counters", process)
    assert told["recovered"] == min(told["capacity"], told["recovered"]) > 0
    assert told["inserts"] >= saved["inserts"]
    assert told["samples"] >= saved["samples"]
