"""Route metrics of one object at one step: wrong-way, off-route, progression.

Definitions follow the Waymax benchmark (Gulino et al., 2023, sec. 3.4); the lane paths
that an object could take, and which of them are on its route, are `sim.lane_paths`'.
Each function is for one object; batch with `jax.vmap`. All of an object's paths are
looked at in one dense pass over chunks of eight segments, which agrees with the
recorded polylines within `lanes.TOLERANCE`. The brute-force twin is in
`tests/route_oracle.py`.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim.bank import Bank
from sim.lane_paths import OFF, ON

WRONG_WAY_DISTANCE = 3.5  # m
OFF_ROUTE_DISTANCE = 5.0  # m
OFF_ROUTE_MARGIN = 2.0  # m that another path may be nearer
MIN_ROUTE = 1.0  # m: of a shorter logged way no ratio is formed
FAR = 1e4  # m: stands for the distance of a path that is not there


class LanePosition(NamedTuple):
    """Where a point stands to an object's lane paths."""

    on_distance: Float[Array, ""]  # m to the nearest on-route path; 0: has none
    off_distance: Float[Array, ""]  # m to the nearest off-route path; `FAR`: has none
    lane_distance: Float[Array, ""]  # m to the nearest path; 0: has none
    along: Float[Array, ""]  # m, arc length on the nearest on-route path; 0: has none


def lane_position(
    bank: Bank,
    scene: Int[Array, ""],
    index: Int[Array, ""],
    x: Float[Array, ""],
    y: Float[Array, ""],
) -> LanePosition:
    """The nearest points of object `index`'s paths to (x, y) [m].

    Objects without any path (pedestrians, and what is never on a lane) have distances
    of 0, so that no metric below holds anything against them.
    """
    flags = bank.path_flags[scene, index].astype(jnp.int32)
    chunk = bank.path_chunk[scene, index].astype(jnp.int32) + bank.chunk_start[scene]
    rows = bank.chunks[chunk]
    along_x, along_y = (
        rows[:, 0, 1:] - rows[:, 0, :-1],
        rows[:, 1, 1:] - rows[:, 1, :-1],
    )
    offset_x, offset_y = x - rows[:, 0, :-1], y - rows[:, 1, :-1]
    # No reduction: over two terms it would round differently from batch to batch.
    squared = jnp.maximum(along_x**2 + along_y**2, 1e-12)
    t = jnp.clip((offset_x * along_x + offset_y * along_y) / squared, 0.0, 1.0)
    apart = (offset_x - t * along_x) ** 2 + (offset_y - t * along_y) ** 2
    nearest = apart.min(-1)
    is_on, is_off = flags & ON > 0, flags & OFF > 0
    on = jnp.where(is_on, nearest, FAR**2)
    off = jnp.where(is_off, nearest, FAR**2).min()
    best = on.argmin()
    segment = apart[best].argmin()
    lengths = jnp.sqrt(squared[best])
    passed = jnp.where(jnp.arange(lengths.shape[0]) < segment, lengths, 0.0).sum()
    reached = passed + t[best, segment] * lengths[segment]
    some_on = is_on.any()
    return LanePosition(
        on_distance=jnp.where(some_on, jnp.sqrt(on[best]), 0.0),
        off_distance=jnp.sqrt(off),
        lane_distance=jnp.where(
            (flags > 0).any(), jnp.sqrt(jnp.minimum(on[best], off)), 0.0
        ),
        along=jnp.where(some_on, bank.path_offset[scene, index, best] + reached, 0.0),
    )


def wrong_way(position: LanePosition) -> Float[Array, ""]:
    """Distance [m] to the nearest lane path where it exceeds 3.5 m, else 0.

    Lane paths are all of the object's, on-route and off-route ones: whoever is on none
    of them drives where the lanes do not lead from where it came.
    """
    far = position.lane_distance > WRONG_WAY_DISTANCE
    return jnp.where(far, position.lane_distance, 0.0)


def off_route(position: LanePosition) -> Float[Array, ""]:
    """Distance [m] to the nearest on-route path where another route is taken, else 0.

    So it is where the distance exceeds 5 m, or by 2 m that to an off-route path.
    """
    on = position.on_distance
    other = on - position.off_distance > OFF_ROUTE_MARGIN
    return jnp.where((on > OFF_ROUTE_DISTANCE) | other, on, 0.0)


def progression(
    bank: Bank, scene: Int[Array, ""], index: Int[Array, ""], along: Float[Array, ""]
) -> Float[Array, ""]:
    """(s_now - s_start) / (s_end - s_start), start and end being the log's.

    `along` is `LanePosition.along`. NaN where the log's way is shorter than 1 m, or the
    object has no on-route path.
    """
    start, end = bank.path_start[scene, index], bank.path_end[scene, index]
    moved = end - start >= MIN_ROUTE
    return jnp.where(
        moved, (along - start) / jnp.where(moved, end - start, 1.0), jnp.nan
    )
