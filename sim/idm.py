"""IDM: the Intelligent Driver Model along each object's route, for any set of objects.

Treiber, Hennecke and Helbing, Congested traffic states in empirical observations and
microscopic simulations, Phys. Rev. E 62 (2000), eqs. 2 and 3 (with s_1 = 0):

    a(v, s, dv) = a_max [1 - (v / v_0)^4 - (s* / s)^2]
    s* = s_0 + max(0, v T + v dv / (2 sqrt(a_max b)))

with the bumper-to-bumper gap s and the closing speed dv = v - v_leader. The step is
Treiber and Kanagaraj's ballistic one (Physica A 419, 2015): v' = max(0, v + a dt), way
(v + v') dt / 2, or up to the standstill within the step.

Leaders are all objects whose boxes stand in the corridor ahead, which is as wide as the
own box and a margin and follows the path from the front bumper on; the one that asks
for the hardest braking decides. Closing speeds are taken along the path. Other
objects are where they are now; nothing is predicted: of two that merge side by side,
or whose paths cross, none yields before one is in the other's corridor.

Lines to stop at (`sim.stop_lines`) are standing leaders.

Beyond the model:
- v_0 falls before bends to what keeps the lateral acceleration comfortable.
- Above v_0 a driver brakes with at most b (the model's v^4 would make it an emergency).
- All braking is at most `hardest_braking`.
- Laterally an object follows the path's tangent; a distance and an angle from the path
  that it starts with decay with the way driven.

Who is not driven so: pedestrians, and whoever moves backwards along its route, replay
the log; objects whose log never moves 1 m stay, unless they stand on a lane.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sim import paths, route_metrics
from sim.agents import Agent, Decision, continuous, next_logged
from sim.bank import Bank
from sim.dynamics import wrap
from sim.environment import EnvironmentConfig, State, current_objects
from sim.paths import Boxes, Corridor, Path, Pose
from sim.scene import ObjectType
from sim.stop_lines import StopConfig, gap_to_stop
from sim.world import row_of

_PATIENT = 1e-3  # m/s and m: keeps divisions finite


@dataclass(frozen=True)
class IdmConfig:
    """The driver. Defaults are near Treiber and Kesting's for city traffic.

    (Traffic Flow Dynamics, 2013, table 11.2: 54 km/h, T 1 s, s_0 2 m, a 1 m/s^2,
    b 1.5 m/s^2, exponent 4; here they accelerate and brake as recorded drivers do.)
    """

    desired_speed: float = 15.0
    """v_0 [m/s] of vehicles on lanes without a known limit."""
    cyclist_speed: float = 5.0
    """v_0 [m/s] of cyclists."""
    time_headway: float = 1.2
    """T [s]."""
    standing_gap: float = 2.0
    """s_0 [m], bumper to bumper at rest."""
    acceleration: float = 1.5
    """a_max [m/s^2]."""
    braking: float = 2.0
    """b [m/s^2], comfortable."""
    hardest_braking: float = 8.0
    """No braking is harder [m/s^2]; the benchmark's feasibility limit is 10.4."""
    lateral_acceleration: float = 3.0
    """Most in a bend [m/s^2]."""
    stop: StopConfig = field(default_factory=StopConfig)
    """Lights and stop signs."""
    margin: float = 0.2
    """The corridor's, on both sides of the own box [m]."""
    in_lane: float = 1.0
    """Who stands throughout the log within this of a lane [m] waits; others park."""
    same_level: float = 3.0
    """Objects with more between their heights [m] are on another road."""
    slab: float = 2.5
    """Length of one box of the corridor [m]."""
    slabs: int = 40
    """Boxes of the corridor: it looks `slab` * `slabs` metres ahead."""
    settling: float = 10.0
    """Way [m] over which the distance from the path decays to 1/e."""
    turning: float = 3.0
    """Way [m] over which the angle to the path decays to 1/e."""


class Others(NamedTuple):
    """All objects of the scene as they are now."""

    boxes: Boxes
    v_x: Float[Array, " objects"]  # m/s
    v_y: Float[Array, " objects"]
    z: Float[Array, " objects"]  # m
    valid: Bool[Array, " objects"]


class Own(NamedTuple):
    """The driven object on its path."""

    speed: Float[Array, ""]  # m/s
    along: Float[Array, ""]  # m
    aside: Float[Array, ""]  # m, to the left
    angle: Float[Array, ""]  # rad, from the direction in which it settles
    half_length: Float[Array, ""]  # m
    half_width: Float[Array, ""]  # m


