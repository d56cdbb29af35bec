"""Per-scene table of the road edges that can decide whether a point is off the road.

For each fine cell (`EDGE_CELL` metres a side): the road-edge segments that can be the
nearest edge of some point of the cell. They are exact, not decimated: a segment is left
out only where another one is nearer to every point of the cell, or where all of them
agree on the side, in which case the cell itself carries the answer. Distances count
height twice, as the metric does; a cell holds for heights from `BELOW` under the lowest
to `ABOVE` over the highest road point nearby.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sim.scene import Polyline
from sim.tables import CELL, EDGE_CELL, FINE, Grid

BELOW, ABOVE = 0.5, 3.0  # m; a box's centre is 0.5 to 2 m above the road
NEARBY = 3  # cells: road points this near to a cell set its range of heights
LEVELS = (128, 32, 8, 1)  # sides of the squares that `edge_table` decides, fine cells
PAIRS = 2**20  # of squares and edges compared at a time: some 150 MB
CLOSED = 1e-3  # m between the ends of an edge that is a ring
HEIGHT_WEIGHT = 2.0  # the benchmark's: a bridge is not the road below

DRIVABLE = -1  # every point of the cell is on the drivable side
UNDRIVABLE = -2
MIXED = 0  # the cell's candidates decide


@dataclass(frozen=True)
class Edges:
    """Road-edge segments a -> a + d of one scene with their polyline neighbours.

    A segment without a neighbour at an end has itself there, so that the vertex rule
    (both adjoining segments decide) falls back to its own side.
    """

    start: Float[np.ndarray, "edges 3"]  # m
    along: Float[np.ndarray, "edges 3"]  # m
    previous: Float[np.ndarray, "edges 2"]  # the segment before's `along`, x and y
    following: Float[np.ndarray, "edges 2"]

    def take(self, index: Int[np.ndarray, " some"]) -> "Edges":
        """Some of the segments."""
        return Edges(
            self.start[index],
            self.along[index],
            self.previous[index],
            self.following[index],
        )

    def packed(self) -> Float[np.ndarray, "edges 10"]:
        """One row a segment: start, along, previous, following."""
        parts = [self.start, self.along, self.previous, self.following]
        return np.concatenate(parts, -1).astype(np.float32)


def edges_of(roads: tuple[Polyline, ...]) -> Edges:
    """All road-edge segments; polylines that end where they begin are closed."""
    start, along, previous, following = [], [], [], []
    for line in roads:
        if not line.kind.is_edge:
            continue
        points = _without_repeats(line.points)
        if len(points) < 2:
            continue
        steps = np.diff(points, axis=0)
        gap = np.hypot.reduce(points[0] - points[-1])
        closed = len(points) > 3 and gap < CLOSED
        before, after = np.roll(steps, 1, 0), np.roll(steps, -1, 0)
        if not closed:
            before[0], after[-1] = steps[0], steps[-1]
        start.append(points[:-1])
        along.append(steps)
        previous.append(before[:, :2])
        following.append(after[:, :2])
    if not start:
        return Edges(
            np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2))
        )
    return Edges(*map(np.concatenate, (start, along, previous, following)))


def _without_repeats(
    points: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "kept 3"]:
    """Drops points that repeat the one before in the plane (a step of no length)."""
    moves = np.abs(np.diff(points[:, :2], axis=0)).max(1, initial=0.0) > 1e-6
    return points[np.concatenate([[True], moves])]


def edge_table(
    grid: Grid, edges: Edges, ground: Float[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, " fine"], list[Int[np.ndarray, " _"]]]:
    """Each fine cell's state (MIXED, ...) and, where it is MIXED, its candidates,
    nearest to its centre first.

    Fine cell (i, j) of `grid.fine` covers `EDGE_CELL` metres a side. Squares of
    `LEVELS` narrow the edges down from large to small; one that all its edges agree on
    is done.
    """
    fine = grid.fine
    state = np.full(fine.shape, DRIVABLE, np.int32)
    candidates = [np.zeros(0, np.int64)] * fine.cells
    if not len(edges.start):
        return state.ravel(), candidates
    heights = _height_ranges(grid, ground)
    every = np.arange(len(edges.start))
    pending = [(np.zeros(2, int), every, max(fine.shape))]
    while pending:
        corner, index, width = pending.pop()
        size = next(level for level in LEVELS if level < width)
        subset = edges.take(index)
        for corners in _portions(_children(corner, width, size, fine.shape), index):
            centres = grid.origin + (corners + size / 2) * EDGE_CELL
            bounds = _bounds(heights, corners, size)
            possible, squared = _possible(centres, bounds, subset, size * EDGE_CELL)
            agreed = _agreed(centres, possible, subset, size * EDGE_CELL)
            _paint(state, corners, size, agreed)
            for row in np.flatnonzero(agreed == MIXED):
                i, j = corners[row]
                near = np.flatnonzero(possible[row])
                if size > 1:
                    pending.append((corners[row], index[near], size))
                else:
                    near = near[squared[row, near].argsort(kind="stable")]
                    candidates[i * fine.shape[1] + j] = index[near]
    return state.ravel(), candidates


def _portions(
    corners: Int[np.ndarray, "squares 2"], index: Int[np.ndarray, " edges"]
) -> list[Int[np.ndarray, "_ 2"]]:
    """The squares in portions of at most `PAIRS` pairs with an edge, or one square."""
    size = max(PAIRS // len(index), 1)
    return [corners[i : i + size] for i in range(0, len(corners), size)]


def _paint(
    state: Int[np.ndarray, "across along"],
    corners: Int[np.ndarray, "squares 2"],
    size: int,
    values: Int[np.ndarray, " squares"],
) -> None:
    """Gives every fine cell of each square its value, as far as the grid reaches."""
    if size == 1:
        state[corners[:, 0], corners[:, 1]] = values
        return
    for (i, j), value in zip(corners, values, strict=True):
        state[i : i + size, j : j + size] = value


def _children(
    corner: Int[np.ndarray, "2"], width: int, size: int, shape: tuple[int, int]
) -> Int[np.ndarray, "children 2"]:
    """First fine cells of the squares of `size` within a square of `width`."""
    steps = np.arange(0, width, size)
    corners = corner + np.stack(np.meshgrid(steps, steps, indexing="ij"), -1)
    corners = corners.reshape(-1, 2)
    return corners[(corners < shape).all(1)]


def _bounds(
    heights: Float[np.ndarray, "2 across along"],
    corners: Int[np.ndarray, "squares 2"],
    size: int,
) -> Float[np.ndarray, "squares 2"]:
    """The range of heights over each square [m], from those of the cells in it."""
    first = corners // FINE
    reach = np.arange(max(size // FINE, 1))
    i = np.minimum(first[:, 0, None] + reach, heights.shape[1] - 1)
    j = np.minimum(first[:, 1, None] + reach, heights.shape[2] - 1)
    low = heights[0][i[:, :, None], j[:, None]].min((1, 2))
    high = heights[1][i[:, :, None], j[:, None]].max((1, 2))
    return np.stack([low, high], -1)


def _agreed(
    centres: Float[np.ndarray, "cells 2"],
    possible: Bool[np.ndarray, "cells edges"],
    edges: Edges,
    size: float,
) -> Int[np.ndarray, " cells"]:
    """DRIVABLE or UNDRIVABLE where all possible edges say so of the whole cell."""
    left, right = _sides(centres, edges, size)
    all_left = (left | ~possible).all(1)
    all_right = (right | ~possible).all(1)
    return np.where(all_left, DRIVABLE, np.where(all_right, UNDRIVABLE, MIXED))


def _height_ranges(
    grid: Grid, ground: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "2 across along"]:
    """Lowest and highest height of a box's centre to allow for in each cell [m].

    From the road points within `NEARBY` cells; a cell with none takes the scene's.
    """
    cells = np.floor((ground[:, :2] - grid.origin) / CELL).astype(int)
    cells = np.clip(cells, 0, np.array(grid.shape) - 1)
    low = np.full(grid.shape, np.inf)
    high = np.full(grid.shape, -np.inf)
    np.minimum.at(low, (cells[:, 0], cells[:, 1]), ground[:, 2])
    np.maximum.at(high, (cells[:, 0], cells[:, 1]), ground[:, 2])
    for axis in (0, 1):
        low = _spread(low, axis, np.minimum, np.inf)
        high = _spread(high, axis, np.maximum, -np.inf)
    none = np.isinf(low)
    low[none], high[none] = ground[:, 2].min(), ground[:, 2].max()
    return np.stack([low - BELOW, high + ABOVE])


def _spread(
    values: Float[np.ndarray, "across along"],
    axis: int,
    combine: np.ufunc,
    empty: float,
) -> Float[np.ndarray, "across along"]:
    """Each cell combined with the `NEARBY` cells on either side along an axis."""
    pads = [(NEARBY, NEARBY) if k == axis else (0, 0) for k in (0, 1)]
    padded = np.pad(values, pads, constant_values=empty)
    length = values.shape[axis]
    shifted = [
        np.take(padded, np.arange(shift, shift + length), axis)
        for shift in range(2 * NEARBY + 1)
    ]
    return np.asarray(combine.reduce(shifted))


def _possible(
    centres: Float[np.ndarray, "cells 2"],
    heights: Float[np.ndarray, "cells 2"],
    edges: Edges,
    size: float,
) -> tuple[Bool[np.ndarray, "cells edges"], Float[np.ndarray, "cells edges"]]:
    """Whether the edge can be the nearest one of some point of the cell.

    With it the squared distances from the cell's centre [m^2, height-weighted].

    In height-weighted coordinates let c be the centre of the cell's box, h its half
    sides, q the point of the edges nearest to c. For any point c + o of the box and
    any point s of edge k, |c + o - s|^2 - |c + o - q|^2 = |c - s|^2 - |c - q|^2
    - 2 o (s - q). The first term is at least k's squared distance from c, the last at
    most 2 h |s - q|, which is convex and thus largest at an end of k: where their
    difference is positive, q is nearer than k everywhere in the box.
    """
    weights = np.array([1.0, 1.0, HEIGHT_WEIGHT])
    centre = np.concatenate([centres, heights.mean(1, keepdims=True)], 1) * weights
    half = np.full((len(centres), 3), size / 2)
    half[:, 2] = HEIGHT_WEIGHT * (heights[:, 1] - heights[:, 0]) / 2
    start, along = edges.start * weights, edges.along * weights
    offset = centre[:, None] - start
    t = np.einsum("ced,ed->ce", offset, along) / (along**2).sum(-1)
    t = np.clip(t, 0.0, 1.0)
    offset -= t[..., None] * along
    squared = np.einsum("ced,ced->ce", offset, offset)
    best = squared.argmin(1)
    rows = np.arange(len(centre))
    nearest = (start[best] + t[rows, best, None] * along[best])[:, None]
    reach = np.maximum(
        np.einsum("ced,cd->ce", np.abs(start - nearest), half),
        np.einsum("ced,cd->ce", np.abs(start + along - nearest), half),
    )
    # 0.01 m^2 of slack covers float32 arithmetic a few hundred metres out.
    return squared - squared[rows, best, None] <= 2 * reach + 0.01, squared


def _sides(
    centres: Float[np.ndarray, "cells 2"], edges: Edges, size: float
) -> tuple[Bool[np.ndarray, "cells edges"], Bool[np.ndarray, "cells edges"]]:
    """Whether the whole cell lies left, or right, of a segment and its neighbours.

    The vertex rule asks a segment's neighbours too, hence all three.
    """
    left = np.ones((len(centres), len(edges.start)), bool)
    right = left.copy()
    end = edges.start + edges.along
    for through, along in (
        (edges.start, edges.along[:, :2]),
        (edges.start, edges.previous),
        (end, edges.following),
    ):
        offset = centres[:, None] - through[:, :2]
        cross = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
        reach = size / 2 * np.abs(along).sum(1) + 0.01 * np.hypot(*along.T)
        left &= cross > reach
        right &= cross < -reach
    return left, right
