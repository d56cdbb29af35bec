"""Dynamics of one object: playback, Delta, Bicycle, steering wheel; inverses, grids.

The Waymax paper (Gulino et al., 2023), appendix A.1. States are x, y [m], yaw [rad],
v_x, v_y [m/s] in the map frame; `dt` is the step length [s].

Delta, action (dx, dy, dtheta):
    x' = x + dx        y' = y + dy        theta' = theta + dtheta
    v_x' = dx / dt     v_y' = dy / dt
Bicycle, action (acceleration a [m/s^2], curvature kappa [1/m]):
    v      = sqrt(v_x^2 + v_y^2)
    x'     = x + v_x dt + 1/2 a cos(theta) dt^2        y' likewise with sin
    theta' = theta + kappa (v dt + 1/2 a dt^2)         v'  = v + a dt
    v_x'   = v' cos(theta')                            v_y' = v' sin(theta')
Steering, action (acceleration a [m/s^2], steering wheel's angle theta_w [rad]): Bicycle
with kappa = sin(theta_w / STEER_RATIO) / L, L the axle distance [m].
State playback, action (x, y, theta, v_x, v_y): the object takes that state.

Departures, where the paper is silent or misprinted:
- The inverse bicycle uses atan2(v_y', v_x') as the heading of the new velocity; the
  printed arctan(v_x'/v_y') does not invert the forward model.
- Below `SLOW` at either end the velocity's heading is noise: the curvature is 0 there
  and, in `bicycle_replay`, the recorded yaw is kept.
- `limit_reverse`: a policy's braking stops at v' = 0 (a is raised to -v/dt), for the
  printed model would turn the velocity round at once. Inverse actions never need it.
- Discrete Delta actions are grids in the object's own frame, turned to the map's before
  the printed equation: a grid along the map's axes would tie the policy to north.
"""

import enum
from dataclasses import dataclass, field
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

SLOW = 0.6  # m/s; the paper leaves the limit open


@dataclass(frozen=True)
class SteeringWheel:
    """How a steering wheel's angle bends the path; one for all vehicles."""

    axle_distance: float = 2.9
    """Between the axles [m]; a mid-size car's."""
    steer_ratio: float = 15.0
    """The steering wheel's angle over the front wheels'."""


class ObjectState(NamedTuple):
    """One object's simulated state, map frame."""

    x: Float[Array, ""]  # m
    y: Float[Array, ""]  # m
    yaw: Float[Array, ""]  # rad, counter-clockwise from x, in [-pi, pi)
    v_x: Float[Array, ""]  # m/s
    v_y: Float[Array, ""]  # m/s


