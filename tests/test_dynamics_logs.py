"""Dynamics on recorded drives: forward(inverse(log)) is the log where it can be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import dynamics
from sim.bank import BankFile
from sim.dynamics import ActionConfig, ActionSpace, ObjectState
from sim.procedural import generate_many
from sim.scene import ObjectType
from tests import scenes

DT = 0.1


def pairs(file: BankFile) -> tuple[np.ndarray, np.ndarray]:
    """Every two consecutive recorded states [pairs, 5] of a vehicle."""
    log, valid = file.arrays["log"], file.arrays["log_valid"]
    vehicle = file.arrays["object_type"] == ObjectType.VEHICLE
    both = valid[:, :-1] & valid[:, 1:] & vehicle[:, None]
    fields = [0, 1, 3, 4, 5]
    return log[:, :-1][both][:, fields], log[:, 1:][both][:, fields]


def replayed(space: ActionSpace, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """forward(inverse) from each state to its next."""
    config = ActionConfig(space=space)

    def one(now: jax.Array, following: jax.Array) -> jax.Array:
        states = (ObjectState(*now), ObjectState(*following))
        return jnp.stack(dynamics.replay(*states, config, DT))

    return np.asarray(jax.jit(jax.vmap(one))(before, after))


def position_error(reached: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.hypot(*(reached - after)[:, :2].T)


@pytest.fixture(scope="module", params=["recorded", "generated"])
def steps(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[np.ndarray, np.ndarray]:
    if request.param == "recorded":
        return pairs(request.getfixturevalue("real")[1])
    folder = tmp_path_factory.mktemp("logs")
    return pairs(scenes.bank_of(list(generate_many(2, 2)), folder))


def test_delta_repeats_every_step(steps: tuple[np.ndarray, np.ndarray]) -> None:
    before, after = steps
    reached = replayed(ActionSpace.DELTA, before, after)
    assert len(before) > 1000
    assert position_error(reached, after).max() < 1e-4
    turn = (reached[:, 2] - after[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn).max() < 1e-5


@pytest.mark.parametrize("space", [ActionSpace.BICYCLE, ActionSpace.STEERING])
def test_bicycle_repeats_what_it_can(
    steps: tuple[np.ndarray, np.ndarray], space: ActionSpace
) -> None:
    """The speed exactly, the velocity's heading, and the position to a few cm.

    The position has an action less than it would need: its error is the model's.
    """
    before, after = steps
    reached = replayed(space, before, after)
    speed = np.hypot(after[:, 3], after[:, 4])
    np.testing.assert_allclose(np.hypot(reached[:, 3], reached[:, 4]), speed, atol=1e-3)
    fast = (np.hypot(before[:, 3], before[:, 4]) > 2) & (speed > 2)
    if space == ActionSpace.BICYCLE:
        heading = np.arctan2(after[:, 4], after[:, 3])
        turn = (reached[:, 2] - heading + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(turn[fast]).max() < 1e-4
    error = position_error(reached, after)
    assert np.median(error[fast]) < 0.02
    assert np.quantile(error[fast], 0.95) < 0.2


def test_playback_repeats_everything(steps: tuple[np.ndarray, np.ndarray]) -> None:
    before, after = (ObjectState(*states.T) for states in steps)
    given = dynamics.playback_inverse(before, after)
    assert all(
        (one == other).all()
        for one, other in zip(dynamics.playback(before, given), after, strict=True)
    )
