"""The parts of an observation, each a pure function of the bank and the object's pose.

`sim.observation` puts them together and says what they mean.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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
    world: World,
    kind: Int[Array, " objects"],
    own: Int[Array, ""],
    frame: Frame,
    neighbours: int,
    radius: Float[Array, ""],
) -> tuple[Float[Array, "neighbours agent"], Bool[Array, " neighbours"]]:
    """The valid others nearest to object `own` within `radius`, and their slots."""
    x, y = world.state[-1, :, 0] - frame.x, world.state[-1, :, 1] - frame.y
    squared = x * x + y * y
    seen = world.valid[-1] & (squared < radius**2)
    seen = seen & (jnp.arange(squared.shape[0]) != own)
    chosen, valid = nearest(squared, seen, neighbours)
    state = world.state[:, chosen]
    there = (world.valid[:, chosen] & valid[None])[..., None]
    x, y = frame.place(state[..., 0], state[..., 1])
    v_x, v_y = frame.turn(state[..., 3], state[..., 4])
    cos, sin = frame.turn(jnp.cos(state[..., 2]), jnp.sin(state[..., 2]))
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
    size, kind = world.size[chosen], kind[chosen]
    fixed = jnp.stack(
        [
            size[:, 0] / SIZE_SCALE,
            size[:, 1] / SIZE_SCALE,
            *((kind == k).astype(jnp.float32) for k in (1, 2, 3)),
        ],
        -1,
    )
    features = jnp.concatenate([motion.reshape(neighbours, -1), fixed], -1)
    return jnp.where(valid[:, None], features, 0.0), valid


def nearest(
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
    chosen = jnp.where(match, index[None], 0).sum(1)
    return chosen, (match & seen[None]).any(1)


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
    chosen, valid = nearest(squared, seen, count)
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
