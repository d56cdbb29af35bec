"""Agents that need no learning: playback, expert, constant speed, random.

An agent says where the controlled objects of one scene are at the next step. The
experts are the paper's (appendix A.1): the log through the inverse dynamics, so that
the action space's limits and errors show. The paper leaves open from which state; here
it is the simulated one to the log's next: from the log's own, a car whose velocity
points a little aside of its yaw turns away by that angle again at every step.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from sim import dynamics
from sim.bank import Bank
from sim.dynamics import ActionSpace, ObjectState
from sim.environment import EnvironmentConfig, State, logged_states


class Decision(NamedTuple):
    """Where the controlled objects go, and what made them."""

    moved: Float[Array, "controlled 5"]  # x, y, yaw, v_x, v_y at the next step
    action: Int[Array, " controlled"]  # index into the action table, -1: none
    q_values: Float[Array, "controlled actions"]  # no columns: none


Agent = Callable[[PRNGKeyArray, Bank, State], Decision]


def continuous(moved: Float[Array, "controlled 5"]) -> Decision:
    """A decision without an index."""
    objects = moved.shape[0]
    return Decision(
        moved, jnp.full(objects, -1, jnp.int32), jnp.zeros((objects, 0), jnp.float32)
    )


def next_logged(bank: Bank, state: State) -> Float[Array, "controlled 5"]:
    """The controlled objects' logged states at the next step."""
    step_t = jnp.minimum(state.step + 1, bank.log.shape[1] - 1)
    return logged_states(bank, state.scene, step_t, state.controlled)


def log_playback() -> Agent:
    """Goes where the log went."""

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        moved = dynamics.playback(
            ObjectState(*state.history[:, -1].T),
            ObjectState(*next_logged(bank, state).T),
        )
        return continuous(jnp.stack(moved, -1))

    return act


def constant_speed(config: EnvironmentConfig) -> Agent:
    """Keeps speed and heading."""

    def one(state: ObjectState) -> Float[Array, "5"]:
        still = dynamics.bicycle(state, jnp.zeros(2), config.dt)
        return jnp.stack(still)

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        # Once straightened, the velocity lies along the yaw and stays there.
        return continuous(jax.vmap(one)(ObjectState(*state.history[:, -1].T)))

    return act


def random_actions(config: EnvironmentConfig) -> Agent:
    """Draws every object's action uniformly from the grid."""

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        shape = state.controlled.shape
        action = jax.random.randint(key, shape, 0, config.action.count, jnp.int32)
        none = jnp.zeros((shape[0], 0), jnp.float32)
        return discrete(state.history[:, -1], action, none, config)

    return act


def discrete(
    now: Float[Array, "controlled 5"],
    action: Int[Array, " controlled"],
    q_values: Float[Array, "controlled actions"],
    config: EnvironmentConfig,
) -> Decision:
    """The decision that an index of the grid leads to from the objects' states."""
    moved = jax.vmap(dynamics.apply_discrete, in_axes=(0, 0, None, None))(
        ObjectState(*now.T), action, config.action, config.dt
    )
    return Decision(jnp.stack(moved, -1), action, q_values)


class ExpertSpace(NamedTuple):
    """The action space that an expert acts through."""

    space: ActionSpace
    on_grid: bool  # rounded to the grid's nearest action


def expert(config: EnvironmentConfig, through: ExpertSpace) -> Agent:
    """Imitates the log through an action space."""
    grid = dataclasses.replace(config.action, space=through.space)

    def one(
        now: ObjectState, following: ObjectState
    ) -> tuple[Float[Array, "5"], Int[Array, ""]]:
        if through.on_grid:
            action = dynamics.inverse(now, following, grid, config.dt)
            index = dynamics.nearest_action(now, action, grid)
            moved = dynamics.apply_discrete(now, index, grid, config.dt)
            return jnp.stack(moved), index
        moved = dynamics.replay(now, following, grid, config.dt)
        return jnp.stack(moved), jnp.int32(-1)

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        moved, action = jax.vmap(one)(
            ObjectState(*state.history[:, -1].T),
            ObjectState(*next_logged(bank, state).T),
        )
        return Decision(moved, action, jnp.zeros((action.shape[0], 0), jnp.float32))

    return act


def composite(driver: Agent, slots: int, others: Agent) -> Agent:
    """The first `slots` controlled objects as `driver` decides, the rest as `others`.

    Both see the whole scene; the driver may decide for the first ones only.
    """

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        own_key, others_key = jax.random.split(key)
        own, rest = driver(own_key, bank, state), others(others_key, bank, state)
        q_values = own.q_values[:slots]
        none = jnp.zeros((rest.moved.shape[0] - slots, q_values.shape[1]))
        return Decision(
            moved=jnp.concatenate([own.moved[:slots], rest.moved[slots:]]),
            action=jnp.concatenate([own.action[:slots], rest.action[slots:]]),
            q_values=jnp.concatenate([q_values, none]),
        )

    return act
