"""What a controlled object sees: fixed-size features in its own frame.

A pure function of the scene, the step and the last H states of the controlled objects
(`sim.world.View`), so that a transition's row of states renders, anywhere, the very
observation that its actor acted on. The frame is the object's: x ahead, y to its left,
origin at its centre. Positions are divided by `POSITION_SCALE`, speeds by
`SPEED_SCALE`; one-hot types and cosines stand as they are. Values under a False mask
are 0.

- ego: speed, size, own past H-1 poses, curvature-free motion (yaw rate, acceleration
  from the last two states), distance and bearing along the logged route: the offset
  from it, the heading relative to it and `route_points` points ahead on it, and what is
  left of it. The route's geometry is an input (the benchmark's agents are given
  theirs); its timing is not.
- agents: the nearest valid neighbours, each with H steps of pose and velocity.
- road: the cell's nearest map segments (`sim.tables`), nearest to the cell's centre
  first: middle, half extent, unit direction, kind.
- lights: the nearest traffic lights with their state.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim.apart import apart
from sim.bank import Bank
from sim.features import (
    AGENT_FEATURES,
    AGENT_STEP_FEATURES,
    LIGHT_CLASSES,
    Frame,
    agent_features,
    light_features,
    nearest_agents,
    own_features,
    road_features,
    route_features,
)
from sim.tables import ROAD_CLASSES
from sim.world import (
    View,
    World,
    exists,
    logged_world,
    row_of,
    simulated_world,
    world_of,
)


@dataclass(frozen=True)
class ObservationConfig:
    """How much a controlled object sees."""

    history: int = 3
    """States per object, the current one included (H)."""
    neighbours: int = 16
    """Nearest other objects seen."""
    radius: float = 60.0
    """Objects and lights farther than this [m] are not seen."""
    road_rows: int = 64
    """Road segments seen, at most the bank's 64."""
    lights: int = 4
    """Nearest traffic lights seen."""
    route_points: int = 8
    """Points ahead on the logged route."""
    route_gap: float = 4.0
    """Distance between them along it [m]."""

    def __post_init__(self) -> None:
        """Refuses sizes that leave nothing to see or ask for more than is stored."""
        if self.history < 2:
            raise ValueError(f"history={self.history} must be >= 2 (yaw rate)")
        if not 1 <= self.road_rows <= 64:
            raise ValueError(f"road_rows={self.road_rows} must be 1 to 64")


class Observation(NamedTuple):
    """The network's input for one object."""

    ego: Float[Array, " ego"]
    agents: Float[Array, "neighbours agent"]
    agents_valid: Bool[Array, " neighbours"]
    road: Float[Array, "rows road"]
    road_valid: Bool[Array, " rows"]
    lights: Float[Array, "lights light"]
    lights_valid: Bool[Array, " lights"]


class ObservationSizes(NamedTuple):
    """The lengths of `Observation`'s axes."""

    ego: int
    neighbours: int
    agent: int
    rows: int
    road: int
    lights: int
    light: int


def observation_sizes(config: ObservationConfig) -> ObservationSizes:
    """The sizes that `observe` returns under this configuration."""
    return ObservationSizes(
        ego=5 + 4 * (config.history - 1) + 5 + 2 * config.route_points,
        neighbours=config.neighbours,
        agent=AGENT_STEP_FEATURES * config.history + AGENT_FEATURES,
        rows=config.road_rows,
        road=5 + len(ROAD_CLASSES),
        lights=config.lights,
        light=2 + LIGHT_CLASSES,
    )


