"""Whole runs with real processes: each role can be killed and nothing is lost."""

import contextlib
import dataclasses
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from actors.rows import row_spec
from launch.budget import BudgetConfig
from launch.config import (
    quick,
    read_run,
)
from launch.join import free_port
from replay.client import fetch_rows, fetch_stats
from replay.keys import RunKeys
from replay.session import open_session

pytestmark = pytest.mark.slow
PATIENCE_S = 240.0
SMALL = (
    *("--scenes.train", "4", "--scenes.held-out", "2"),
    *("--network.width", "16", "--network.latents", "2"),
    *("--actor.environments", "4", "--replay.min-size", "500"),
    *("--report.checkpoint-s", "1", "--budget.minutes", "0"),
)


def command(*words: object) -> list[str]:
    """The command line as a process."""
    return [sys.executable, "-m", "launch", *map(str, words)]


def wait_for(condition: Callable[[], Any], what: str, process: psutil.Popen) -> Any:
    """Waits for something true while the run is alive."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert process.poll() is None, f"the run ended before {what}"
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.05)
    return value


def role_of(process: psutil.Popen, name: str) -> psutil.Process | None:
    """The process of a role, by its command line."""
    words = name.split("-")
    for child in process.children():
        with contextlib.suppress(psutil.Error):
            line = child.cmdline()
            if words[0] in line and (len(words) == 1 or line[-1] == words[1]):
                return child
    return None


@contextlib.contextmanager
def training(folder: Path, *words: object) -> Iterator[psutil.Popen]:
    """A run as a user starts it; nothing of it is left afterwards."""
    log = (folder.parent / f"{folder.name}.out").open("w")
    process = psutil.Popen(
        command("train", "dqn", "--run", folder, *SMALL, *words),
        stdout=log,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )
    children: list[psutil.Process] = []
    try:
        yield process
        assert process.wait(PATIENCE_S) == 0, (folder.parent / log.name).read_text()
    finally:
        with contextlib.suppress(psutil.Error):
            children = process.children(recursive=True)
            process.kill()
        process.wait()
        _, alive = psutil.wait_procs(children, timeout=20)
        log.close()
        assert not alive


def lives(serials: np.ndarray) -> list[np.ndarray]:
    """An actor's rows cut where a process of it began anew, at serial 0."""
    starts = np.flatnonzero(serials == 0)
    return np.split(serials, starts[1:])


