"""`slipstream train bc`: presets, spaces, a run and its resumption."""

import contextlib
import dataclasses
import functools
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from actors.policy import find_policy, read_policy
from actors.rows import row_spec
from launch.budget import BudgetConfig, ReportConfig, ScenesConfig
from launch.cloning import count_rows, dealt
from launch.config import (
    CLONING_PRESETS,
    ExperimentConfig,
    decode_run,
    paper_cloning,
    read_run,
    row_spec_of,
    with_filled_replay,
    with_space,
)
from launch.errors import LaunchError
from launch.main import main
from launch.placement import Placement, roles_of
from launch.progress import CLONING_COLUMNS
from launch.train import TrainConfig, prepare
from launch.train_bc import TrainBcConfig, clone_serially, prepare_cloning
from learner.curves import read_curves
from replay.local import LocalReplay
from sim.bank import open_bank
from sim.dynamics import ActionSpace


def test_the_papers_constants():
    """Appendix A.2."""
    config = paper_cloning()
    cloning = config.cloning
    assert (cloning.mixture, cloning.learning_rate, cloning.batch_size) == (
        10,
        1e-4,
        256,
    )
    assert (config.network.mlp_layers, config.network.mlp_width) == (4, 128)
    assert cloning.max_gradient_norm == cloning.average_updates == 0
    assert config.straying.share == 0


@pytest.mark.parametrize(
    ("space", "grid", "mixture"),
    [
        ("bicycle", ActionSpace.BICYCLE, 10),
        ("delta", ActionSpace.DELTA, 10),
        ("bicycle-discrete", ActionSpace.BICYCLE, 0),
        ("delta-discrete", ActionSpace.DELTA, 0),
    ],
)
def test_a_space_sets_the_grid_and_the_mixture(space, grid, mixture):
    for preset in CLONING_PRESETS.values():
        config = with_space(preset(), space)
        assert config.environment.action.space == grid
        assert config.cloning.mixture == mixture
        assert with_space(with_space(preset(), "delta-discrete"), space) == config


def test_an_unknown_preset_is_refused(capsys):
    assert main(["train", "bc", "--preset", "none"]) == 2
    assert "choose one of quick, laptop, paper" in capsys.readouterr().err


def tiny(**changes) -> ExperimentConfig:
    """A run of seconds."""
    config = with_space(CLONING_PRESETS["quick"](), "delta")
    network = dataclasses.replace(config.network, width=16, latents=2, mlp_width=16)
    return dataclasses.replace(
        config,
        network=network,
        scenes=ScenesConfig(train=3, held_out=2),
        # A checkpoint after every update, of which few are judged.
        report=ReportConfig(tensorboard=False, curves_s=0.01, checkpoint_s=0.0),
        **changes,
    )


def options(folder: Path, **changes) -> TrainBcConfig:
    return TrainBcConfig(space="delta", run=folder, **changes)


def test_the_replay_is_filled_once_and_then_drawn_without_bound() -> None:
    """At the border: the limiter of a real table of 100 rows."""
    config = with_filled_replay(tiny(), 100)
    replay = LocalReplay(spec=row_spec(3, 3), config=config.replay, seed=0)
    rows = np.zeros(60, row_spec(3, 3).dtype)
    replay.insert(rows)
    assert not replay.may_sample(1)
    replay.insert(rows[:39])
    assert not replay.may_sample(1)
    replay.insert(rows[:1])
    for _ in range(20):
        assert replay.may_sample(4096)
        replay.sample(4096)
    # A pass that is made again is let in, and leaves the newest 100.
    rows["serial"] = np.arange(60)
    assert replay.may_insert(60)
    replay.insert(rows)
    replay.insert(rows[:40])
    assert replay.size == 100
    assert np.unique(replay.sample(4096).rows["serial"]).tolist() == list(range(60))


def test_a_shard_has_room_for_its_part_of_the_pass_and_no_more() -> None:
    """A pass that is made again pushes out whatever is left of the one before."""
    config = with_filled_replay(tiny(), 101).replay
    for shards in (1, 2, 3, 7, 101):
        parts = dealt(np.arange(101), shards)
        rooms = {n: config.part_of(shards, n).capacity for n in range(shards)}
        assert rooms == {n: len(part) for n, part in parts.items()}