def interaction(
    speed: Float[Array, "..."],
    gap: Float[Array, "..."],
    closing: Float[Array, "..."],
    model: IdmConfig,
) -> Float[Array, "..."]:
    """-a_max (s* / s)^2 [m/s^2]: what a leader takes from the acceleration."""
    root = 2.0 * (model.acceleration * model.braking) ** 0.5
    wanted = model.standing_gap + jnp.maximum(
        speed * model.time_headway + speed * closing / root, 0.0
    )
    return -model.acceleration * (wanted / jnp.maximum(gap, _PATIENT)) ** 2


def free_road(
    speed: Float[Array, ""], desired: Float[Array, ""], model: IdmConfig
) -> Float[Array, ""]:
    """a_max (1 - (v / v_0)^4) [m/s^2], not below -b."""
    share = speed / jnp.maximum(desired, 0.1)
    return jnp.maximum(model.acceleration * (1.0 - share**4), -model.braking)


def ballistic(
    speed: Float[Array, ""], acceleration: Float[Array, ""], dt: float
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Speed [m/s] and way [m] after a step; it stops rather than reverses."""
    after = speed + acceleration * dt
    stopping = speed**2 / (2.0 * jnp.maximum(-acceleration, _PATIENT))
    way = jnp.where(after < 0, stopping, (speed + after) * dt / 2)
    return jnp.maximum(after, 0.0), way


def idm(config: EnvironmentConfig, model: IdmConfig | None = None) -> Agent:
    """Drives every controlled object by the model, all from the same state."""
    driver = model or IdmConfig()

    def act(key: PRNGKeyArray, bank: Bank, state: State) -> Decision:
        others = _others(bank, state)

        def one(
            index: Int[Array, ""], history: Float[Array, "history 5"]
        ) -> tuple[Float[Array, "5"], Bool[Array, ""]]:
            return _drive(bank, state, others, index, history, driver, config.dt)

        # An empty slot drives as the last row does; nothing reads where.
        rows = row_of(bank, state.controlled)
        moved, replays = jax.vmap(one)(rows, state.history)
        logged = next_logged(bank, state)
        return continuous(jnp.where(replays[:, None], logged, moved))

    return act


def _others(bank: Bank, state: State) -> Others:
    now, valid = current_objects(bank, state)
    row = bank.log[state.scene, state.step]
    return Others(
        boxes=Boxes(
            x=now[:, 0],
            y=now[:, 1],
            cos=jnp.cos(now[:, 2]),
            sin=jnp.sin(now[:, 2]),
            half_length=row[:, 6] / 2,
            half_width=row[:, 7] / 2,
        ),
        v_x=now[:, 3],
        v_y=now[:, 4],
        z=row[:, 2],
        valid=valid,
    )


def _drive(
    bank: Bank,
    state: State,
    others: Others,
    index: Int[Array, ""],
    history: Float[Array, "history 5"],
    model: IdmConfig,
    dt: float,
) -> tuple[Float[Array, "5"], Bool[Array, ""]]:
    """Where object `index` is next, and whether it replays the log instead."""
    scene, now = state.scene, history[-1]
    path = Path(bank.route[scene, index], bank.route_spacing[scene, index])
    place = paths.place_on(path, now[0], now[1])
    tangent = paths.pose_at(path, place.along)
    heading = jnp.arctan2(tangent.sin, tangent.cos)
    own = Own(
        speed=jnp.hypot(now[3], now[4]),
        along=place.along,
        aside=place.aside,
        angle=wrap(now[2] - heading + jnp.arctan(place.aside / model.settling)),
        half_length=others.boxes.half_length[index],
        half_width=others.boxes.half_width[index],
    )
    corridor = _corridor(path, own, model)
    desired = _desired(bank, scene, index, corridor, model)
    acceleration = free_road(own.speed, desired, model)
    line = gap_to_stop(bank, scene, state.step, history, corridor, model.stop)
    acceleration += jnp.minimum(
        _behind(own, others, index, corridor, model), _before(own, line, model)
    )
    acceleration = jnp.maximum(acceleration, -model.hardest_braking)
    parked = _parked(bank, scene, index, now, model)
    acceleration = jnp.where(parked, -own.speed / dt, acceleration)
    moved = _moved(path, own, acceleration, model, dt)
    on_foot = bank.object_type[scene, index] == int(ObjectType.PEDESTRIAN)
    return moved, on_foot | (jnp.abs(own.angle) > jnp.pi / 2)


def _parked(
    bank: Bank,
    scene: Int[Array, ""],
    index: Int[Array, ""],
    now: Float[Array, "5"],
    model: IdmConfig,
) -> Bool[Array, ""]:
    """Whether the log never moves it and it stands on none of its lanes."""
    lane = route_metrics.lane_position(bank, scene, index, now[0], now[1])
    known = (bank.path_flags[scene, index] > 0).any()
    on_lane = known & (lane.lane_distance <= model.in_lane)
    return (bank.route_end[scene, index] < 1.0) & ~on_lane


def _corridor(path: Path, own: Own, model: IdmConfig) -> Corridor:
    """The space ahead of the front bumper, `settling` onto the path."""
    ahead = model.slab * jnp.arange(model.slabs + 1, dtype=jnp.float32)

    def end(way: Float[Array, ""]) -> Pose:
        aside = own.aside * jnp.exp(-way / model.settling)
        return paths.shifted(paths.pose_at(path, own.along + way), aside)

    ends = jax.vmap(end)(own.half_length + ahead)
    return paths.corridor_of(ends, ahead, own.half_width + model.margin)


def _desired(
    bank: Bank,
    scene: Int[Array, ""],
    index: Int[Array, ""],
    corridor: Corridor,
    model: IdmConfig,
) -> Float[Array, ""]:
    """v_0 [m/s] here: the lane's, and what still lets it slow down for the bends."""
    cyclist = bank.object_type[scene, index] == int(ObjectType.CYCLIST)
    lane = bank.route_speed[scene, index]
    limit = jnp.where(lane > 0, lane, model.desired_speed)
    limit = jnp.where(cyclist, model.cyclist_speed, limit)
    start = bank.log[scene, bank.current_step[scene], index]
    # Who already drove faster knows better than the map or these defaults.
    limit = jnp.maximum(limit, jnp.hypot(start[4], start[5]))
    turn = corridor.sin[3:] * corridor.cos[:-3] - corridor.cos[3:] * corridor.sin[:-3]
    curvature = jnp.abs(turn) / (3.0 * model.slab)
    bend = model.lateral_acceleration / jnp.maximum(curvature, 1e-4)
    # Half of b leaves the model, which only tends to v_0, room to get there.
    allowed = jnp.sqrt(bend + model.braking * corridor.start[1:-2])
    return jnp.minimum(limit, allowed.min())


def _behind(
    own: Own,
    others: Others,
    index: Int[Array, ""],
    corridor: Corridor,
    model: IdmConfig,
) -> Float[Array, ""]:
    """The hardest braking that a leader asks for, <= 0."""
    found = paths.obstructions(corridor, others.boxes)
    closing = own.speed - (others.v_x * found.cos + others.v_y * found.sin)
    level = jnp.abs(others.z - others.z[index]) < model.same_level
    leads = (
        others.valid
        & level
        & (jnp.arange(others.z.shape[0]) != index)
        & jnp.isfinite(found.gap)
    )
    gap = jnp.where(leads, found.gap, model.slab * model.slabs)
    return jnp.where(leads, interaction(own.speed, gap, closing, model), 0.0).min()


def _before(own: Own, line: Float[Array, ""], model: IdmConfig) -> Float[Array, ""]:
    """The braking before a line [m from the bumper; inf: none], <= 0."""
    holds = jnp.isfinite(line)
    # As a leader whose rear is where s_0 leaves the wanted distance to the line.
    gap = jnp.where(holds, line, 0.0) + model.standing_gap - model.stop.gap
    return jnp.where(holds, interaction(own.speed, gap, own.speed, model), 0.0)


def _moved(
    path: Path, own: Own, acceleration: Float[Array, ""], model: IdmConfig, dt: float
) -> Float[Array, "5"]:
    """The state after a step at an acceleration [m/s^2]."""
    speed, way = ballistic(own.speed, acceleration, dt)
    aside = own.aside * jnp.exp(-way / model.settling)
    pose = paths.pose_at(path, own.along + way)
    place = paths.shifted(pose, aside)
    heading = jnp.arctan2(pose.sin, pose.cos) - jnp.arctan(aside / model.settling)
    yaw = wrap(heading + own.angle * jnp.exp(-way / model.turning))
    return jnp.stack(
        [place.x, place.y, yaw, speed * jnp.cos(yaw), speed * jnp.sin(yaw)]
    )