def observe(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    """What each controlled object of one scene sees; axis `controlled` in front.

    They see one another where they are simulated and all others where the log has
    them. An empty slot sees nothing: all is 0 and masked.
    """
    if view.controlled.shape[0] == 1:
        # Nobody but itself sees where it is simulated: of the others, only those that
        # it sees are read.
        def seen(chosen: Int[Array, " neighbours"]) -> World:
            return logged_world(bank, view, chosen)

        log = bank.log[view.scene, view.step]
        x, y, there = log[:, 0], log[:, 1], bank.log_valid[view.scene, view.step]
    else:
        world = world_of(bank, view)

        def seen(chosen: Int[Array, " neighbours"]) -> World:
            return World(*(value[chosen] for value in world))

        x, y, there = world.motion[:, -1, 0], world.motion[:, -1, 1], world.valid[:, -1]
    others = Others(x, y, there, seen)
    one = functools.partial(_observe_one, bank, view.scene, view.step, others, config)
    return jax.vmap(one)(view.controlled, view.history, view.history_valid)


def observe_first(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    """What the first controlled object sees; the others are where they are simulated.

    `observe`'s first, for views that are many and of one object each: of the others'
    states only those that it sees are read.
    """
    row, own = bank.log[view.scene, view.step], view.controlled
    now, now_valid = view.history[:, -1], view.history_valid[:, -1]
    others = Others(
        row[:, 0].at[own].set(now[:, 0], mode="drop"),
        row[:, 1].at[own].set(now[:, 1], mode="drop"),
        bank.log_valid[view.scene, view.step].at[own].set(now_valid, mode="drop"),
        functools.partial(simulated_world, bank, view),
    )
    return _observe_one(
        bank,
        view.scene,
        view.step,
        others,
        config,
        own[0],
        view.history[0],
        view.history_valid[0],
    )


class Others(NamedTuple):
    """All objects of a scene now, and the last states of some of them."""

    x: Float[Array, " objects"]  # m
    y: Float[Array, " objects"]
    there: Bool[Array, " objects"]
    seen: Callable[[Int[Array, " some"]], World]


def _observe_one(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    others: Others,
    config: ObservationConfig,
    controlled: Int[Array, ""],
    history: Float[Array, "history 5"],
    history_valid: Bool[Array, " history"],
) -> Observation:
    there, own = exists(bank, controlled), row_of(bank, controlled)
    now = history[-1]
    frame = Frame(now[0], now[1], jnp.cos(now[2]), jnp.sin(now[2]))
    radius = jnp.where(there, config.radius, 0.0)
    chosen, agents_valid = nearest_agents(
        others.x,
        others.y,
        others.there & (jnp.arange(others.x.shape[0]) != controlled),
        frame,
        config.neighbours,
        radius,
    )
    road, road_valid = road_features(bank, scene, there, frame, config.road_rows)
    lights, lights_valid = light_features(
        bank, scene, step, frame, config.lights, radius
    )
    route = route_features(
        bank, scene, own, now, frame, config.route_points, config.route_gap
    )
    size = bank.log[scene, step, own, 6:8]
    ego = jnp.concatenate([own_features(history, history_valid, size, frame), route])
    return Observation(
        ego=jnp.where(there, ego, 0.0),
        agents=agent_features(others.seen(chosen), agents_valid, frame),
        agents_valid=agents_valid,
        road=road,
        road_valid=road_valid,
        lights=lights,
        lights_valid=lights_valid,
    )


def observe_batch(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    """`observe` for a batch of scenes, compiled apart from the program around it.

    `view` has the axis `batch` in front, the result `batch controlled`.

    Fused with its callers its last bits would depend on them, and a row rendered by
    the learner would differ from what its actor saw. XLA drops optimisation barriers
    before it fuses on a CPU, but never fuses across a call that it may not inline
    (CPU only: not tried elsewhere). A batch of one object is computed as two: axes of
    length one compile to other arithmetic.
    """
    return _apart(_observe_views, bank, view, config, view.controlled.size == 1)


def observe_first_batch(
    bank: Bank, view: View, config: ObservationConfig
) -> Observation:
    """What the first controlled object of each scene sees, amid the others.

    As `observe_batch`, without what the others see: axis `batch` in front.
    """
    if view.controlled.shape[1] == 1:
        seen = observe_batch(bank, view, config)
        return jax.tree.map(lambda values: values[:, 0], seen)
    return _apart(_observe_firsts, bank, view, config, view.controlled.shape[0] == 1)


def _apart(
    observing: Callable[[Bank, View, ObservationConfig], Observation],
    bank: Bank,
    view: View,
    config: ObservationConfig,
    alone: bool,
) -> Observation:
    if alone:
        view = jax.tree.map(lambda value: jnp.concatenate([value, value]), view)
    batched = apart(observing(bank, view, config))
    return jax.tree.map(lambda value: value[:1], batched) if alone else batched


@functools.partial(jax.jit, static_argnames="config")
def _observe_views(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    return jax.vmap(observe, in_axes=(None, 0, None))(bank, view, config)


@functools.partial(jax.jit, static_argnames="config")
def _observe_firsts(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    return jax.vmap(observe_first, in_axes=(None, 0, None))(bank, view, config)
