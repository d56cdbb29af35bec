"""A path to drive along: where a point is on it, poses on it, the corridor ahead.

A path is a polyline of equally spaced points. Poses lie on the uniform quadratic
B-spline of its points (de Boor, A Practical Guide to Splines, 1978): its tangent turns
evenly from segment to segment, so that who follows it steers without jerks. It passes
1/8 spacing^2 * curvature inside of the points: 0.1 m where 3 m apart on a bend of 10 m.
Beyond both ends a path goes on straight.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Path(NamedTuple):
    """A polyline of points `spacing` [m] apart."""

    points: Float[Array, "points 2"]  # m
    spacing: Float[Array, ""]  # m


class Pose(NamedTuple):
    """A place on a path and the direction of travel there."""

    x: Float[Array, ""]  # m
    y: Float[Array, ""]  # m
    cos: Float[Array, ""]  # of the tangent's yaw
    sin: Float[Array, ""]


class PathPlace(NamedTuple):
    """Where a point is relative to a path."""

    along: Float[Array, ""]  # m, arc length of the nearest place
    aside: Float[Array, ""]  # m, to the left of it


class Corridor(NamedTuple):
    """The space that a vehicle sweeps ahead of its front bumper, as boxes in a row."""

    start: Float[Array, " slabs"]  # m, distance of the box's near side from the bumper
    x: Float[Array, " slabs"]  # m, centre
    y: Float[Array, " slabs"]
    cos: Float[Array, " slabs"]  # of the direction of travel
    sin: Float[Array, " slabs"]
    half_length: Float[Array, " slabs"]  # m
    half_width: Float[Array, ""]  # m


class Boxes(NamedTuple):
    """Oriented boxes that may stand in a corridor."""

    x: Float[Array, " boxes"]  # m, centre
    y: Float[Array, " boxes"]
    cos: Float[Array, " boxes"]  # of the yaw
    sin: Float[Array, " boxes"]
    half_length: Float[Array, " boxes"]  # m
    half_width: Float[Array, " boxes"]  # m


class Obstructions(NamedTuple):
    """Where boxes stand in a corridor."""

    gap: Float[Array, " boxes"]  # m from the front bumper; inf: not in it
    cos: Float[Array, " boxes"]  # of the corridor's direction there
    sin: Float[Array, " boxes"]


def pose_at(path: Path, along: Float[Array, ""]) -> Pose:
    """The pose at an arc length [m]."""
    last = path.points.shape[0] - 1
    at = along / path.spacing
    # The span of vertex k reaches from the middle of its segment to the next one's.
    k = jnp.clip(jnp.floor(at + 0.5), 1, last - 1).astype(jnp.int32)
    t = at + 0.5 - k.astype(jnp.float32)
    before, here, after = path.points[k - 1], path.points[k], path.points[k + 1]
    inside = jnp.clip(t, 0.0, 1.0)
    tangent = (1 - inside) * (here - before) + inside * (after - here)
    point = (
        0.5 * (1 - inside) ** 2 * before
        + (0.5 + inside * (1 - inside)) * here
        + 0.5 * inside**2 * after
        + (t - inside) * tangent
    )
    length = jnp.maximum(jnp.hypot(tangent[0], tangent[1]), 1e-6)
    return Pose(point[0], point[1], tangent[0] / length, tangent[1] / length)


def place_on(path: Path, x: Float[Array, ""], y: Float[Array, ""]) -> PathPlace:
    """Where a point is: on the nearest segment, then once more on the smooth path."""
    start, step = path.points[:-1], path.points[1:] - path.points[:-1]
    offset_x, offset_y = x - start[:, 0], y - start[:, 1]
    squared = jnp.maximum(step[:, 0] ** 2 + step[:, 1] ** 2, 1e-12)
    open_t = (offset_x * step[:, 0] + offset_y * step[:, 1]) / squared
    segments = step.shape[0]
    index = jnp.arange(segments)
    t = jnp.clip(
        open_t,
        jnp.where(index == 0, -jnp.inf, 0.0),
        jnp.where(index == segments - 1, jnp.inf, 1.0),
    )
    distance = (offset_x - t * step[:, 0]) ** 2 + (offset_y - t * step[:, 1]) ** 2
    best = jnp.argmin(distance)
    along = (best.astype(jnp.float32) + t[best]) * path.spacing
    guess = pose_at(path, along)
    along += (x - guess.x) * guess.cos + (y - guess.y) * guess.sin
    pose = pose_at(path, along)
    return PathPlace(along, (y - pose.y) * pose.cos - (x - pose.x) * pose.sin)


def shifted(pose: Pose, aside: Float[Array, ""]) -> Pose:
    """The pose moved to its left [m]."""
    return pose._replace(x=pose.x - aside * pose.sin, y=pose.y + aside * pose.cos)


def corridor_of(
    ends: Pose, start: Float[Array, " ends"], half_width: Float[Array, ""]
) -> Corridor:
    """The boxes between consecutive poses (axis `ends`) at distances `start` [m]."""
    x, y = ends.x[1:] - ends.x[:-1], ends.y[1:] - ends.y[:-1]
    length = jnp.hypot(x, y)
    some = jnp.maximum(length, 1e-6)
    return Corridor(
        start=start[:-1],
        x=(ends.x[1:] + ends.x[:-1]) / 2,
        y=(ends.y[1:] + ends.y[:-1]) / 2,
        cos=x / some,
        sin=y / some,
        half_length=length / 2,
        half_width=half_width,
    )


def obstructions(corridor: Corridor, boxes: Boxes) -> Obstructions:
    """The gap to each box: to its near end in the corridor's first part that it is in.

    Separating-axis tests of all boxes with all parts (`sim.metrics.boxes_overlap`).
    """
    over = jax.vmap(_against, in_axes=(None, 0))
    gap = over(corridor, boxes)
    first = jnp.argmin(gap, 1)
    nearest = gap.min(1)
    return Obstructions(nearest, corridor.cos[first], corridor.sin[first])


def _against(corridor: Corridor, box: Boxes) -> Float[Array, " slabs"]:
    """The gap to one box through each part; inf where it is not in that part."""
    x, y = box.x - corridor.x, box.y - corridor.y
    along = x * corridor.cos + y * corridor.sin
    across = y * corridor.cos - x * corridor.sin
    own_along = x * box.cos + y * box.sin
    own_across = y * box.cos - x * box.sin
    cos = jnp.abs(corridor.cos * box.cos + corridor.sin * box.sin)
    sin = jnp.abs(corridor.cos * box.sin - corridor.sin * box.cos)
    length, width = corridor.half_length, corridor.half_width
    reach = box.half_length * cos + box.half_width * sin
    hit = (
        (jnp.abs(along) <= length + reach)
        & (jnp.abs(across) <= width + box.half_length * sin + box.half_width * cos)
        & (jnp.abs(own_along) <= box.half_length + length * cos + width * sin)
        & (jnp.abs(own_across) <= box.half_width + length * sin + width * cos)
    )
    near = jnp.clip(along + length - reach, 0.0, 2 * length)
    return jnp.where(hit, corridor.start + near, jnp.inf)


class Crossings(NamedTuple):
    """Where points lie relative to a corridor's middle line."""

    gap: Float[Array, " points"]  # m from the front bumper, negative behind it
    aside: Float[Array, " points"]  # m


def crossings(
    corridor: Corridor,
    x: Float[Array, " points"],
    y: Float[Array, " points"],
    back: float,
) -> Crossings:
    """The nearest place on the middle line, which goes on `back` metres behind."""
    first = jnp.arange(corridor.start.shape[0]) == 0

    def one(x: Float[Array, ""], y: Float[Array, ""]) -> Crossings:
        length = corridor.half_length
        along = (x - corridor.x) * corridor.cos + (y - corridor.y) * corridor.sin
        across = (y - corridor.y) * corridor.cos - (x - corridor.x) * corridor.sin
        inside = jnp.clip(along, jnp.where(first, -length - back, -length), length)
        aside = jnp.hypot(along - inside, across)
        best = jnp.argmin(aside)
        gap = corridor.start + length + inside
        return Crossings(gap[best], aside[best])

    return jax.vmap(one)(x, y)
