"""Extensions of the paper's DQN, through actors, replay and learner of one process."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from launch.config import quick, rows_of_run
from launch.learning import make_learner
from launch.roles import ActorStatus, acting_config
from launch.scenes import write_procedural
from launch.serial import serial_replay, serial_steps
from launch.train import TrainConfig, resolved
from replay.local import ReplayConfig
from sim.episodes import sdc_only


def test_they_are_off_unless_asked_for() -> None:
    config = quick()
    assert rows_of_run(config).row_bytes == 128
    acting = acting_config(config)
    assert (acting.choose, acting.n_step) == (sdc_only, 1)


def test_whom_to_control_is_an_option() -> None:
    config = resolved(TrainConfig(objects="vehicles"))
    assert config.actor.objects == "vehicles"
    assert rows_of_run(config).row_bytes == 576


@pytest.mark.slow
def test_a_run_of_several_objects_and_steps(tmp_path: Path) -> None:
    """What is learnt from is what several objects did, each over up to three steps."""
    config = quick()
    config = dataclasses.replace(
        config,
        actor=dataclasses.replace(
            config.actor, environments=4, objects="vehicles", slots=3
        ),
        learner=dataclasses.replace(config.learner, n_step=3, batch_size=16),
        replay=ReplayConfig(
            capacity=2000,
            min_size=100,
            samples_per_insert=4.0,
            tolerance=4.0,
            sampler="uniform",
        ),
        actors=1,
    )
    file = write_procedural(tmp_path / "train.bank", count=2, seed=0)
    replay = serial_replay(config)
    steps = serial_steps(
        config, file.bank, make_learner(config), ActorStatus.begin(), replay
    )
    results = [step.result for step, _ in itertools.islice(steps, 60)]
    assert np.isfinite([result.loss for result in results]).all()
    assert replay.samples == 60 * 16
    assert replay.inserts % (4 * config.actor.scan_steps) == 0
    rows = replay.sample(16).rows
    assert rows.dtype == rows_of_run(config).dtype
    assert set(np.unique(rows["span"])) <= {1, 2, 3}
    gamma = np.float32(config.learner.discount)
    going = rows["discount"] > 0
    np.testing.assert_allclose(
        rows["discount"][going], gamma ** (rows["span"][going] - 1), rtol=1e-6
    )
    assert len(np.unique(rows["controlled"])) > 2
    assert (rows["others"] != rows["controlled"][:, None]).all()
