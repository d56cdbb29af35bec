"""Episodes one behind the other: which objects a fresh one controls, and auto-reset.

`step` is a whole environment step of a batch in one compiled call: dynamics, reward,
ends of episodes, fresh ones in their place, and what is seen then.

    begin = episodes.starts(bank, episodes.NearestToSdc(32), config)
    state = episodes.draw(key, begin, environments=16)
    state, outcome, observation = episodes.step(key, bank, begin, state, action, config)
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from sim import environment
from sim.bank import Bank
from sim.environment import EnvironmentConfig, Outcome, State
from sim.observation import Observation, observe_batch
from sim.scene import ObjectType

Choice = Callable[[Bank, Int[Array, ""]], Int[Array, " controlled"]]
"""The rows that a fresh episode of a scene controls; hashable, of a fixed length."""


def sdc_only(bank: Bank, scene: Int[Array, ""]) -> Int[Array, "1"]:
    """The recording vehicle."""
    return bank.sdc[scene][None]


@final
@dataclass(frozen=True)
class NearestToSdc:
    """The SDC, then the objects nearest to it where the episode starts.

    Slots for which there is no object are empty.
    """

    slots: int
    """Controlled objects, the SDC included."""
    moving: bool = False
    """Only objects that the log moves by `MOVES` metres or more; the SDC always."""
    vehicles: bool = False
    """Only vehicles; the SDC always."""

    def __call__(self, bank: Bank, scene: Int[Array, ""]) -> Int[Array, " controlled"]:
        """Those recorded at `current_step`, nearest first, ties by row."""
        step, sdc = bank.current_step[scene], bank.sdc[scene]
        row, valid = bank.log[scene, step], bank.log_valid[scene, step]
        if self.moving:
            moved = bank.route_end[scene] - bank.route_start[scene]
            valid = valid & (moved >= MOVES)
        if self.vehicles:
            valid = valid & (bank.object_type[scene] == ObjectType.VEHICLE)
        objects = valid.shape[0]
        is_sdc = jnp.arange(objects) == sdc
        away = jnp.hypot(row[:, 0] - row[sdc, 0], row[:, 1] - row[sdc, 1])
        away = jnp.where(is_sdc, -1.0, jnp.where(valid, away, jnp.inf))
        order = jnp.argsort(away, stable=True)
        chosen = jnp.where(jnp.isfinite(away[order]), order, objects)
        empty = jnp.full(max(self.slots - objects, 0), objects)
        return jnp.concatenate([chosen[: self.slots], empty]).astype(jnp.int32)


MOVES = 1.0  # m


@functools.partial(jax.jit, static_argnames=("choose", "config"))
def starts(bank: Bank, choose: Choice, config: EnvironmentConfig) -> State:
    """Every scene of the bank at its start; axis `scenes` in front.

    Made once: a restart is then one look-up, whatever it takes to choose the objects.
    """

    def one(scene: Int[Array, ""]) -> State:
        return environment.reset(bank, scene, choose(bank, scene), config)

    return jax.vmap(one)(jnp.arange(bank.sdc.shape[0], dtype=jnp.int32))


def draw(key: PRNGKeyArray, begin: State, environments: int) -> State:
    """Starts of random scenes; axis `environments` in front."""
    scenes = begin.scene.shape[0]
    drawn = jax.random.randint(key, (environments,), 0, scenes, jnp.int32)
    return jax.tree.map(lambda values: values[drawn], begin)


def episode_over(outcome: Outcome) -> Bool[Array, "*environments"]:
    """Whether the recording is at its end, or all objects that count have failed."""
    return outcome.truncated | (outcome.terminated | ~outcome.valid).all(-1)


def auto_reset(
    key: PRNGKeyArray, begin: State, state: State, outcome: Outcome
) -> State:
    """The batch with a random start wherever the episode is over."""
    ended = episode_over(outcome)
    fresh = draw(key, begin, ended.shape[0])

    def chosen(new: Array, old: Array) -> Array:
        return jnp.where(ended.reshape(-1, *(1,) * (old.ndim - 1)), new, old)

    return jax.tree.map(chosen, fresh, state)


@functools.partial(jax.jit, static_argnames="config")
def step(
    key: PRNGKeyArray,
    bank: Bank,
    begin: State,
    state: State,
    action: Int[Array, "environments controlled"],
    config: EnvironmentConfig,
) -> tuple[State, Outcome, Observation]:
    """One step of a batch of environments with auto-reset.

    Args:
        key: draws the scenes of the episodes that begin.
        bank: the scenes.
        begin: `starts` of the bank.
        state: the batch; of `draw` at first.
        action: index into the action table of each controlled object.
        config: dynamics, reward and observation.

    Returns:
        The state after it, fresh where an episode was over; the outcome of the step,
        still of the episode that was over; what is seen in the new state, axes
        `environments controlled`.
    """
    moved, outcome = jax.vmap(environment.step, in_axes=(None, 0, 0, None))(
        bank, state, action, config
    )
    following = auto_reset(key, begin, moved, outcome)
    seen = observe_batch(bank, following.view, config.observation)
    return following, outcome, seen
