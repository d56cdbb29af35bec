"""Behaviour cloning's data and its agents: expert actions as rows, policies that drive.

What is cloned is the log's own action: the inverse dynamics between two of its
consecutive states (Gulino et al., 2023, appendix A.2), in the space of the
environment's `ActionConfig`: continuous, and rounded to the nearest action of its grid.
Delta actions are in the object's own frame, as the grid's are. This is not what the
benchmark's expert does in closed loop: that one starts from the simulated state.

A bank pass makes rows of `actors.rows` with the field `continuous`, which the replay
takes like an actor's. Their reward is 0: nobody drove.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from actors import mixture
from actors.mixture import (
    Choice,
    action_limits,
    inertia,
    policy_outputs,
    shifted,
    split_mixture,
)
from actors.network import NetworkConfig, batched
from actors.rows import row_spec
from sim import dynamics
from sim.agents import Agent, Decision, continuous, discrete
from sim.bank import Bank
from sim.dynamics import ObjectState
from sim.environment import EnvironmentConfig, State
from sim.observation import observation_sizes, observe_batch

_GATHERED = 1 << 16  # rows whose states are gathered at once: the rest is memory
_CHUNK = 1024  # rows whose distances to all of a grid's actions are in memory at once


class ExpertActions(NamedTuple):
    """What the log did between pairs of consecutive states."""

    continuous: Float[Array, "rows components"]  # own frame, not cut to the limits
    on_grid: Int[Array, " rows"]  # index of the grid's nearest


def sdc_only(bank: Bank) -> Int[np.ndarray, "scenes 1"]:
    """The controlled set of each scene that holds its SDC alone."""
    return np.asarray(bank.sdc)[:, None].astype(np.int32)


def moving_vehicles(
    bank: Bank, least: float = 1.0
) -> Int[np.ndarray, "scenes objects"]:
    """The vehicles that the log moves by `least` metres or more, and the SDC.

    Slots of other objects are empty: they hold the log's number of objects.
    """
    log, valid = np.asarray(bank.log), np.asarray(bank.log_valid)
    objects = np.arange(log.shape[2], dtype=np.int32)
    place = np.where(valid[..., None], log[..., :2], np.nan)
    with np.errstate(all="ignore"):
        low, high = np.fmin.reduce(place, axis=1), np.fmax.reduce(place, axis=1)
    moved = np.nan_to_num(np.hypot(*np.moveaxis(high - low, -1, 0))) >= least
    taken = moved & (np.asarray(bank.object_type) == 1)
    taken |= objects == np.asarray(bank.sdc)[:, None]
    return np.where(taken, objects, np.int32(len(objects)))


@functools.partial(jax.jit, static_argnames="config")
def expert_actions(
    states_tm1: Float[Array | np.ndarray, "rows 5"],
    states_t: Float[Array | np.ndarray, "rows 5"],
    config: EnvironmentConfig,
) -> ExpertActions:
    """The actions that lead from each state to the following, in the config's space."""

    def one(
        pair: tuple[Float[Array, "5"], Float[Array, "5"]],
    ) -> tuple[Float[Array, " components"], Int[Array, ""]]:
        now, following = ObjectState(*pair[0]), ObjectState(*pair[1])
        action = dynamics.inverse(now, following, config.action, config.dt)
        index = dynamics.nearest_action(now, action, config.action)
        return dynamics.in_own_frame(now, action, config.action), index

    return ExpertActions(*jax.lax.map(one, (states_tm1, states_t), batch_size=_CHUNK))


def expert_steps(
    bank: Bank, controlled: Int[np.ndarray, "scenes controlled"], first: int
) -> tuple[
    Int[np.ndarray, " rows"], Int[np.ndarray, " rows"], Int[np.ndarray, " rows"]
]:
    """Scene, object and step t of each action, s_tm1 from step `first` on."""
    there = np.asarray(bank.log_valid)
    objects_of_log = there.shape[2]
    steps = np.arange(first, there.shape[1] - 1)
    scene, slot = np.nonzero(controlled < objects_of_log)
    objects = controlled[scene, slot]
    known = there[scene[:, None], :, objects[:, None]][:, 0]
    lasts = np.asarray(bank.steps)[scene, None]
    pairs = known[:, steps] & known[:, steps + 1] & (steps[None] + 1 < lasts)
    which, at = np.nonzero(pairs)
    return scene[which], objects[which], steps[at] + 1


