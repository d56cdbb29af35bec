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
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Float, Int

from sim import tables
from sim.bank import Bank
from sim.features import (
    AGENT_FEATURES,
    AGENT_STEP_FEATURES,
    LIGHT_CLASSES,
    POSITION_SCALE,
    SIZE_SCALE,
    Frame,
    agent_features,
    light_features,
    own_features,
    route_features,
)
from sim.scene import RoadKind
from sim.world import View, World, exists, row_of, world_of


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


ROAD_CLASSES = ("lane", "line", "edge", "stop sign", "crosswalk", "speed bump")


def _road_class(kind: Int[Array, "..."]) -> Int[Array, "..."]:
    """Index into `ROAD_CLASSES`; kinds are ordered so that bounds decide."""
    bounds = (
        RoadKind.LINE_UNKNOWN,
        RoadKind.EDGE_UNKNOWN,
        RoadKind.STOP_SIGN,
        RoadKind.CROSSWALK,
        RoadKind.SPEED_BUMP,
    )
    result = jnp.zeros_like(kind)
    for bound in bounds:
        result = result + (kind >= int(bound)).astype(kind.dtype)
    return result


def observe(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    """What each controlled object of one scene sees; axis `controlled` in front.

    They see one another where they are simulated and all others where the log has
    them. An empty slot sees nothing: all is 0 and masked.
    """
    world = world_of(bank, view)
    one = functools.partial(_observe_one, bank, view.scene, view.step, world, config)
    return jax.vmap(one)(view.controlled, view.history, view.history_valid)


def _observe_one(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    world: World,
    config: ObservationConfig,
    controlled: Int[Array, ""],
    history: Float[Array, "history 5"],
    history_valid: Bool[Array, " history"],
) -> Observation:
    there, own = exists(bank, controlled), row_of(bank, controlled)
    now = history[-1]
    frame = Frame(now[0], now[1], jnp.cos(now[2]), jnp.sin(now[2]))
    agents, agents_valid = agent_features(
        world,
        bank.object_type[scene],
        own,
        frame,
        neighbours=config.neighbours,
        radius=jnp.where(there, config.radius, 0.0),
    )
    road, road_valid = _road(bank, scene, there, frame, config)
    lights, lights_valid = light_features(
        bank,
        scene,
        step,
        frame,
        count=config.lights,
        radius=jnp.where(there, config.radius, 0.0),
    )
    route = route_features(
        bank,
        scene,
        own,
        now,
        frame,
        points=config.route_points,
        gap=config.route_gap,
    )
    ego = own_features(history, history_valid, world.size[own], frame)
    return Observation(
        ego=jnp.where(there, jnp.concatenate([ego, route]), 0.0),
        agents=agents,
        agents_valid=agents_valid,
        road=road,
        road_valid=road_valid,
        lights=lights,
        lights_valid=lights_valid,
    )


def cell_of(
    bank: Bank, scene: Int[Array, ""], x: Float[Array, ""], y: Float[Array, ""]
) -> Int[Array, ""]:
    """The number of a point's cell; outside the grid, the nearest cell's."""
    shape = bank.grid_shape[scene]
    point = jnp.stack([x, y])
    cell = ((point - bank.grid_origin[scene]) / tables.CELL).astype(jnp.int32)
    cell = jnp.clip(cell, 0, shape - 1)
    return bank.cell_start[scene] + cell[0] * shape[1] + cell[1]


def _road(
    bank: Bank,
    scene: Int[Array, ""],
    there: Bool[Array, ""],
    frame: Frame,
    config: ObservationConfig,
) -> tuple[Float[Array, "rows road"], Bool[Array, " rows"]]:
    cell = cell_of(bank, scene, frame.x, frame.y)
    rows = config.road_rows
    row = bank.cell_row[cell]
    near = bank.rows[jnp.maximum(row, 0), :rows].astype(jnp.int32)
    near = near + bank.segment_start[scene]
    valid = jnp.arange(rows) < bank.row_count[jnp.maximum(row, 0)].astype(jnp.int32)
    valid = valid & (row >= 0) & there
    segment = bank.segments[near]
    x0, y0 = frame.place(segment[:, 0], segment[:, 1])
    x1, y1 = frame.place(segment[:, 2], segment[:, 3])
    dx, dy = x1 - x0, y1 - y0
    length = jnp.hypot(dx, dy)
    norm = jnp.maximum(length, 1e-6)
    kind = _road_class(bank.segment_kind[near].astype(jnp.int32))
    one_hot = kind[:, None] == jnp.arange(len(ROAD_CLASSES))[None]
    geometry = jnp.stack(
        [
            (x0 + x1) / (2 * POSITION_SCALE),
            (y0 + y1) / (2 * POSITION_SCALE),
            dx / norm,
            dy / norm,
            length / SIZE_SCALE / 2,
        ],
        -1,
    )
    features = jnp.concatenate([geometry, one_hot.astype(jnp.float32)], -1)
    return jnp.where(valid[:, None], features, 0.0), valid


def observe_batch(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    """`observe` for a batch of scenes, compiled apart from the program around it.

    `view` has the axis `batch` in front, the result `batch controlled`.

    Fused with its callers its last bits would depend on them, and a row rendered by
    the learner would differ from what its actor saw. XLA drops optimisation barriers
    before it fuses on a CPU, but never fuses across a call that it may not inline
    (CPU only: not tried elsewhere). A batch of one object is computed as two: axes of
    length one compile to other arithmetic.
    """
    alone = view.controlled.shape == (1, 1)
    if alone:
        view = jax.tree.map(lambda value: jnp.concatenate([value, value]), view)
    apart = {"inlineable": "false"} if jax.default_backend() == "cpu" else {}
    with set_xla_metadata(**apart):  # type: ignore[no-untyped-call]
        batched = _observe_views(bank, view, config=config)
    return jax.tree.map(lambda value: value[:1], batched) if alone else batched


@functools.partial(jax.jit, static_argnames="config")
def _observe_views(bank: Bank, view: View, config: ObservationConfig) -> Observation:
    return jax.vmap(observe, in_axes=(None, 0, None))(bank, view, config)
