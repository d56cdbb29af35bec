"""Which side of its nearest road edge a point lies on, for many points at once.

The drivable side is an edge's left. Where the nearest point is a polyline's vertex both
adjoining segments decide: in a left turn the point must be left of both, in a right
turn left of either. Differences of height count twice in the distance. Exact up to
float32 within the grid (10 m around map and logs): the cell's candidates hold every
edge that can be the nearest (`sim.edge_table`), the nearest `convert.MAX_CANDIDATES` to
its centre where there are more (no real scene at hand comes near that). Outside the
grid the border cell's candidates decide.

Most points lie in cells that are all of one side; of the others most have few
candidates. On a CPU only what is left is worked through, in blocks: measured on a
WOMD scene, a step of an object without its observation takes 1.2 us so, 3.1 with all
candidates of every point. Batched by `jax.vmap` all points still make one list.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from sim import edge_table, smallest, tables
from sim.bank import Bank

FEW = 16  # candidates: three quarters of the cells that are not of one side
BLOCK = 64  # points


def on_drivable_side(
    bank: Bank,
    scene: Int[Array, ""],
    points: Float[Array, "points 2"],
    z: Float[Array, ""],
) -> Bool[Array, " points"]:
    """Whether points of one scene at height `z` [m] are left of their nearest edge."""
    count = points.shape[0]
    return _decide(
        bank, jnp.broadcast_to(scene, (count,)), points, jnp.broadcast_to(z, (count,))
    )


@custom_vmap
def _decide(
    bank: Bank,
    scene: Int[Array, " points"],
    points: Float[Array, "points 2"],
    z: Float[Array, " points"],
) -> Bool[Array, " points"]:
    state = _cells(bank, scene, points)
    left = state == edge_table.DRIVABLE
    mixed = state >= 0
    near = bank.list_start[scene] + jnp.maximum(state, 0)
    lists = _Lists(
        first=bank.list_first[near],
        last=bank.list_count[near].astype(jnp.int32) - 1,
        edge_start=bank.edge_start[scene],
    )
    longest = bank.candidates.shape[0]
    if jax.default_backend() != "cpu":
        # Elsewhere a loop of unknown length costs more than what it leaves out.
        found = _left_of_nearest(bank, lists, points, z, longest)
        return jnp.where(mixed, found, left)
    few = min(FEW, longest)
    if few < longest:
        more = mixed & (lists.last >= few)
        left = _in_blocks(bank, left, more, lists, points, z, longest)
        mixed = mixed & ~more
    return _in_blocks(bank, left, mixed, lists, points, z, few)


class _Lists(NamedTuple):
    """Each point's candidates."""

    first: Int[Array, " points"]  # element of `list_edges`
    last: Int[Array, " points"]  # from the first
    edge_start: Int[Array, " points"]  # the scene's first row of `edges`


@_decide.def_vmap
def _decide_batch(
    size: int,
    batched: list[Bank | bool],
    bank: Bank,
    scene: Int[Array, "..."],
    points: Float[Array, "..."],
    z: Float[Array, "..."],
) -> tuple[Bool[Array, "batch points"], bool]:
    """All rows of a batch as one list."""
    rows = [
        value if is_batched else jnp.broadcast_to(value, (size, *value.shape))
        for value, is_batched in zip((scene, points, z), batched[1:], strict=True)
    ]
    flat = [value.reshape(-1, *value.shape[2:]) for value in rows]
    return _decide(bank, *flat).reshape(size, -1), True


def _cells(
    bank: Bank, scene: Int[Array, " points"], points: Float[Array, "points 2"]
) -> Int[Array, " points"]:
    """Each point's cell: its verdict, or its list of candidates."""
    shape = bank.grid_shape[scene]
    fine = ((points - bank.grid_origin[scene]) / tables.EDGE_CELL).astype(jnp.int32)
    fine = jnp.clip(fine, 0, shape * tables.FINE - 1)
    cell, part = fine // tables.FINE, fine % tables.FINE
    number = bank.cell_start[scene] + cell[:, 0] * shape[:, 1] + cell[:, 1]
    state = bank.cell_edges[number].astype(jnp.int32)
    square = bank.fine_start[scene] + jnp.maximum(state, 0)
    parts = bank.fine_state[square, part[:, 0] * tables.FINE + part[:, 1]]
    return jnp.where(state >= 0, parts.astype(jnp.int32), state)


