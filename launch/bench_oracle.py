"""The metrics by their definitions, in JAX: what the simulator's speed is held against.

All corners against all points: for each of an object's four corners the nearest point
(x, y, 2 z) of the road's edges is searched among all of them, and the segments that
adjoin it there decide the side: in a left turn the corner must be left of both, in a
right turn left of either (Gulino et al., 2023, sec. 3.4). Overlap projects every box's
corners on every other's axes. Written for one scene at one step; no table, no grid.

It differs from `sim.metrics` by design in one way: the nearest point decides, not the
nearest place of a segment, so that the two may disagree close to an edge where points
are far apart; the benchmark counts how often.

Every map point counts as a candidate, those that are no edge at infinite distance: the
map is one array of a fixed length, as compiled programs want it. Coordinates are one
array each: on a CPU that halves the time of rows of three, which `rows=True` searches.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim.bank import Bank
from sim.environment import Judgement, State
from sim.scene import Polyline, RoadKind, Scene

HEIGHT_WEIGHT = 2.0
MAX_ACCELERATION = 10.4  # m/s^2
MAX_CURVATURE = 0.3  # 1/m
SLOW = 0.6  # m/s


class RoadPoints(NamedTuple):
    """A scene's map points with the segments that adjoin each in its polyline.

    At an open end both are the only one.
    """

    x: Float[Array, " points"]  # m, local to the bank's origin
    y: Float[Array, " points"]
    z: Float[Array, " points"]
    weighted: Float[Array, "points 3"]  # x, y, 2 z: the same as rows
    is_edge: Bool[Array, " points"]
    before: Float[Array, "points 2"]  # m, to this point from the one before it
    after: Float[Array, "points 2"]


def road_points(
    scene: Scene, origin: tuple[float, float, float], *, only_edges: bool = False
) -> RoadPoints:
    """The map of a scene; `only_edges` leaves out what can never be the nearest."""
    lines = [road for road in scene.roads if road.kind.is_edge or not only_edges]
    if not lines:
        lines = [Polyline(RoadKind.LANE_UNKNOWN, np.zeros((1, 3)))]
    parts = [_of_line(line, np.array(origin)) for line in lines]
    joined = [jnp.asarray(np.concatenate(part)) for part in zip(*parts, strict=True)]
    return RoadPoints(*joined)


def _of_line(line: Polyline, origin: np.ndarray) -> tuple[np.ndarray, ...]:
    """One polyline's part of `RoadPoints`; a repeated point is no edge's vertex."""
    points = line.points - origin
    moved = np.abs(np.diff(line.points[:, :2], axis=0)).max(1, initial=0.0) > 1e-6
    fresh = np.concatenate([[True], moved])
    kept = np.flatnonzero(fresh)
    before, after = np.zeros((2, len(points), 2))
    is_edge = fresh & line.kind.is_edge & (len(kept) > 1)
    if len(kept) > 1:
        steps = np.diff(points[kept, :2], axis=0)
        ends = points[kept[0]] - points[kept[-1]]
        ring = len(kept) > 3 and np.hypot.reduce(ends) < 1e-3
        first, last = (steps[-1], steps[0]) if ring else (steps[0], steps[-1])
        before[kept] = np.concatenate([first[None], steps])
        after[kept] = np.concatenate([steps, last[None]])
    x, y, z = points.T.astype(np.float32)
    weighted = np.stack([x, y, np.float32(HEIGHT_WEIGHT) * z], -1)
    directions = (before.astype(np.float32), after.astype(np.float32))
    return x, y, z, weighted, is_edge, *directions


def corners(
    state: Float[Array, "5"], length: Float[Array, ""], width: Float[Array, ""]
) -> Float[Array, "4 2"]:
    """The corners of one box, around it."""
    cos, sin = jnp.cos(state[2]), jnp.sin(state[2])
    ahead = jnp.array([1.0, 1.0, -1.0, -1.0]) * length / 2
    aside = jnp.array([1.0, -1.0, -1.0, 1.0]) * width / 2
    return jnp.stack(
        [
            state[0] + ahead * cos - aside * sin,
            state[1] + ahead * sin + aside * cos,
        ],
        -1,
    )


def nearest_point(
    road: RoadPoints, corner: Float[Array, "2"], z: Float[Array, ""], *, rows: bool
) -> Int[Array, ""]:
    """The edge point nearest to a corner, heights counting double."""
    if rows:
        own = jnp.stack([corner[0], corner[1], HEIGHT_WEIGHT * z])
        squared = jnp.square(road.weighted - own[None]).sum(-1)
    else:
        squared = (
            jnp.square(road.x - corner[0])
            + jnp.square(road.y - corner[1])
            + jnp.square(HEIGHT_WEIGHT * (road.z - z))
        )
    return jnp.argmin(jnp.where(road.is_edge, squared, jnp.inf))


def on_road(
    road: RoadPoints, corner: Float[Array, "2"], z: Float[Array, ""], *, rows: bool
) -> Bool[Array, ""]:
    """Whether a corner is on the drivable side where it is nearest to an edge."""
    index = nearest_point(road, corner, z, rows=rows)
    before, after = road.before[index], road.after[index]
    away = corner - jnp.stack([road.x[index], road.y[index]])
    of_before, of_after = _cross(before, away) > 0, _cross(after, away) > 0
    left_turn = _cross(before, after) > 0
    left = jnp.where(left_turn, of_before & of_after, of_before | of_after)
    return left | ~road.is_edge[index]  # no edge anywhere: nothing to leave


def _cross(a: Float[Array, "2"], b: Float[Array, "2"]) -> Float[Array, ""]:
    return a[0] * b[1] - a[1] * b[0]


def boxes_meet(
    boxes: Float[Array, "objects 4 2"],
) -> Bool[Array, "objects objects"]:
    """Which pairs share a point: no side of either separates them."""

    def apart(one: Float[Array, "4 2"], other: Float[Array, "4 2"]) -> Bool[Array, ""]:
        axes = jnp.stack([one[0] - one[3], one[0] - one[1]])
        own = (axes[:, None] * one[None]).sum(-1)
        its = (axes[:, None] * other[None]).sum(-1)
        return ((its.min(1) > own.max(1)) | (its.max(1) < own.min(1))).any()

    separated = jax.vmap(jax.vmap(apart, (None, 0)), (0, None))(boxes, boxes)
    return ~(separated | separated.T)


def infeasible(
    before: Float[Array, "5"], now: Float[Array, "5"], dt: float
) -> Bool[Array, ""]:
    """|a| > 10.4 m/s^2 or |kappa| > 0.3 1/m by the inverse bicycle model."""
    speed = jnp.hypot(before[3], before[4])
    new_speed = jnp.hypot(now[3], now[4])
    acceleration = (new_speed - speed) / dt
    turn = jnp.arctan2(now[4], now[3]) - before[2]
    turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    slow = (speed < SLOW) | (new_speed < SLOW)
    travelled = jnp.where(slow, 1.0, (speed + new_speed) / 2 * dt)
    curvature = jnp.where(slow, 0.0, turn / travelled)
    return (jnp.abs(acceleration) > MAX_ACCELERATION) | (
        jnp.abs(curvature) > MAX_CURVATURE
    )


def judge(
    bank: Bank,
    road: RoadPoints,
    state_tm1: State,
    state_t: State,
    dt: float,
    *,
    rows: bool = False,
) -> Judgement:
    """All metrics of all objects, which must all be controlled, in the log's order."""
    log = bank.log[state_t.scene, state_t.step]
    valid = bank.log_valid[state_t.scene, state_t.step]
    before, now = state_tm1.history[:, -1], state_t.history[:, -1]
    boxes = jax.vmap(corners)(now, log[:, 6], log[:, 7])

    def inside(corner: Float[Array, "2"], z: Float[Array, ""]) -> Bool[Array, ""]:
        return on_road(road, corner, z, rows=rows)

    on = jax.vmap(jax.vmap(inside, (0, None)))(boxes, log[:, 2])
    others = valid[None] & ~jnp.eye(valid.shape[0], dtype=bool)
    hit = (boxes_meet(boxes) & others).any(1)
    away = now[:, :2] - log[:, :2]
    wrong = jax.vmap(infeasible, (0, 0, None))(before, now, dt)
    return Judgement(
        overlap=hit & valid,
        offroad=~on.all(1) & valid,
        log_divergence=jnp.where(valid, jnp.sqrt((away**2).sum(-1)), 0.0),
        kinematic_infeasibility=wrong & valid & state_tm1.history_valid[:, -1],
    )
