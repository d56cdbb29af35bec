"""Agents without learning: where each goes."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import agents, environment
from sim.agents import Agent, ExpertSpace
from sim.bank import BankFile
from sim.dynamics import ActionConfig, ActionSpace, action_table
from sim.environment import EnvironmentConfig
from sim.procedural import generate_many
from tests import scenes

CONFIG = EnvironmentConfig()
OBJECTS = 6


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    return scenes.bank_of(list(generate_many(9, 2)), tmp_path_factory.mktemp("agents"))


@functools.cache
def rollout(agent: Agent) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Compiled once for an agent."""

    def one(key, bank):
        state = environment.reset(
            bank, jnp.int32(0), jnp.arange(OBJECTS, dtype=jnp.int32), CONFIG
        )

        def step(state, step_key):
            decision = agent(step_key, bank, state)
            state, _ = environment.advance(bank, state, decision.moved, CONFIG)
            return state, (state.history[:, -1], decision.action)

        return jax.lax.scan(step, state, jax.random.split(key, 80))[1]

    return jax.jit(one)


def drive(file: BankFile, agent: Agent, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """States [steps, objects, 5] and actions of the first objects, to the end."""
    states, actions = rollout(agent)(jax.random.key(seed), file.bank)
    return np.asarray(states), np.asarray(actions)


def logged(file: BankFile) -> tuple[np.ndarray, np.ndarray]:
    """The same states of the log, and where they were always recorded."""
    start = int(file.arrays["current_step"][0])
    log = file.arrays["log"][0, start + 1 :, :OBJECTS][..., [0, 1, 3, 4, 5]]
    return log, file.arrays["log_valid"][0, start:, :OBJECTS].all(0)


def apart(file: BankFile, states: np.ndarray) -> float:
    """The farthest that an object was from its log [m]."""
    log, whole = logged(file)
    assert whole.sum() >= 3
    return float(np.hypot(*(states - log)[:, whole, :2].transpose(2, 0, 1)).max())


def test_playback_is_the_log(file: BankFile) -> None:
    states, actions = drive(file, agents.log_playback())
    np.testing.assert_array_equal(states, logged(file)[0])
    assert (actions == -1).all()


@pytest.mark.parametrize(
    ("space", "on_grid", "most"),
    [
        (ActionSpace.DELTA, False, 1e-3),
        # The model's error: half a step of the turn, summed up over 8 s.
        (ActionSpace.BICYCLE, False, 2.0),
    ],
)
def test_experts_stay_near_the_log(file: BankFile, space, on_grid, most) -> None:
    states, actions = drive(file, agents.expert(CONFIG, ExpertSpace(space, on_grid)))
    assert apart(file, states) < most
    assert (actions == -1).all()


@pytest.mark.parametrize("space", list(ActionSpace))
def test_experts_on_the_grid_take_its_actions(file: BankFile, space) -> None:
    states, actions = drive(file, agents.expert(CONFIG, ExpertSpace(space, True)))
    grid = ActionConfig(space=space)
    assert actions.min() >= 0
    assert actions.max() < grid.count
    assert len(np.unique(actions)) > 3
    # Rounded to the grid at every step, a moving object drifts, but not off the map.
    log, whole = logged(file)
    moved = np.hypot(*(log[-1] - log[0])[whole, :2].T)
    drift = np.hypot(*(states[-1] - log[-1])[whole, :2].T)
    assert (drift < 5 + 0.5 * moved).all()


def test_constant_speed_goes_straight(file: BankFile) -> None:
    states, actions = drive(file, agents.constant_speed(CONFIG))
    start = int(file.arrays["current_step"][0])
    first = file.arrays["log"][0, start, :OBJECTS].astype(np.float64)
    whole = logged(file)[1]
    speed = np.hypot(first[:, 4], first[:, 5])
    time = 0.1 * np.arange(1, 81)[:, None]
    heading = first[:, 3]
    # Its first step goes along the velocity, the others along the yaw.
    expected = first[:, 0] + np.cos(heading) * speed * time
    off = np.abs(states[..., 0] - expected)[:, whole]
    assert off.max() < 0.1 * speed[whole].max() + 0.05
    np.testing.assert_allclose(
        np.hypot(states[..., 3], states[..., 4])[:, whole],
        np.broadcast_to(speed, states.shape[:2])[:, whole],
        atol=1e-3,
    )
    assert (actions == -1).all()


def test_random_actions_depend_on_the_key_alone(file: BankFile) -> None:
    agent = agents.random_actions(CONFIG)
    _, one = drive(file, agent, seed=1)
    _, same = drive(file, agent, seed=1)
    _, other = drive(file, agent, seed=2)
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.9
    assert set(np.unique(one)) <= set(range(CONFIG.action.count))
    assert len(np.unique(one)) > CONFIG.action.count * 0.9


def test_a_discrete_decision_is_the_environments_step(file: BankFile) -> None:
    state = jax.jit(environment.reset, static_argnums=3)(
        file.bank, jnp.int32(0), jnp.arange(OBJECTS, dtype=jnp.int32), CONFIG
    )
    action = jnp.arange(OBJECTS, dtype=jnp.int32) * 7
    step = jax.jit(environment.step, static_argnums=3)
    stepped, _ = step(file.bank, state, action, CONFIG)
    decided = jax.jit(agents.discrete, static_argnums=3)(
        state.history[:, -1], action, jnp.zeros((OBJECTS, 0)), CONFIG
    )
    follows = np.asarray(stepped.history_valid[:, -1] & state.history_valid[:, -1])
    assert follows.any()
    np.testing.assert_allclose(
        decided.moved[follows], stepped.history[follows, -1], atol=1e-5
    )
    np.testing.assert_array_equal(decided.action, action)
    assert len(action_table(CONFIG.action)) > int(action.max())
