"""Metrics of one scene at one step: overlap, off-road, log divergence, feasibility.

Definitions follow the Waymax benchmark (Gulino et al., 2023, sec. 3.4), with boxes at
their full size. Each function is for one object; batch with `jax.vmap`. The brute-force
twins are in `tests/oracle.py`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim import edge_table, tables
from sim.bank import Bank
from sim.dynamics import ObjectState, bicycle_inverse

MAX_ACCELERATION = 10.4  # m/s^2
MAX_CURVATURE = 0.3  # 1/m


class Box(NamedTuple):
    """An oriented box."""

    x: Float[Array, ""]  # m, centre
    y: Float[Array, ""]  # m
    yaw: Float[Array, ""]  # rad
    length: Float[Array, ""]  # m, along yaw
    width: Float[Array, ""]  # m


def boxes_overlap(one: Box, other: Box) -> Bool[Array, ""]:
    """Separating-axis test of two boxes (Gottschalk et al., 1996, in the plane).

    In the frame of a box, the other's half extents along its axes are those of its
    own sides turned by the difference of the yaws. Boxes that touch overlap.
    """
    cos = jnp.abs(jnp.cos(other.yaw - one.yaw))
    sin = jnp.abs(jnp.sin(other.yaw - one.yaw))
    apart = _apart(one, other, cos, sin) | _apart(other, one, cos, sin)
    return ~apart


def _apart(
    one: Box, other: Box, cos: Float[Array, ""], sin: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether an axis of `one` separates it from `other`."""
    x, y = other.x - one.x, other.y - one.y
    along = jnp.abs(x * jnp.cos(one.yaw) + y * jnp.sin(one.yaw))
    across = jnp.abs(y * jnp.cos(one.yaw) - x * jnp.sin(one.yaw))
    return (2 * along > one.length + other.length * cos + other.width * sin) | (
        2 * across > one.width + other.length * sin + other.width * cos
    )


def overlap(
    index: Int[Array, ""], boxes: Box, valid: Bool[Array, " objects"]
) -> Bool[Array, ""]:
    """Whether object `index` of a scene's boxes overlaps another valid one."""
    own = Box(*(value[index] for value in boxes))
    hit = jax.vmap(boxes_overlap, in_axes=(None, 0))(own, boxes)
    others = valid & (jnp.arange(valid.shape[0]) != index)
    return valid[index] & (hit & others).any()


def corners(box: Box) -> Float[Array, "4 2"]:
    """The box's corners [m], front left first, clockwise."""
    cos, sin = jnp.cos(box.yaw) / 2, jnp.sin(box.yaw) / 2
    front = jnp.stack([cos, sin]) * box.length
    left = jnp.stack([-sin, cos]) * box.width
    centre = jnp.stack([box.x, box.y])
    return jnp.stack(
        [
            centre + front + left,
            centre + front - left,
            centre - front - left,
            centre - front + left,
        ]
    )