def wrap(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """The angle in [-pi, pi)."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def playback(state: ObjectState, given: ObjectState) -> ObjectState:
    """Takes the given state, wherever the object was."""
    return given


def playback_inverse(state: ObjectState, following: ObjectState) -> ObjectState:
    """The playback action that leads from one state to the following: that one."""
    return following


def delta(state: ObjectState, action: Float[Array, "3"], dt: float) -> ObjectState:
    """Moves by (dx [m], dy [m], dyaw [rad]), map frame."""
    return ObjectState(
        x=state.x + action[0],
        y=state.y + action[1],
        yaw=wrap(state.yaw + action[2]),
        v_x=action[0] / dt,
        v_y=action[1] / dt,
    )


def delta_inverse(state: ObjectState, following: ObjectState) -> Float[Array, "3"]:
    """The Delta action that leads from one state to the following."""
    return jnp.stack(
        [
            following.x - state.x,
            following.y - state.y,
            wrap(following.yaw - state.yaw),
        ]
    )


def bicycle(state: ObjectState, action: Float[Array, "2"], dt: float) -> ObjectState:
    """Accelerates by a [m/s^2] along a path of curvature kappa [1/m]."""
    acceleration, curvature = action[0], action[1]
    speed = jnp.hypot(state.v_x, state.v_y)
    half = 0.5 * acceleration * dt**2
    yaw = wrap(state.yaw + curvature * (speed * dt + half))
    new_speed = speed + acceleration * dt
    return ObjectState(
        x=state.x + state.v_x * dt + half * jnp.cos(state.yaw),
        y=state.y + state.v_y * dt + half * jnp.sin(state.yaw),
        yaw=yaw,
        v_x=new_speed * jnp.cos(yaw),
        v_y=new_speed * jnp.sin(yaw),
    )


def bicycle_inverse(
    state: ObjectState, following: ObjectState, dt: float
) -> Float[Array, "2"]:
    """The Bicycle action that leads from one state to the following (A.1)."""
    speed = jnp.hypot(state.v_x, state.v_y)
    new_speed = jnp.hypot(following.v_x, following.v_y)
    acceleration = (new_speed - speed) / dt
    turn = wrap(jnp.arctan2(following.v_y, following.v_x) - state.yaw)
    travelled = speed * dt + 0.5 * acceleration * dt**2  # the speeds' mean times dt
    slow = (speed < SLOW) | (new_speed < SLOW)
    curvature = jnp.where(slow, 0.0, turn / jnp.where(slow, 1.0, travelled))
    return jnp.stack([acceleration, curvature])


def bicycle_replay(
    state: ObjectState, following: ObjectState, dt: float
) -> ObjectState:
    """Follows the log by the Bicycle action from `state` to the log's `following`.

    Below `SLOW`, where the action holds no curvature, the recorded yaw is used.
    """
    moved = bicycle(state, bicycle_inverse(state, following, dt), dt)
    return _with_recorded_yaw(state, following, moved)


def steering_replay(
    state: ObjectState, following: ObjectState, wheel: SteeringWheel, dt: float
) -> ObjectState:
    """`bicycle_replay` through the steering wheel."""
    moved = steering(state, steering_inverse(state, following, wheel, dt), wheel, dt)
    return _with_recorded_yaw(state, following, moved)


def _with_recorded_yaw(
    state: ObjectState, following: ObjectState, moved: ObjectState
) -> ObjectState:
    """`moved` with the yaw of `following` where the inverse could not tell one."""
    slow = (jnp.hypot(state.v_x, state.v_y) < SLOW) | (
        jnp.hypot(following.v_x, following.v_y) < SLOW
    )
    speed = jnp.hypot(moved.v_x, moved.v_y)
    yaw = jnp.where(slow, following.yaw, moved.yaw)
    return moved._replace(yaw=yaw, v_x=speed * jnp.cos(yaw), v_y=speed * jnp.sin(yaw))


def limit_reverse(
    state: ObjectState, action: Float[Array, "2"], dt: float
) -> Float[Array, "2"]:
    """Raises a Bicycle action's acceleration so that the object stops, not reverses."""
    speed = jnp.hypot(state.v_x, state.v_y)
    return action.at[0].max(-speed / dt)


def steering_to_curvature(
    wheel: Float[Array, "..."], axle_distance: float, steer_ratio: float
) -> Float[Array, "..."]:
    """Curvature [1/m] of a steering wheel's angle [rad]: sin(wheel / ratio) / L."""
    return jnp.sin(wheel / steer_ratio) / axle_distance


def curvature_to_steering(
    curvature: Float[Array, "..."], axle_distance: float, steer_ratio: float
) -> Float[Array, "..."]:
    """The steering wheel's angle [rad] that gives a curvature; its inverse."""
    return steer_ratio * jnp.arcsin(jnp.clip(curvature * axle_distance, -1.0, 1.0))


def steering(
    state: ObjectState, action: Float[Array, "2"], wheel: SteeringWheel, dt: float
) -> ObjectState:
    """Accelerates by a [m/s^2] with the steering wheel at an angle [rad]."""
    return bicycle(state, _as_bicycle(action, wheel), dt)


def steering_inverse(
    state: ObjectState, following: ObjectState, wheel: SteeringWheel, dt: float
) -> Float[Array, "2"]:
    """The Steering action that leads from one state to the following.

    A curvature beyond 1 / axle distance, which no angle gives, is cut there.
    """
    action = bicycle_inverse(state, following, dt)
    angle = curvature_to_steering(action[1], wheel.axle_distance, wheel.steer_ratio)
    return jnp.stack([action[0], angle])


def _as_bicycle(action: Float[Array, "2"], wheel: SteeringWheel) -> Float[Array, "2"]:
    curvature = steering_to_curvature(action[1], wheel.axle_distance, wheel.steer_ratio)
    return jnp.stack([action[0], curvature])


class ActionSpace(enum.StrEnum):
    """The discrete action spaces: the paper's, and one over the steering wheel."""

    BICYCLE = "bicycle-discrete"
    DELTA = "delta-discrete"
    STEERING = "steering-discrete"


@dataclass(frozen=True)
class ActionConfig:
    """A grid over a continuous action space; an action is one index into it.

    The paper leaves bins and limits open. Bins are spaced by the square of their
    distance from the middle, signs kept: fine around zero, where driving happens.
    """

    space: ActionSpace = ActionSpace.BICYCLE
    """Which dynamics the grid is over."""
    acceleration: float = 6.0
    """Bicycle: largest |a| [m/s^2]."""
    acceleration_bins: int = 7
    """Bicycle: bins of a, odd so that zero is one of them."""
    curvature: float = 0.3
    """Bicycle: largest |kappa| [1/m]; the benchmark's feasibility limit."""
    curvature_bins: int = 13
    """Bicycle: bins of kappa, odd."""
    wheel: float = 9.0
    """Steering: largest |angle| [rad] of the wheel; with `SteeringWheel`'s 0.19 1/m."""
    wheel_bins: int = 13
    """Steering: bins of the angle, odd; accelerations are Bicycle's."""
    steering: SteeringWheel = field(default_factory=SteeringWheel)
    """Steering: from the wheel's angle to curvature."""
    forward: float = 3.0
    """Delta: largest dx ahead [m] in one step (30 m/s at 10 Hz); none backwards."""
    forward_bins: int = 16
    """Delta: bins of dx from 0, evenly spaced."""
    sideways: float = 0.2
    """Delta: largest |dy| [m]."""
    sideways_bins: int = 3
    """Delta: bins of dy, odd."""
    turn: float = 0.2
    """Delta: largest |dyaw| [rad]."""
    turn_bins: int = 9
    """Delta: bins of dyaw, odd."""

    def __post_init__(self) -> None:
        """Refuses grids without a zero."""
        for name in ("acceleration", "curvature", "wheel", "sideways", "turn"):
            bins = getattr(self, f"{name}_bins")
            if bins < 1 or bins % 2 == 0:
                raise ValueError(f"{name}_bins={bins} must be odd, or no bin is zero")

    @property
    def count(self) -> int:
        """Number of actions."""
        if self.space == ActionSpace.BICYCLE:
            return self.acceleration_bins * self.curvature_bins
        if self.space == ActionSpace.STEERING:
            return self.acceleration_bins * self.wheel_bins
        return self.forward_bins * self.sideways_bins * self.turn_bins


def action_table(config: ActionConfig) -> Float[np.ndarray, "actions components"]:
    """The continuous action of every index; the first component varies slowest."""
    if config.space == ActionSpace.BICYCLE:
        axes = [
            _squared_bins(config.acceleration, config.acceleration_bins),
            _squared_bins(config.curvature, config.curvature_bins),
        ]
    elif config.space == ActionSpace.STEERING:
        axes = [
            _squared_bins(config.acceleration, config.acceleration_bins),
            _squared_bins(config.wheel, config.wheel_bins),
        ]
    else:
        axes = [
            np.linspace(0.0, config.forward, config.forward_bins),
            _squared_bins(config.sideways, config.sideways_bins),
            _squared_bins(config.turn, config.turn_bins),
        ]
    grid = np.meshgrid(*axes, indexing="ij")
    return np.stack([axis.ravel() for axis in grid], -1).astype(np.float32)


def _squared_bins(limit: float, bins: int) -> Float[np.ndarray, " bins"]:
    unit = np.linspace(-1.0, 1.0, bins) if bins > 1 else np.zeros(1)
    return limit * np.sign(unit) * unit**2


def apply_discrete(
    state: ObjectState, index: Int[Array, ""], config: ActionConfig, dt: float
) -> ObjectState:
    """One step of the action space's dynamics with the grid's action `index`."""
    return apply_continuous(state, jnp.asarray(action_table(config))[index], config, dt)


def apply_continuous(
    state: ObjectState,
    action: Float[Array, " components"],
    config: ActionConfig,
    dt: float,
) -> ObjectState:
    """One step with any action of the grid's space; Delta's in the object's frame."""
    if config.space == ActionSpace.BICYCLE:
        return bicycle(state, limit_reverse(state, action, dt), dt)
    if config.space == ActionSpace.STEERING:
        limited = limit_reverse(state, action, dt)
        return steering(state, limited, config.steering, dt)
    return delta(state, _turned(action, state.yaw), dt)


def nearest_action(
    state: ObjectState, action: Float[Array, " components"], config: ActionConfig
) -> Int[Array, ""]:
    """The grid's index nearest to a continuous action, each component by its limit."""
    table = action_table(config)
    action = in_own_frame(state, action, config)
    scale = np.abs(table).max(0)
    scale[scale == 0] = np.inf  # a single bin tells no two actions apart
    difference = (jnp.asarray(table) - action[None]) / jnp.asarray(scale)[None]
    return jnp.argmin((difference**2).sum(-1)).astype(jnp.int32)


def in_own_frame(
    state: ObjectState, action: Float[Array, " components"], config: ActionConfig
) -> Float[Array, " components"]:
    """An action of `inverse` as `apply_continuous` takes it: Delta's is turned."""
    if config.space == ActionSpace.DELTA:
        return _turned(action, -state.yaw)
    return action


def _turned(action: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "3"]:
    """(dx, dy, dyaw) with (dx, dy) turned counter-clockwise by `angle`."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack(
        [
            cos * action[0] - sin * action[1],
            sin * action[0] + cos * action[1],
            action[2],
        ]
    )


def inverse(
    state: ObjectState, following: ObjectState, config: ActionConfig, dt: float
) -> Float[Array, " components"]:
    """The continuous action of `config.space` that leads to the following state."""
    if config.space == ActionSpace.BICYCLE:
        return bicycle_inverse(state, following, dt)
    if config.space == ActionSpace.STEERING:
        return steering_inverse(state, following, config.steering, dt)
    return delta_inverse(state, following)


def replay(
    state: ObjectState, following: ObjectState, config: ActionConfig, dt: float
) -> ObjectState:
    """Follows the log from `state` through the continuous space of `config.space`."""
    if config.space == ActionSpace.BICYCLE:
        return bicycle_replay(state, following, dt)
    if config.space == ActionSpace.STEERING:
        return steering_replay(state, following, config.steering, dt)
    return delta(state, delta_inverse(state, following), dt)
