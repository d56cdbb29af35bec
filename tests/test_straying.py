"""Rows off the log: the way back is the equation's, and the actions lead along it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors.cloning import expert_rows, sdc_only
from actors.straying import (
    LENGTH,
    LOOK_AHEAD,
    TIME,
    Stray,
    StrayingConfig,
    off_the_log,
    strayed,
)
from sim import dynamics
from sim.dynamics import ActionConfig, ActionSpace, ObjectState
from sim.environment import EnvironmentConfig
from sim.procedural import generate_many
from tests import scenes

DT = 0.1
SPEED = 10.0


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return scenes.bank_of(
        list(generate_many(4, 2)), tmp_path_factory.mktemp("straying"), "two"
    )


def straight(first: int, count: int) -> np.ndarray:
    """States of a log along x, from step `first` on."""
    x = SPEED * DT * np.arange(first, first + count)
    zero = np.zeros(count)
    columns = [x, zero, zero, zero + SPEED, zero]
    return np.stack(columns, -1)[None].astype(np.float32)


def stray_of(aside: float, turn: float = 0.0, pace: float = 1.0) -> Stray:
    return Stray(*(np.array([value]) for value in (aside, turn, pace, 0.0, 0.0)))


def test_the_way_back_is_critically_damped() -> None:
    """Step by step from 1 m aside: d = d0 (1 + l/L) exp(-l/L), never beyond the log."""
    length = LENGTH + LOOK_AHEAD * SPEED
    aside, turn = 1.0, 0.0
    for step in range(80):
        after = off_the_log(straight(step, 4), stray_of(aside, turn), DT)[0, -1]
        aside, turn = float(after[1]), float(after[2])
        travelled = SPEED * DT * (step + 1) / length
        assert aside == pytest.approx((1 + travelled) * np.exp(-travelled), abs=0.06)
        assert aside > -1e-3
    assert abs(aside) < 0.02


def test_the_pace_returns_in_its_time() -> None:
    pace = 1.2
    for _ in range(round(TIME / DT)):
        after = off_the_log(straight(0, 4), stray_of(0.0, pace=pace), DT)[0, -1]
        pace = float(np.hypot(*after[3:])) / SPEED
    assert pace == pytest.approx(1 + 0.2 * np.exp(-1), abs=0.005)


def test_who_stands_stays() -> None:
    states = straight(0, 4)
    states[..., 0], states[..., 3:] = 7.0, 0.0
    moved = off_the_log(states, stray_of(0.5, 0.1, 1.2), DT)[0]
    np.testing.assert_allclose(moved[:, :3], [[7.0, 0.5, 0.1]] * 4, atol=1e-6)
    assert not moved[:, 3:].any()


@pytest.mark.parametrize("space", [ActionSpace.BICYCLE, ActionSpace.DELTA])
def test_the_actions_lead_along_the_way_back(file, space) -> None:
    config = EnvironmentConfig(action=ActionConfig(space=space))
    rows = expert_rows(file.bank, sdc_only(file.bank), config)
    rng = np.random.default_rng(0)
    changed = strayed(rows, rng, StrayingConfig(share=0.5), config)
    half = round(0.5 * len(rows))
    np.testing.assert_array_equal(changed[half:], rows[half:])
    part = changed[:half]
    assert np.abs(part["states"][:, -2, :2] - rows["states"][:half, -2, :2]).max() > 0.5
    moved = jax.vmap(
        lambda state, action: jnp.stack(
            dynamics.apply_continuous(ObjectState(*state), action, config.action, DT)
        )
    )(jnp.asarray(part["states"][:, -2]), jnp.asarray(part["continuous"]))
    error = np.abs(np.asarray(moved)[:, :2] - part["states"][:, -1, :2]).max(1)
    assert error.max() < (1e-3 if space == ActionSpace.DELTA else 0.1)


def test_without_deviations_the_rows_are_the_logs(file) -> None:
    config = EnvironmentConfig()
    rows = expert_rows(file.bank, sdc_only(file.bank), config)
    nowhere = StrayingConfig(share=1.0, sideways=0.0, heading=0.0, speed=0.0)
    same = strayed(rows, np.random.default_rng(0), nowhere, config)
    np.testing.assert_allclose(same["states"], rows["states"], atol=1e-4)
    np.testing.assert_allclose(same["continuous"], rows["continuous"], atol=2e-2)
    assert strayed(rows, np.random.default_rng(0), StrayingConfig(), config) is rows


def test_settings_that_mean_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match=r"share=1\.5"):
        StrayingConfig(share=1.5)
    with pytest.raises(ValueError, match="heading=-1"):
        dataclasses.replace(StrayingConfig(), heading=-1.0)
