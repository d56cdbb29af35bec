"""A durable run goes on with its replay, and refuses what it cannot go on with."""

import dataclasses
import itertools
from pathlib import Path

import pytest

from launch.budget import BudgetConfig
from launch.config import (
    ExperimentConfig,
    paper,
    quick,
)
from launch.join import REPLAY, SCENES, TRAIN
from launch.learning import make_learner
from launch.roles import ActorStatus
from launch.scenes import write_procedural
from launch.serial import serial_replay, serial_steps, synced
from launch.train import TrainConfig, prepare, resolved
from replay.client import fetch_stats, sync_replay
from replay.local import ReplayConfig
from tests.replay_durable_parts import CHECKED, LOADED
from tests.replay_parts import KEYS, OPEN, service


def small() -> ExperimentConfig:
    config = quick()
    return dataclasses.replace(
        config,
        replay=ReplayConfig(
            capacity=2000,
            min_size=200,
            samples_per_insert=4.0,
            tolerance=1.0,
            durable=True,
            sampler="uniform",
        ),
        budget=BudgetConfig(updates=10),
    )


def test_the_paper_preset_is_durable_and_a_flag_makes_any_run_so() -> None:
    assert paper().replay.durable
    assert not quick().replay.durable
    assert resolved(TrainConfig(durable=True)).replay.durable


def test_a_resumed_run_stays_durable(tmp_path: Path) -> None:
    first = TrainConfig(
        run=tmp_path / "run", durable=True, config=small(), scenes=("procedural",)
    )
    config = dataclasses.replace(
        first.config,
        scenes=dataclasses.replace(first.config.scenes, train=2, held_out=1),
    )
    first = dataclasses.replace(first, config=config)
    prepare(first)
    again = dataclasses.replace(
        first,
        durable=False,
        resume=True,
        config=dataclasses.replace(config, replay=quick().replay),
    )
    _, run = prepare(again)
    assert run.config.replay.durable


@pytest.mark.slow
def test_a_serial_run_goes_on_with_rows_counters_and_versions(tmp_path: Path) -> None:
    config = small()
    bank = write_procedural(tmp_path / SCENES / TRAIN, count=2, seed=0).bank
    folder = tmp_path / REPLAY
    learner = make_learner(config)
    replay = serial_replay(config, folder)
    steps = serial_steps(config, bank, learner, ActorStatus.begin(), replay)
    for _ in itertools.islice(steps, 12):
        pass
    before = synced(replay)
    kept = replay.table.read(0, 2000)
    versions = replay.sample(64).rows["weights_version"].max()
    replay.close()
    replay = serial_replay(config, folder)
    assert synced(replay) == before | {"samples": before["samples"] + 64}
    for old, new in zip(kept, replay.table.read(0, 2000), strict=True):
        assert (old == new).all()
    steps = serial_steps(config, bank, learner, ActorStatus.begin(), replay)
    for _ in itertools.islice(steps, 12):
        pass
    assert replay.inserts > before["inserts"]
    assert replay.sample(64).rows["weights_version"].max() >= versions
    replay.close()


def test_a_sync_is_answered_once_the_rows_are_on_the_disk(tmp_path: Path) -> None:
    with service(LOADED, spec=CHECKED, folder=tmp_path) as running:
        assert sync_replay(running.client, KEYS)["inserts"] == 0
        assert fetch_stats(running.client, KEYS)["durable"]
    with service(OPEN) as running:
        assert not sync_replay(running.client, KEYS)["durable"]
