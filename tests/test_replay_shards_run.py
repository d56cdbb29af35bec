"""A whole run with two shards and real processes, one of them killed."""

import json
import signal
from pathlib import Path

import pytest

from tests.test_run import role_of, training, wait_for

pytestmark = pytest.mark.slow


def test_a_run_of_two_shards_goes_on_when_one_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    log = folder / "logs" / "learner.log"

    def said(line: str) -> int:
        return log.read_text().count(line) if log.exists() else 0

    words = ("--shards", "2", "--evaluator.scenes", "0", "--budget.updates", "600")
    with training(folder, *words) as process:
        wait_for(lambda: said("replay shard 1 joined"), "both shards", process)
        wait_for(
            lambda: list((folder / "checkpoints").glob("*/meta.json")),
            "updates",
            process,
        )
        shard = role_of(process, "replay-1")
        assert shard is not None
        shard.send_signal(signal.SIGKILL)
        wait_for(lambda: said("replay shard 1 left"), "its leaving", process)
        wait_for(lambda: said("replay shard 1 joined") == 2, "its return", process)
    status = json.loads((folder / "status.json").read_text())
    assert status["outcome"] == "finished"
    assert status["updates"] == 600
    assert set(status["shards"]) == {"0", "1"}
    assert status["restarts"]["replay-1"] == 1
    assert all(told["samples"] > 0 for told in status["shards"].values())