def offroad(
    bank: Bank, scene: Int[Array, ""], box: Box, z: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether a corner lies on the wrong side of its nearest road edge.

    The drivable side is an edge's left. Where the nearest point is a polyline's
    vertex both adjoining segments decide: in a left turn the point must be left of
    both, in a right turn left of either. Corners take the height `z` of the centre
    [m], and differences of height count twice in the distance. Exact up to float32
    within the grid (10 m around map and logs): the cell's candidates hold every edge
    that can be the nearest (`sim.edge_table`), at most `convert.MAX_CANDIDATES`, which
    no real scene at hand exceeds by more than a few cells. Outside the grid the border
    cell's candidates decide.
    """
    side = jax.vmap(_on_left, in_axes=(None, None, 0, None))
    return ~side(bank, scene, corners(box), z).all()


def _on_left(
    bank: Bank, scene: Int[Array, ""], point: Float[Array, "2"], z: Float[Array, ""]
) -> Bool[Array, ""]:
    shape = bank.grid_shape[scene]
    fine = ((point - bank.grid_origin[scene]) / tables.EDGE_CELL).astype(jnp.int32)
    fine = jnp.clip(fine, 0, shape * tables.FINE - 1)
    cell, part = fine // tables.FINE, fine % tables.FINE
    number = bank.cell_start[scene] + cell[0] * shape[1] + cell[1]
    state = bank.cell_edges[number].astype(jnp.int32)
    square = bank.fine_start[scene] + jnp.maximum(state, 0)
    parts = bank.fine_state[square, part[0] * tables.FINE + part[1]].astype(jnp.int32)
    state = jnp.where(state >= 0, parts, state)
    near = bank.list_start[scene] + jnp.maximum(state, 0)
    last = bank.list_count[near].astype(jnp.int32) - 1
    # A list shorter than the longest repeats its last edge, which changes no minimum.
    at = bank.list_first[near] + jnp.minimum(bank.candidates, last)
    edges = bank.edge_start[scene] + bank.list_edges[at].astype(jnp.int32)
    best = edges[_nearest(bank.edges[edges, :6], point, z)]
    left = _left_of(bank.edges[best], point, z)
    return (state == edge_table.DRIVABLE) | ((state >= 0) & left)


def _nearest(
    edges: Float[Array, "candidates 6"], point: Float[Array, "2"], z: Float[Array, ""]
) -> Int[Array, ""]:
    dx, dy, dz = edges[:, 3], edges[:, 4], edges[:, 5] * edge_table.HEIGHT_WEIGHT
    x, y = point[0] - edges[:, 0], point[1] - edges[:, 1]
    h = (z - edges[:, 2]) * edge_table.HEIGHT_WEIGHT
    squared = jnp.maximum(dx * dx + dy * dy + dz * dz, 1e-12)
    t = jnp.clip((x * dx + y * dy + h * dz) / squared, 0.0, 1.0)
    return jnp.argmin((x - t * dx) ** 2 + (y - t * dy) ** 2 + (h - t * dz) ** 2)


def _left_of(
    edge: Float[Array, "10"], point: Float[Array, "2"], z: Float[Array, ""]
) -> Bool[Array, ""]:
    """Whether the point is on the edge's left, where the edge is its nearest one."""
    dx, dy, dz = edge[3], edge[4], edge[5] * edge_table.HEIGHT_WEIGHT
    x, y = point[0] - edge[0], point[1] - edge[1]
    h = (z - edge[2]) * edge_table.HEIGHT_WEIGHT
    squared = jnp.maximum(dx * dx + dy * dy + dz * dz, 1e-12)
    t = jnp.clip((x * dx + y * dy + h * dz) / squared, 0.0, 1.0)
    own = _cross(dx, dy, x, y)
    # At a vertex the neighbour's side counts too; both of its ends lie on its line.
    before = _cross(edge[6], edge[7], x, y)
    after = _cross(edge[8], edge[9], x - dx, y - dy)
    turn_before = _cross(edge[6], edge[7], dx, dy)
    turn_after = _cross(dx, dy, edge[8], edge[9])
    neighbour = jnp.where(t <= 0.0, before, after)
    left_turn = jnp.where(t <= 0.0, turn_before, turn_after) > 0
    both = (own > 0) & (neighbour > 0)
    either = (own > 0) | (neighbour > 0)
    at_vertex = (t <= 0.0) | (t >= 1.0)
    return jnp.where(at_vertex, jnp.where(left_turn, both, either), own > 0)


def _cross(
    ax: Float[Array, ""],
    ay: Float[Array, ""],
    bx: Float[Array, ""],
    by: Float[Array, ""],
) -> Float[Array, ""]:
    return ax * by - ay * bx


def log_divergence(
    x: Float[Array, ""],
    y: Float[Array, ""],
    logged_x: Float[Array, ""],
    logged_y: Float[Array, ""],
) -> Float[Array, ""]:
    """Distance of the simulated centre from the logged one [m], same step."""
    return jnp.hypot(x - logged_x, y - logged_y)


def kinematic_infeasibility(
    state_tm1: ObjectState, state_t: ObjectState, dt: float
) -> Bool[Array, ""]:
    """|a| > 10.4 m/s^2 or |kappa| > 0.3 1/m by the inverse bicycle model."""
    action = bicycle_inverse(state_tm1, state_t, dt)
    return (jnp.abs(action[0]) > MAX_ACCELERATION) | (
        jnp.abs(action[1]) > MAX_CURVATURE
    )


class RoutePosition(NamedTuple):
    """Where a point is on an object's logged route."""

    along: Float[Array, ""]  # m, arc length of the nearest point
    aside: Float[Array, ""]  # m, distance from it


def route_position(
    bank: Bank,
    scene: Int[Array, ""],
    index: Int[Array, ""],
    x: Float[Array, ""],
    y: Float[Array, ""],
) -> RoutePosition:
    """The nearest point of object `index`'s route, over the whole route."""
    route = bank.route[scene, index]
    spacing = bank.route_spacing[scene, index]
    start, along = route[:-1], route[1:] - route[:-1]
    offset_x, offset_y = x - start[:, 0], y - start[:, 1]
    # No reduction: over two terms it would round differently from batch to batch.
    squared = jnp.maximum(along[:, 0] ** 2 + along[:, 1] ** 2, 1e-12)
    t = (offset_x * along[:, 0] + offset_y * along[:, 1]) / squared
    t = jnp.clip(t, 0.0, 1.0)
    distance = (offset_x - t * along[:, 0]) ** 2 + (offset_y - t * along[:, 1]) ** 2
    best = jnp.argmin(distance)
    return RoutePosition(
        (best.astype(jnp.float32) + t[best]) * spacing, jnp.sqrt(distance[best])
    )


def progress(
    bank: Bank, scene: Int[Array, ""], index: Int[Array, ""], along: Float[Array, ""]
) -> Float[Array, ""]:
    """(s_now - s_start) / (s_end - s_start) on the logged route; NaN below 1 m."""
    start, end = bank.route_start[scene, index], bank.route_end[scene, index]
    moved = end - start >= 1.0
    return jnp.where(
        moved, (along - start) / jnp.where(moved, end - start, 1.0), jnp.nan
    )