def _in_blocks(
    bank: Bank,
    left: Bool[Array, " points"],
    which: Bool[Array, " points"],
    lists: _Lists,
    points: Float[Array, "points 2"],
    z: Float[Array, " points"],
    candidates: int,
) -> Bool[Array, " points"]:
    """`left`, decided anew for the points `which` by the first `candidates`."""
    count = which.shape[0]
    block = min(BLOCK, count)
    blocks = -(-count // block)
    order = jnp.nonzero(which, size=blocks * block, fill_value=count)[0]

    def one(number: Int[Array, ""], left: Bool[Array, " points"]) -> Array:
        here = jax.lax.dynamic_slice(order, (number * block,), (block,))
        at = jnp.minimum(here, count - 1)
        their = _Lists(*(value[at] for value in lists))
        found = _left_of_nearest(bank, their, points[at], z[at], candidates)
        return left.at[here].set(found, mode="drop")

    used = (which.sum() + block - 1) // block
    return jax.lax.fori_loop(0, used, one, left)


def _left_of_nearest(
    bank: Bank,
    lists: _Lists,
    points: Float[Array, "points 2"],
    z: Float[Array, " points"],
    candidates: int,
) -> Bool[Array, " points"]:
    # A list shorter than that repeats its last edge, which changes no minimum.
    at = jnp.minimum(jnp.arange(candidates)[None], lists.last[:, None])
    index = bank.list_edges[lists.first[:, None] + at].astype(jnp.int32)
    edges = bank.edges[lists.edge_start[:, None] + index]
    dx, dy, dz = edges[..., 3], edges[..., 4], edges[..., 5] * edge_table.HEIGHT_WEIGHT
    x, y = points[:, :1] - edges[..., 0], points[:, 1:] - edges[..., 1]
    h = (z[:, None] - edges[..., 2]) * edge_table.HEIGHT_WEIGHT
    squared = jnp.maximum(dx * dx + dy * dy + dz * dz, 1e-12)
    t = jnp.clip((x * dx + y * dy + h * dz) / squared, 0.0, 1.0)
    distance = (x - t * dx) ** 2 + (y - t * dy) ** 2 + (h - t * dz) ** 2
    best = smallest.argmin(distance)[:, None]
    nearest = jnp.take_along_axis(edges, best[..., None], 1)[:, 0]
    return _left_of(nearest, jnp.take_along_axis(t, best, 1)[:, 0], points)


def _left_of(
    edge: Float[Array, "points 10"],
    t: Float[Array, " points"],
    points: Float[Array, "points 2"],
) -> Bool[Array, " points"]:
    """Whether points are left of an edge that is nearest at its part `t` in [0, 1]."""
    x, y = points[:, 0] - edge[:, 0], points[:, 1] - edge[:, 1]
    dx, dy = edge[:, 3], edge[:, 4]
    own = _cross(dx, dy, x, y)
    # At a vertex the neighbour's side counts too; both of its ends lie on its line.
    before = _cross(edge[:, 6], edge[:, 7], x, y)
    after = _cross(edge[:, 8], edge[:, 9], x - dx, y - dy)
    turn_before = _cross(edge[:, 6], edge[:, 7], dx, dy)
    turn_after = _cross(dx, dy, edge[:, 8], edge[:, 9])
    neighbour = jnp.where(t <= 0.0, before, after)
    left_turn = jnp.where(t <= 0.0, turn_before, turn_after) > 0
    both = (own > 0) & (neighbour > 0)
    either = (own > 0) | (neighbour > 0)
    at_vertex = (t <= 0.0) | (t >= 1.0)
    return jnp.where(at_vertex, jnp.where(left_turn, both, either), own > 0)


def _cross(
    ax: Float[Array, " n"],
    ay: Float[Array, " n"],
    bx: Float[Array, " n"],
    by: Float[Array, " n"],
) -> Float[Array, " n"]:
    return ax * by - ay * bx
