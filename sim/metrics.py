"""Metrics of one scene at one step: overlap, off-road, log divergence, feasibility.

Definitions follow the Waymax benchmark (Gulino et al., 2023, sec. 3.4), with boxes at
their full size. Each function is for one object; batch with `jax.vmap`. The brute-force
twins are in `tests/oracle.py`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim import smallest
from sim.bank import Bank
from sim.dynamics import ObjectState, bicycle_inverse
from sim.edge_side import on_drivable_side

MAX_ACCELERATION = 10.4  # m/s^2
MAX_CURVATURE = 0.3  # 1/m


class Box(NamedTuple):
    """An oriented box."""

    x: Float[Array, ""]  # m, centre
    y: Float[Array, ""]  # m
    yaw: Float[Array, ""]  # rad
    length: Float[Array, ""]  # m, along yaw
    width: Float[Array, ""]  # m


def overlap(
    index: Int[Array, ""], boxes: Box, valid: Bool[Array, " objects"]
) -> Bool[Array, ""]:
    """Whether object `index` of a scene's boxes overlaps another valid one.

    Separating-axis test of two boxes (Gottschalk et al., 1996, in the plane): in the
    frame of a box, the other's half extents along its axes are those of its own sides
    turned by the difference of the yaws. Boxes that touch overlap.
    """
    # Of every box once, not of every pair: batched over `index` they stay unbatched.
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    own = Box(*(value[index] for value in boxes))
    own_cos, own_sin = cos[index], sin[index]
    x, y = boxes.x - own.x, boxes.y - own.y
    turn_cos = jnp.abs(own_cos * cos + own_sin * sin)
    turn_sin = jnp.abs(own_cos * sin - own_sin * cos)
    length, width = boxes.length, boxes.width
    apart = (
        (
            2 * jnp.abs(x * own_cos + y * own_sin)
            > own.length + length * turn_cos + width * turn_sin
        )
        | (
            2 * jnp.abs(y * own_cos - x * own_sin)
            > own.width + length * turn_sin + width * turn_cos
        )
        | (
            2 * jnp.abs(x * cos + y * sin)
            > length + own.length * turn_cos + own.width * turn_sin
        )
        | (
            2 * jnp.abs(y * cos - x * sin)
            > width + own.length * turn_sin + own.width * turn_cos
        )
    )
    others = valid & (jnp.arange(valid.shape[0]) != index)
    return valid[index] & smallest.any_of(~apart & others)


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

    `sim.edge_side` says which side that is. Corners take the height `z` of the
    centre [m].
    """
    return ~on_drivable_side(bank, scene, corners(box), z).all()


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
    best = smallest.argmin(distance)
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
