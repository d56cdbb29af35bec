"""What a controlled object sees: fixed-size features in its own frame.

A pure function of the scene, the step and the last H states of the controlled object,
so that a transition's row of states renders, anywhere, the very observation that its
actor acted on. The frame is the object's: x ahead, y to its left, origin at its centre.
Positions are divided by `POSITION_SCALE`, speeds by `SPEED_SCALE`; one-hot types and
cosines stand as they are. Values under a False mask are 0.

- ego: speed, size, own past H-1 poses, curvature-free motion (yaw rate, acceleration
  from the last two states), distance and bearing along the logged route: the offset
  from it, the heading relative to it and `route_points` points ahead on it, and what is
  left of it. The route's geometry is an input (the benchmark's agents are given theirs);
  its timing is not.
- agents: the nearest valid neighbours, each with H steps of pose and velocity.
- road: the cell's nearest map segments (`sim.tables`), nearest to the cell's centre
  first: middle, half extent, unit direction, kind.
- lights: the nearest traffic lights with their state.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim import tables
from sim.bank import Bank
from sim.metrics import route_position
from sim.scene import LightState, RoadKind

POSITION_SCALE = 30.0  # m
SPEED_SCALE = 15.0  # m/s
SIZE_SCALE = 5.0  # m
STATE_FIELDS = 5  # x, y, yaw, v_x, v_y
AGENT_STEP_FEATURES = 7  # x, y, cos, sin, v_x, v_y, valid
AGENT_FEATURES = 5  # length, width, vehicle, pedestrian, cyclist
LIGHT_CLASSES = 4  # go, caution, stop, unknown


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


class Frame(NamedTuple):
    """The controlled object's frame."""

    x: Float[Array, ""]  # m
    y: Float[Array, ""]  # m
    cos: Float[Array, ""]
    sin: Float[Array, ""]

    def place(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """A point of the map, seen from the object [m]."""
        return self.turn(x - self.x, y - self.y)

    def turn(
        self, x: Float[Array, "*n"], y: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """A direction of the map, seen from the object."""
        return self.cos * x + self.sin * y, self.cos * y - self.sin * x


def observe(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, ""],
    history: Float[Array, "history 5"],
    history_valid: Bool[Array, " history"],
    config: ObservationConfig,
) -> Observation:
    """The observation of object `controlled` at `step`; all others replay the log.

    `history` holds its simulated states (x, y, yaw, v_x, v_y), oldest first, the last
    of them at `step`.
    """
    now = history[-1]
    frame = Frame(now[0], now[1], jnp.cos(now[2]), jnp.sin(now[2]))
    agents, agents_valid = _agents(bank, scene, step, controlled, frame, config)
    road, road_valid = _road(bank, scene, frame, config)
    lights, lights_valid = _lights(bank, scene, step, frame, config)
    return Observation(
        ego=_ego(bank, scene, step, controlled, history, history_valid, frame, config),
        agents=agents,
        agents_valid=agents_valid,
        road=road,
        road_valid=road_valid,
        lights=lights,
        lights_valid=lights_valid,
    )


def _ego(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, ""],
    history: Float[Array, "history 5"],
    history_valid: Bool[Array, " history"],
    frame: Frame,
    config: ObservationConfig,
) -> Float[Array, " ego"]:
    now = history[-1]
    speed = jnp.hypot(now[3], now[4])
    size = bank.log[scene, step, controlled, 6:8]
    past = history[:-1]
    past_valid = history_valid[:-1].astype(jnp.float32)
    x, y = frame.place(past[:, 0], past[:, 1])
    turned = past[:, 2] - now[2]
    past_features = jnp.stack(
        [
            x / POSITION_SCALE,
            y / POSITION_SCALE,
            jnp.sin(turned),
            jnp.hypot(past[:, 3], past[:, 4]) / SPEED_SCALE,
        ],
        -1,
    )
    turn_rate = past_valid[-1] * jnp.sin(now[2] - past[-1, 2]) * 5.0
    pickup = past_valid[-1] * (speed - jnp.hypot(past[-1, 3], past[-1, 4]))
    own = jnp.stack(
        [
            speed / SPEED_SCALE,
            size[0] / SIZE_SCALE,
            size[1] / SIZE_SCALE,
            turn_rate,
            pickup,
        ]
    )
    return jnp.concatenate(
        [
            own,
            (past_features * past_valid[:, None]).ravel(),
            _route(bank, scene, controlled, now, frame, config),
        ]
    )


