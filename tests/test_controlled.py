"""Whom an evaluation controls: sets of objects, and others that react."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from actors.controlled import (
    ControlledError,
    ControlledSet,
    all_of,
    rows_of,
    sdc_of,
    tracks_of,
    with_others,
)
from actors.evaluation import Evaluation, evaluate
from actors.network import NetworkConfig
from actors.policy import greedy, random_vector
from sim import agents
from sim.bank import BankFile
from sim.dynamics import ActionConfig
from sim.environment import EnvironmentConfig
from sim.idm import idm
from sim.observation import ObservationConfig
from tests import scenes

CONFIG = EnvironmentConfig(
    action=ActionConfig(acceleration_bins=3, curvature_bins=3),
    observation=ObservationConfig(neighbours=3, road_rows=4, lights=1),
)
NETWORK = NetworkConfig(width=8, latents=1, heads=1, mlp_width=8, mlp_layers=1)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """Three objects, of which the last two are to predict; two, of which none is."""
    drivers = [
        scenes.driver(speed=4.0, steps=60),
        scenes.driver(x=-20.0, speed=10.0, steps=60),
        scenes.driver(x=60.0, speed=6.0, steps=60),
    ]
    one = dataclasses.replace(scenes.scene_of(drivers), tracks_to_predict=(1, 2))
    two = dataclasses.replace(scenes.scene_of(drivers[:2]), scenario_id="second")
    return scenes.bank_of([one, two], tmp_path_factory.mktemp("sets"))


def judged(file: BankFile, agent: agents.Agent, chosen: ControlledSet) -> Evaluation:
    return evaluate(
        file,
        agent,
        name="it",
        key=jax.random.key(0),
        config=CONFIG,
        controlled=chosen,
        keep_trace=True,
    )


def test_sets_by_name_and_by_row(file: BankFile) -> None:
    np.testing.assert_array_equal(sdc_of(file).slots, [[0], [0]])
    np.testing.assert_array_equal(all_of(file).slots, [[0, 1, 2], [0, 1, 2]])
    np.testing.assert_array_equal(tracks_of(file).slots, [[1, 2], [3, 3]])
    np.testing.assert_array_equal(rows_of(file, [1, 0]).slots, [[1, 0], [1, 0]])
    others = with_others(file, tracks_of(file))
    np.testing.assert_array_equal(others.slots, [[1, 2, 0, 3], [3, 3, 0, 1]])
    assert others.judged == 2


def test_rows_that_are_not_there_are_refused(file: BankFile, tmp_path: Path) -> None:
    with pytest.raises(ControlledError, match=r"second has objects 0 to 1, 2 is none"):
        rows_of(file, [0, 2])
    with pytest.raises(ControlledError, match="-1 is none"):
        rows_of(file, [-1])
    with pytest.raises(ControlledError, match="each object once"):
        rows_of(file, [1, 1])
    nothing = scenes.bank_of([scenes.scene_of([scenes.driver()])], tmp_path)
    with pytest.raises(ControlledError, match="no scene names tracks"):
        tracks_of(nothing)


def test_only_the_judged_count_and_an_empty_slot_is_nobody(file: BankFile) -> None:
    log = judged(file, agents.log_playback(), tracks_of(file))
    assert [scene.objects for scene in log.scenes] == [2, 0]
    assert log.scenes[1].valid == 0
    assert log.scenes[1].progress is None
    assert not log.scenes[1].failed
    assert log.figures["failure_rate"].value == 1.0  # the log's own overlap
    assert log.trace is not None
    assert log.trace.states.shape[2] == 2


@pytest.mark.slow
def test_others_react_to_whoever_drives_among_them(file: BankFile) -> None:
    """Object 1 runs into object 0 in the log, and brakes behind it by IDM."""
    chosen = sdc_of(file)
    among = with_others(file, chosen)
    alone = judged(file, agents.constant_speed(CONFIG), chosen)
    driven = agents.composite(agents.constant_speed(CONFIG), 1, idm(CONFIG))
    amid = judged(file, driven, among)
    assert [scene.overlap > 0 for scene in alone.scenes] == [True, True]
    assert [scene.overlap for scene in amid.scenes] == [0, 0]
    assert [scene.objects for scene in amid.scenes] == [1, 1]


@pytest.mark.slow
def test_a_policy_drives_any_set_among_any_others(file: BankFile) -> None:
    """It decides for its slots only, by what it sees of the simulated others."""
    vector = random_vector(jax.random.key(1), NETWORK, CONFIG)
    among = with_others(file, rows_of(file, [1, 0]))
    policy = greedy(vector, NETWORK, CONFIG, 2)
    found = judged(file, agents.composite(policy, 2, idm(CONFIG)), among)
    assert [scene.objects for scene in found.scenes] == [2, 2]
    assert found.trace is not None
    assert found.trace.q_values.shape[2:] == (2, CONFIG.action.count)
    best = np.argmax(found.trace.q_values, -1)
    np.testing.assert_array_equal(found.trace.action, best)
