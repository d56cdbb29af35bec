"""The parts of an observation, each a pure function of the bank and the object's pose.

`sim.observation` puts them together and says what they mean.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim import smallest, tables
from sim.bank import Bank
from sim.metrics import route_position
from sim.scene import LightState
from sim.world import World

POSITION_SCALE = 30.0  # m
SPEED_SCALE = 15.0  # m/s
SIZE_SCALE = 5.0  # m
STATE_FIELDS = 5  # x, y, yaw, v_x, v_y
AGENT_STEP_FEATURES = 7  # x, y, cos, sin, v_x, v_y, valid
AGENT_FEATURES = 5  # length, width, vehicle, pedestrian, cyclist
LIGHT_CLASSES = 4  # go, caution, stop, unknown


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


def own_features(
    history: Float[Array, "history 5"],
    history_valid: Bool[Array, " history"],
    size: Float[Array, "2"],
    frame: Frame,
) -> Float[Array, " own"]:
    """Its speed, size and turning, then the past poses, oldest first."""
    now = history[-1]
    speed = jnp.hypot(now[3], now[4])
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
    return jnp.concatenate([own, (past_features * past_valid[:, None]).ravel()])


def route_features(
    bank: Bank,
    scene: Int[Array, ""],
    controlled: Int[Array, ""],
    now: Float[Array, "5"],
    frame: Frame,
    points: int,
    gap: float,
) -> Float[Array, " route"]:
    """Where the route is and goes on, and how much of the log's is left."""
    route = bank.route[scene, controlled]
    spacing = bank.route_spacing[scene, controlled]
    position = route_position(bank, scene, controlled, now[0], now[1])
    ahead = jnp.arange(points + 1, dtype=jnp.float32) * gap
    at = jnp.clip((position.along + ahead) / spacing, 0.0, route.shape[0] - 1.001)
    index = at.astype(jnp.int32)
    part = (at - index.astype(jnp.float32))[:, None]
    knots = route[index] * (1 - part) + route[index + 1] * part
    x, y = frame.place(knots[:, 0], knots[:, 1])
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


def agent_features(
    seen: World, used: Bool[Array, " neighbours"], frame: Frame
) -> Float[Array, "neighbours agent"]:
    """The chosen objects seen from the object; 0 where a slot is not used.

    Columns, for each state oldest first: x, y, cos, sin, v_x, v_y, 1; then length,
    width and whether it is a vehicle, pedestrian, cyclist.

    A product with a small matrix: measured 0.34 us per observer, 0.56 with the columns
    worked out one by one, 1.35 with all of them at once beside their partners.
    """
    neighbours = used.shape[0]
    zero, one = jnp.zeros(()), jnp.ones(())
    origin = jnp.stack([frame.x, frame.y, zero, zero, zero, zero])
    cos, sin = frame.cos, frame.sin
    turns = []
    for pair, scale in enumerate((POSITION_SCALE, 1.0, SPEED_SCALE)):
        c, s = cos / scale, sin / scale
        turns.append(jnp.stack([zero] * (2 * pair) + [c, -s] + [zero] * (5 - 2 * pair)))
        turns.append(jnp.stack([zero] * (2 * pair) + [s, c] + [zero] * (5 - 2 * pair)))
    turned = jnp.matmul(
        (seen.motion - origin[None, None]).reshape(-1, 6),
        jnp.stack(turns),
        precision=jax.lax.Precision.HIGHEST,
    )
    there = jnp.stack([zero] * 6 + [one])[None]
    shown = (seen.valid & used[:, None]).reshape(-1, 1)
    motion = jnp.where(shown, turned + there, 0.0).reshape(neighbours, -1)
    kinds = seen.kind[:, None] == jnp.array([1, 2, 3], seen.kind.dtype)[None]
    fixed = jnp.concatenate([seen.size / SIZE_SCALE, kinds.astype(jnp.float32)], -1)
    return jnp.concatenate([motion, jnp.where(used[:, None], fixed, 0.0)], -1)


def nearest_agents(
    x: Float[Array, " objects"],
    y: Float[Array, " objects"],
    there: Bool[Array, " objects"],
    frame: Frame,
    neighbours: int,
    radius: Float[Array, ""],
) -> tuple[Int[Array, " neighbours"], Bool[Array, " neighbours"]]:
    """The objects that are there within `radius`, nearest first, and the slots used."""
    x, y = x - frame.x, y - frame.y
    squared = x * x + y * y
    return smallest.nearest(squared, there & (squared < radius**2), neighbours)


def cell_of(
    bank: Bank, scene: Int[Array, ""], x: Float[Array, ""], y: Float[Array, ""]
) -> Int[Array, ""]:
    """The number of a point's cell; outside the grid, the nearest cell's."""
    shape = bank.grid_shape[scene]
    point = jnp.stack([x, y])
    cell = ((point - bank.grid_origin[scene]) / tables.CELL).astype(jnp.int32)
    cell = jnp.clip(cell, 0, shape - 1)
    return bank.cell_start[scene] + cell[0] * shape[1] + cell[1]


def road_features(
    bank: Bank,
    scene: Int[Array, ""],
    there: Bool[Array, ""],
    frame: Frame,
    rows: int,
) -> tuple[Float[Array, "rows road"], Bool[Array, " rows"]]:
    """The segments of the object's cell, nearest to its centre first, if it is there.

    Measured: with the ends, lengths and classes worked out for every row 0.55 us per
    object, from ready `segment_rows` 0.28; a second table for the exchanged columns
    0.53.
    """
    row = bank.cell_row[cell_of(bank, scene, frame.x, frame.y)]
    row, has_row = jnp.maximum(row, 0), row >= 0
    valid = jnp.arange(rows) < bank.row_count[row].astype(jnp.int32)
    valid = valid & has_row & there
    near = bank.rows[row, :rows].astype(jnp.int32) + bank.segment_start[scene]
    segment = bank.segment_rows[near]
    zero = jnp.zeros(())
    x, y = frame.x, frame.y
    cos, sin = frame.cos, frame.sin
    scale = POSITION_SCALE
    origin = jnp.stack([x, y, zero, zero])[None]
    crossed = jnp.stack([y, x, zero, zero])[None]
    straight = jnp.stack([cos / scale, cos / scale, cos, cos])[None]
    across = jnp.stack([sin / scale, -sin / scale, sin, -sin])[None]
    turned = (segment[:, :4] - origin) * straight
    turned += (segment[:, np.array([1, 0, 3, 2])] - crossed) * across
    features = jnp.concatenate(
        [turned, segment[:, 4:5] / SIZE_SCALE, segment[:, 5:]], -1
    )
    return jnp.where(valid[:, None], features, 0.0), valid


def light_features(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    frame: Frame,
    count: int,
    radius: Float[Array, ""],
) -> tuple[Float[Array, "lights light"], Bool[Array, " lights"]]:
    """The nearest traffic lights within `radius`, and which slots they fill."""
    position = bank.light_position[scene]
    x, y = position[:, 0] - frame.x, position[:, 1] - frame.y
    squared = x * x + y * y
    seen = (jnp.arange(squared.shape[0]) < bank.lights[scene]) & (squared < radius**2)
    chosen, valid = smallest.nearest(squared, seen, count)
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