def _route(
    bank: Bank,
    scene: Int[Array, ""],
    controlled: Int[Array, ""],
    now: Float[Array, "5"],
    frame: Frame,
    config: ObservationConfig,
) -> Float[Array, " route"]:
    """Where the route is and goes on, and how much of the log's is left."""
    route = bank.route[scene, controlled]
    spacing = bank.route_spacing[scene, controlled]
    position = route_position(bank, scene, controlled, now[0], now[1])
    ahead = jnp.arange(config.route_points + 1, dtype=jnp.float32) * config.route_gap
    at = jnp.clip((position.along + ahead) / spacing, 0.0, route.shape[0] - 1.001)
    index = at.astype(jnp.int32)
    part = (at - index.astype(jnp.float32))[:, None]
    points = route[index] * (1 - part) + route[index + 1] * part
    x, y = frame.place(points[:, 0], points[:, 1])
    here = route[index[0] + 1] - route[index[0]]
    along_x, along_y = frame.turn(here[0], here[1])
    norm = jnp.maximum(jnp.hypot(along_x, along_y), 1e-6)
    left = bank.route_end[scene, controlled] - position.along
    state = jnp.stack(
        [
            along_x / norm,
            along_y / norm,
            y[0] / 2.0,
            jnp.clip(left / POSITION_SCALE, -1.0, 2.0),
            jnp.clip(left / 5.0, -1.0, 1.0),
        ]
    )
    return jnp.concatenate([state, x[1:] / POSITION_SCALE, y[1:] / POSITION_SCALE])


def _agents(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, ""],
    frame: Frame,
    config: ObservationConfig,
) -> tuple[Float[Array, "neighbours agent"], Bool[Array, " neighbours"]]:
    x, y = bank.log[scene, step, :, 0] - frame.x, bank.log[scene, step, :, 1] - frame.y
    squared = x * x + y * y
    objects = squared.shape[0]
    seen = bank.log_valid[scene, step] & (squared < config.radius**2)
    seen = seen & (jnp.arange(objects) != controlled)
    chosen, valid = _nearest(squared, seen, config.neighbours)
    steps = jnp.maximum(step - jnp.arange(config.history - 1, -1, -1), 0)
    log = bank.log[scene, steps[:, None], chosen[None]]
    there = (bank.log_valid[scene, steps[:, None], chosen[None]] & valid[None])[
        ..., None
    ]
    x, y = frame.place(log[..., 0], log[..., 1])
    v_x, v_y = frame.turn(log[..., 4], log[..., 5])
    cos, sin = frame.turn(jnp.cos(log[..., 3]), jnp.sin(log[..., 3]))
    motion = jnp.stack(
        [
            x / POSITION_SCALE,
            y / POSITION_SCALE,
            cos,
            sin,
            v_x / SPEED_SCALE,
            v_y / SPEED_SCALE,
            jnp.ones_like(x),
        ],
        -1,
    )
    motion = jnp.where(there, motion, 0.0).transpose(1, 0, 2)
    kind = bank.object_type[scene, chosen]
    fixed = jnp.stack(
        [
            log[-1, :, 6] / SIZE_SCALE,
            log[-1, :, 7] / SIZE_SCALE,
            *((kind == k).astype(jnp.float32) for k in (1, 2, 3)),
        ],
        -1,
    )
    features = jnp.concatenate([motion.reshape(config.neighbours, -1), fixed], -1)
    return jnp.where(valid[:, None], features, 0.0), valid