def test_a_run_of_one_kind_is_not_resumed_as_the_other(tmp_path: Path) -> None:
    folder, run = prepare_cloning(options(tmp_path / "run", config=tiny()))
    assert (run.algorithm, run.mixture) == ("bc", 10)
    assert decode_run((folder / "config.json").read_bytes(), where="x") == run
    assert run.config.replay.capacity == count_rows(
        run, open_bank(folder / "scenes" / "train.bank")
    )
    assert row_spec_of(run).dtype["continuous"].shape == (3,)
    with pytest.raises(LaunchError, match="slipstream train bc --resume"):
        prepare(TrainConfig(run=folder, resume=True, config=tiny()))
    with pytest.raises(LaunchError, match="clones --objects vehicles"):
        again = options(folder, config=tiny(), resume=True, objects="sdc")
        prepare_cloning(again)
    names = {role.name for role in roles_of(folder, run, 1, Placement())}
    assert names == {"replay", "learner", "filler", "evaluator"}


@pytest.mark.slow
def test_a_run_goes_on_where_it_ended(tmp_path: Path) -> None:
    """In one process."""
    begun = options(tmp_path / "run", config=tiny(budget=BudgetConfig(updates=20)))
    folder, run = prepare_cloning(begun)
    clone_serially(folder, run)
    first = read_policy(folder)
    assert find_policy(folder).parent.parent == folder / "best"
    assert (first.mixture, first.actions) == (10, 70)
    longer = tiny(budget=BudgetConfig(updates=60))
    _, run = prepare_cloning(options(folder, config=longer, resume=True))
    clone_serially(folder, run)
    curves = read_curves(folder / "curves.csv")
    assert set(CLONING_COLUMNS) <= set(curves)
    assert (np.diff(curves["updates"]) >= 0).all()
    assert curves["updates"][-1] == 60
    judged = read_curves(folder / "evaluation.csv")
    assert {20, 60} <= set(judged["updates"])
    assert judged["updates"][-1] == 60  # whenever the one before was judged
    assert judged["log_likelihood"][-1] > judged["log_likelihood"][0]


PATIENCE_S = 240.0


def wait_for(process: psutil.Popen, condition: Callable[[], Any], what: str) -> Any:
    """Waits for something true while the run is alive."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := condition()):
        assert process.poll() is None, f"the run ended before {what}"
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.05)
    return value


def role(process: psutil.Popen, name: str) -> psutil.Process | None:
    """The process of a role, by its command line."""
    for child in process.children():
        with contextlib.suppress(psutil.Error):  # of one just killed
            if name in child.cmdline():
                return child
    return None


@pytest.mark.slow
def test_every_process_may_be_killed(tmp_path: Path) -> None:
    """As a user starts it: what is killed comes back, and the run ends well."""
    folder = tmp_path / "run"
    words = (
        *("--scenes.train", "3", "--scenes.held-out", "2"),
        *("--network.width", "16", "--network.latents", "2"),
        *("--report.checkpoint-s", "0.5", "--evaluator.seconds", "0"),
        *("--cloning.torch-threads", "1", "--cloning.batch-size", "16"),
        *("--budget.minutes", "0", "--budget.updates", "2000"),
    )
    process = psutil.Popen(
        [sys.executable, "-m", "launch", "train", "bc", "--run", folder, *words],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
    )

    def updates() -> int:
        latest = folder / "checkpoints" / "latest"
        return int(latest.read_text()) if latest.exists() else 0

    def judged() -> list[float]:
        path = folder / "evaluation.csv"
        return list(read_curves(path)["updates"]) if path.exists() else []

    wait = functools.partial(wait_for, process)
    try:
        wait(lambda: updates() > 0, "a checkpoint")
        # Before anything was judged: a slow evaluator may be left behind by the run.
        for name in ("replay", "filler", "evaluator", "learner"):
            wait(functools.partial(role, process, name), name).kill()
        seen = updates()
        wait(lambda: updates() > seen, "the learner's return")
        assert process.wait(PATIENCE_S) == 0
    finally:
        with contextlib.suppress(psutil.Error):
            process.kill()
        process.wait()
    status = json.loads((folder / "status.json").read_text())
    assert set(status["restarts"].values()) == {1}
    assert status["replay"]["size"] == read_run(folder).config.replay.capacity
    steps = judged()
    assert steps == sorted(set(steps)) and steps[-1] == updates() == 2000
    assert json.loads((folder / "evaluation.json").read_text())["agents"]
    best = json.loads((find_policy(folder).parent / "judged.json").read_text())
    known = read_curves(folder / "evaluation.csv")
    assert best["failure_rate"] == known["failure_rate"].min()