def expert_rows(
    bank: Bank,
    controlled: Int[np.ndarray, "scenes controlled"],
    config: EnvironmentConfig,
    *,
    first_step: int | None = None,
) -> np.ndarray:
    """A row for every step at which a controlled object was recorded before and after.

    Args:
        bank: the scenes.
        controlled: objects of each scene; the log's number of objects is an empty slot.
        config: the action space, the observation's history and the step's length.
        first_step: of s_tm1; None is the first with a whole history.

    Returns:
        Rows of `row_spec(history, components)`, by scene, object and step.
    """
    history = config.observation.history
    log, there = np.asarray(bank.log), np.asarray(bank.log_valid)
    first = history - 1 if first_step is None else first_step
    scene, objects, step_t = expert_steps(bank, controlled, first)
    rows = np.zeros(
        len(scene), row_spec(history, len(action_limits(config.action))).dtype
    )
    rows["scene"], rows["step"], rows["controlled"] = scene, step_t, objects
    for first in range(0, len(rows), _GATHERED):
        part = rows[first : first + _GATHERED]
        wanted = part["step"][:, None] + np.arange(-history, 1)
        cells = (
            part["scene"][:, None],
            np.maximum(wanted, 0),
            part["controlled"][:, None],
        )
        part["states"] = log[cells][..., [0, 1, 3, 4, 5]]
        part["valid"] = there[cells] & (wanted >= 0)
    acted = expert_actions(
        np.ascontiguousarray(rows["states"][:, -2]),
        np.ascontiguousarray(rows["states"][:, -1]),
        config,
    )
    rows["action"] = acted.on_grid
    rows["continuous"] = acted.continuous
    rows["discount"] = 1.0
    rows["serial"] = np.arange(len(rows))
    return rows


def cloned(
    vector: Float[Array, " parameters"],
    network: NetworkConfig,
    config: EnvironmentConfig,
    *,
    components: int,
    choice: Choice = "mode",
    slots: int | None = None,
) -> Agent:
    """Drives by a cloned policy: a mixture of so many components, 0 for the grid.

    On the grid `mode` and `mean` are the likeliest index, since indices have no mean.
    With `slots` it decides for the first ones only, as `sim.agents.composite` takes it:
    the network costs more than all else.
    """
    sizes = observation_sizes(config.observation)
    outputs = policy_outputs(config.action, components)
    limits = action_limits(config.action)

    def move(
        key: PRNGKeyArray,
        state: Float[Array, "5"],
        values: Float[Array, " outputs"],
    ) -> Float[Array, "5"]:
        going_on = inertia(jnp.hypot(state[3], state[4]), config.action, config.dt)
        distribution = shifted(split_mixture(values, len(limits)), going_on)
        if choice == "sample":
            scaled = mixture.sample(key, distribution)
        else:
            chosen = mixture.mode if choice == "mode" else mixture.mean
            scaled = chosen(distribution)
        return jnp.stack(
            dynamics.apply_continuous(
                ObjectState(*state), scaled * limits, config.action, config.dt
            )
        )

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        view = jax.tree.map(lambda value: value[None], state.view)
        observation = jax.tree.map(
            lambda values: values[0, :slots],
            observe_batch(bank, view, config.observation),
        )
        now = state.history[:slots, -1]
        values = batched(
            vector, observation, config=network, sizes=sizes, actions=outputs
        )
        keys = jax.random.split(key, values.shape[0])
        if components:
            return continuous(jax.vmap(move)(keys, now, values))
        if choice == "sample":
            action = jax.vmap(jax.random.categorical)(keys, values)
        else:
            action = jnp.argmax(values, -1)
        return discrete(now, action.astype(jnp.int32), values, config)

    return act