def _nearest(
    squared: Float[Array, " objects"], seen: Bool[Array, " objects"], count: int
) -> tuple[Int[Array, " count"], Bool[Array, " count"]]:
    """The `count` seen objects nearest first, ties by index; and which slots are used.

    Ranks by counting how many are nearer: dense comparisons vectorise, a sort or
    `top_k` does not (measured on a CPU: several times slower up to 128 objects).
    """
    objects = squared.shape[0]
    key = jnp.where(seen, squared, jnp.inf)
    index = jnp.arange(objects)
    nearer = (key[None] < key[:, None]) | (
        (key[None] == key[:, None]) & (index[None] < index[:, None])
    )
    rank = nearer.sum(1)
    match = rank[None] == jnp.arange(count)[:, None]
    chosen = (match * index[None]).sum(1)
    return chosen, (match & seen[None]).any(1)


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
    bank: Bank, scene: Int[Array, ""], frame: Frame, config: ObservationConfig
) -> tuple[Float[Array, "rows road"], Bool[Array, " rows"]]:
    cell = cell_of(bank, scene, frame.x, frame.y)
    rows = config.road_rows
    row = bank.cell_row[cell]
    near = bank.rows[jnp.maximum(row, 0), :rows].astype(jnp.int32)
    near = near + bank.segment_start[scene]
    valid = jnp.arange(rows) < bank.row_count[jnp.maximum(row, 0)].astype(jnp.int32)
    valid = valid & (row >= 0)
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


def _lights(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    frame: Frame,
    config: ObservationConfig,
) -> tuple[Float[Array, "lights light"], Bool[Array, " lights"]]:
    position = bank.light_position[scene]
    x, y = position[:, 0] - frame.x, position[:, 1] - frame.y
    squared = x * x + y * y
    seen = (jnp.arange(squared.shape[0]) < bank.lights[scene]) & (
        squared < config.radius**2
    )
    chosen, valid = _nearest(squared, seen, config.lights)
    x, y = frame.place(position[chosen, 0], position[chosen, 1])
    light = _light_class(bank.light_state[scene, step, chosen].astype(jnp.int32))
    one_hot = light[:, None] == jnp.arange(LIGHT_CLASSES)[None]
    features = jnp.concatenate(
        [
            jnp.stack([x, y], -1) / POSITION_SCALE,
            one_hot.astype(jnp.float32),
        ],
        -1,
    )
    return jnp.where(valid[:, None], features, 0.0), valid


def _light_class(state: Int[Array, " lights"]) -> Int[Array, " lights"]:
    """0 go, 1 caution, 2 stop, 3 unknown; arrows and flashing count as their colour."""
    classes = {
        LightState.UNKNOWN: 3,
        LightState.ARROW_STOP: 2,
        LightState.ARROW_CAUTION: 1,
        LightState.ARROW_GO: 0,
        LightState.STOP: 2,
        LightState.CAUTION: 1,
        LightState.GO: 0,
        LightState.FLASHING_STOP: 2,
        LightState.FLASHING_CAUTION: 1,
    }
    return jnp.array([classes[light] for light in LightState], jnp.int32)[state]


def observe_batch(
    bank: Bank,
    scene: Int[Array, " batch"],
    step: Int[Array, " batch"],
    controlled: Int[Array, " batch"],
    history: Float[Array, "batch history 5"],
    history_valid: Bool[Array, "batch history"],
    config: ObservationConfig,
) -> Observation:
    """`observe` for a batch; the barriers keep XLA from fusing it with its callers.

    Fused, its last bits depend on the program around it, and a row rendered by the
    learner would differ from what its actor saw.
    """
    inputs = (bank, scene, step, controlled, history, history_valid)
    inputs = jax.lax.optimization_barrier(inputs)
    batched = jax.vmap(
        lambda *row: observe(inputs[0], *row, config=config),
    )(*inputs[1:])
    return Observation(*jax.lax.optimization_barrier(tuple(batched)))