def test_killed_roles_come_back_and_no_row_is_lost_or_doubled(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with training(folder, "--budget.updates", "4000") as process:
        endpoint = wait_for(
            lambda: (
                (folder / "endpoint.json").exists()
                and json.loads((folder / "endpoint.json").read_text())
            ),
            "the run's endpoint",
            process,
        )
        keys = RunKeys(endpoint["run_id"])
        spec = row_spec(read_run(folder).config.environment.observation.history)
        with open_session(connect=endpoint["connect"], timeout_s=60) as session:

            def rows_of(actor: int) -> int:
                with contextlib.suppress(Exception):
                    writers = fetch_stats(session, keys, timeout=1.0)["writers"]
                    return sum(w["rows"] for w in writers if w["writer"] == actor)
                return 0

            wait_for(lambda: rows_of(0) > 200, "rows of an actor", process)
            first = role_of(process, "actor-0")
            assert first is not None
            first.send_signal(signal.SIGKILL)
            before = rows_of(0)
            wait_for(lambda: rows_of(0) > before + 200, "the actor's return", process)

            checkpoints = folder / "checkpoints"
            wait_for(
                lambda: (
                    (checkpoints / "latest").exists()
                    and int((checkpoints / "latest").read_text()) > 0
                ),
                "a checkpoint",
                process,
            )
            learner = role_of(process, "learner")
            assert learner is not None
            learner.send_signal(signal.SIGKILL)
            resumed_from = int((checkpoints / "latest").read_text())
            pages = []
            seen = rows_of(1)
            wait_for(
                lambda: rows_of(1) > seen + 1000 or (folder / "status.json").exists(),
                "the learner's return",
                process,
            )
            for page in fetch_rows(session=session, keys=keys, spec=spec):
                pages.append(page)
    rows = np.concatenate([page.rows for page in pages])
    ids = np.concatenate([page.ids for page in pages])
    assert (ids == np.arange(len(ids))).all()  # nothing was pushed out yet
    for actor, starts in ((0, 2), (1, 1)):
        parts = lives(rows["serial"][rows["actor"] == actor])
        assert len(parts) == starts
        for serials in parts:
            # Each row exactly once, in the order in which it was lived through.
            assert (serials == np.arange(len(serials))).all()
    status = json.loads((folder / "status.json").read_text())
    assert status["outcome"] == "finished"
    assert status["restarts"]["actor-0"] == 1
    assert status["restarts"]["learner"] == 1
    assert int((checkpoints / "latest").read_text()) == 4000 > resumed_from
    assert status["updates"] == 4000
    curve = np.loadtxt(folder / "curves.csv", delimiter=",", skiprows=1, usecols=0)
    assert (np.diff(curve) > 0).all()
    assert not (folder / "endpoint.json").exists()


def test_a_run_ends_with_scores_and_a_recording(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with training(folder, "--budget.updates", "1200"):
        pass
    agents = json.loads((folder / "evaluation.json").read_text())["agents"]
    assert [agent["agent"] for agent in agents] == [
        *("trained", "untrained", "random", "constant-speed", "idm", "expert")
    ]
    assert agents[-1]["failure_rate"] == 0.0
    assert (folder / "evaluation.rrd").stat().st_size > 10_000
    assert (folder / "curves.png").stat().st_size > 10_000
    status = json.loads((folder / "status.json").read_text())
    # Until the replay holds 500 rows nothing is sampled; from then on, 4 of each.
    replay = status["replay"]
    ratio = replay["samples"] / (replay["inserts"] - replay["min_size"])
    assert status["configured_samples_per_insert"] == quick().replay.samples_per_insert
    assert ratio == pytest.approx(quick().replay.samples_per_insert, rel=0.02)


def test_ctrl_c_stops_a_run_and_it_can_be_resumed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = command("train", "dqn", "--run", folder, *SMALL)
    process = psutil.Popen(
        words,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        # A shell's background job has Ctrl-C ignored, and its children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    latest = folder / "checkpoints" / "latest"
    wait_for(
        lambda: latest.exists() and int(latest.read_text()) > 0, "a checkpoint", process
    )
    children = process.children(recursive=True)
    assert len(children) == 6  # replay, learner, two actors, evaluator, the reaper
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE_S) == 130
    assert not psutil.wait_procs(children, timeout=20)[1]
    reached = int(latest.read_text())
    assert reached > 0
    with training(folder, "--resume", "--budget.updates", str(reached + 200)):
        pass
    assert int(latest.read_text()) == reached + 200


def test_an_actor_without_the_folder_fetches_it(tmp_path: Path) -> None:
    """As on another machine: the configuration and the bank come over Zenoh."""
    folder = tmp_path / "run"
    few = ("--budget.updates", "5")
    subprocess.run(
        command("train", "dqn", "--run", folder, *SMALL, "--serial", *few), check=True
    )
    run = read_run(folder)
    longer = dataclasses.replace(run.config, budget=BudgetConfig(updates=10**6))
    dataclasses.replace(run, config=longer).write(folder)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    names = ("--run-id", run.run_id)
    processes = [
        psutil.Popen(command(*words), env=environment, start_new_session=True)
        for words in (
            ("replay", *names, "--listen", endpoint, "--run", folder),
            ("learner", *names, "--connect", endpoint, "--run", folder),
            ("actor", *names, "--connect", endpoint, "--actor", "1"),
        )
    ]
    try:
        with open_session(connect=[endpoint], timeout_s=60) as session:
            keys = RunKeys(run.run_id)

            def inserted() -> bool:
                with contextlib.suppress(Exception):
                    return bool(fetch_stats(session, keys, timeout=1.0)["inserts"] > 0)
                return False

            wait_for(inserted, "rows of the actor", processes[2])
        banks = list((tmp_path / "cache" / "slipstream" / "banks").iterdir())
        assert [path.name for path in banks] == [f"{run.train_hash}.bank"]
        processes[2].send_signal(signal.SIGTERM)
        assert processes[2].wait(30) == 128 + signal.SIGTERM
    finally:
        for process in processes:
            with contextlib.suppress(psutil.Error):
                process.kill()
            process.wait()


def test_the_same_seed_gives_the_same_losses(tmp_path: Path) -> None:
    """Serial mode, twice, and once with another seed."""
    losses = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        code = (
            "import sys, json, itertools; from pathlib import Path;"
            "from launch.config import quick, with_environments;"
            "from launch.learning import make_learner;"
            "from launch.roles import ActorStatus;"
            "from launch.serial import serial_steps;"
            "from launch.scenes import write_procedural; import dataclasses;"
            f"bank = write_procedural(Path({str(tmp_path / name)!r}), count=2, seed=0);"
            f"config = dataclasses.replace(quick(), seed={seed});"
            "steps = serial_steps(config, bank.bank, make_learner(config),"
            " ActorStatus.begin());"
            "print(json.dumps([step.result.loss for step, _ in"
            " itertools.islice(steps, 40)]))"
        )
        ran = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        losses.append(json.loads(ran.stdout))
    assert losses[0] == losses[1]
    assert losses[0] != losses[2]
    assert len(set(itertools.chain(losses[0]))) > 30
