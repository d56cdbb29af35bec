"""Per-scene lookup of the nearest map segments, so that no step searches the map.

A uniform grid of square cells of `CELL` metres covers the map and every logged position
with a margin. Each cell within `ROW_REACH` of the map lists the segments nearest to its
centre, nearest first, for the observation. Polylines are decimated (Douglas-Peucker,
`ROW_TOLERANCE`), then split so that no segment is longer than two cells. The off-road
metric's table over the same grid is `sim.edge_table`.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from sim.scene import Polyline, RoadKind, Scene

CELL = 5.0  # m
FINE = 4  # fine cells a side of a cell
EDGE_CELL = CELL / FINE
MARGIN = 10.0  # m around the map's and the logs' bounding box
ROW_TOLERANCE = 0.15  # m
BLOCK = 8  # cells a side of the squares that `row_table` looks at together
ROW_REACH = 25.0  # m: a cell farther than this from every segment lists none

ROW_KINDS = (
    RoadKind.LANE_UNKNOWN,
    RoadKind.LANE_FREEWAY,
    RoadKind.LANE_STREET,
    RoadKind.LANE_BIKE,
    *(kind for kind in RoadKind if 5 <= kind <= 19),
)

ROAD_CLASSES = ("lane", "line", "edge", "stop sign", "crosswalk", "speed bump")


@dataclass(frozen=True)
class Grid:
    """A uniform grid; cell (i, j) covers origin + CELL * [(i, j), (i + 1, j + 1))."""

    origin: Float[np.ndarray, "2"]  # m
    shape: tuple[int, int]  # cells along x and y

    @property
    def cells(self) -> int:
        """Number of cells; cell (i, j) is number i * shape[1] + j."""
        return self.shape[0] * self.shape[1]

    @property
    def fine(self) -> "Grid":
        """The same area in cells of `EDGE_CELL`."""
        return Grid(self.origin, (self.shape[0] * FINE, self.shape[1] * FINE))

    def centres(self, cells: Int[np.ndarray, " cells"]) -> Float[np.ndarray, "cells 2"]:
        """The centres of these cells [m]."""
        i, j = np.divmod(cells, self.shape[1])
        return self.origin + CELL * (np.stack([i, j], -1) + 0.5)


def grid_of(scene: Scene) -> Grid:
    """A grid over the map and every valid logged position."""
    points = [line.points[:, :2] for line in scene.roads]
    points.append(scene.position[scene.valid][:, :2])
    every = np.concatenate(points)
    low = np.floor((every.min(0) - MARGIN) / CELL) * CELL
    cells = np.ceil((every.max(0) + MARGIN - low) / CELL).astype(int)
    return Grid(low, (int(cells[0]), int(cells[1])))


def row_segments(
    roads: tuple[Polyline, ...],
) -> tuple[Float[np.ndarray, "segments 4"], Int[np.ndarray, " segments"]]:
    """The map as short segments (x0, y0, x1, y1) [m] and their `RoadKind`s."""
    ends, kinds = [], []
    for line in roads:
        if line.kind not in ROW_KINDS:
            continue
        points = line.points[:, :2]
        if line.kind in (RoadKind.CROSSWALK, RoadKind.SPEED_BUMP):
            points = np.concatenate([points, points[:1]])
        if len(points) == 1:
            segments = np.concatenate([points, points], 1)
        else:
            points = _split(points[keep_points(points, ROW_TOLERANCE)])
            segments = np.concatenate([points[:-1], points[1:]], 1)
        ends.append(segments)
        kinds.append(np.full(len(segments), int(line.kind), np.int8))
    if not ends:
        return np.zeros((0, 4)), np.zeros(0, np.int8)
    return np.concatenate(ends), np.concatenate(kinds)


def segment_rows(
    segments: Float[np.ndarray, "segments 4"], kinds: Int[np.ndarray, " segments"]
) -> Float[np.ndarray, "segments 11"]:
    """What is seen of each segment, in the map's frame.

    Columns: the middle x, y [m], the unit direction, the half length [m], and one
    column for each of `ROAD_CLASSES`.
    """
    along = segments[:, 2:] - segments[:, :2]
    length = np.hypot(*along.T)
    # Kinds are ordered so that bounds decide.
    bounds = (
        RoadKind.LINE_UNKNOWN,
        RoadKind.EDGE_UNKNOWN,
        RoadKind.STOP_SIGN,
        RoadKind.CROSSWALK,
        RoadKind.SPEED_BUMP,
    )
    classes = np.searchsorted([int(bound) for bound in bounds], kinds, side="right")
    return np.concatenate(
        [
            (segments[:, :2] + segments[:, 2:]) / 2,
            along / np.maximum(length, 1e-6)[:, None],
            length[:, None] / 2,
            classes[:, None] == np.arange(len(ROAD_CLASSES)),
        ],
        -1,
    )


def keep_points(
    points: Float[np.ndarray, "points 2"], tolerance: float
) -> Bool[np.ndarray, " points"]:
    """Douglas-Peucker: what is kept lies within `tolerance` [m] of what was there."""
    keep = np.zeros(len(points), bool)
    keep[[0, -1]] = True
    stack = [(0, len(points) - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        chord = points[last] - points[first]
        offset = points[first + 1 : last] - points[first]
        length = np.hypot(*chord)
        if length > 1e-9:
            away = np.abs(chord[0] * offset[:, 1] - chord[1] * offset[:, 0]) / length
        else:
            away = np.hypot(*offset.T)
        worst = int(away.argmax())
        if away[worst] > tolerance:
            keep[first + 1 + worst] = True
            stack += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return keep


def _split(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "more 2"]:
    """Cuts every segment into equal pieces of at most two cells."""
    steps = np.diff(points, axis=0)
    pieces = np.maximum(np.ceil(np.hypot(*steps.T) / (2 * CELL)), 1).astype(int)
    index = np.repeat(np.arange(len(pieces)), pieces)
    first = np.concatenate([[0], np.cumsum(pieces)[:-1]])
    part = (np.arange(len(index)) - first[index]) / pieces[index]
    cut = points[index] + part[:, None] * steps[index]
    return np.concatenate([cut, points[-1:]])


def row_table(
    grid: Grid, segments: Float[np.ndarray, "segments 4"], rows: int
) -> tuple[
    Int[np.ndarray, " cells"], UInt[np.ndarray, "kept rows"], UInt[np.ndarray, " kept"]
]:
    """The `rows` segments nearest to each cell's centre, nearest first, and how many.

    Distance is to the nearest point of the segment. The first array names each cell's
    row of the other two, -1 where the map is out of reach.
    """
    count = min(rows, len(segments))
    row_of = np.full(grid.cells, -1, np.int32)
    found = [np.zeros((0, rows), np.uint16)]
    kept = 0
    for cells in _blocks(grid) if count else ():
        centres = grid.centres(cells)
        candidates = _block_segments(centres, segments, count)
        if not len(candidates):
            continue
        distance = _squared_distance(centres, segments[candidates])
        near = np.flatnonzero(distance.min(1) <= ROW_REACH**2)
        distance = distance[near]
        if count < len(candidates):
            part = np.argpartition(distance, count - 1, axis=1)[:, :count]
        else:
            part = np.broadcast_to(np.arange(len(candidates)), distance.shape)
        order = np.take_along_axis(distance, part, 1).argsort(1, kind="stable")
        nearest = np.zeros((len(near), rows), np.uint16)
        nearest[:, :count] = candidates[np.take_along_axis(part, order, 1)]
        row_of[cells[near]] = kept + np.arange(len(near))
        kept += len(near)
        found.append(nearest)
    return row_of, np.concatenate(found), np.full(kept, count, np.uint16)


def _blocks(grid: Grid) -> Iterator[Int[np.ndarray, " cells"]]:
    """The cells' numbers, `BLOCK` by `BLOCK`."""
    numbers = np.arange(grid.cells).reshape(grid.shape)
    for i in range(0, grid.shape[0], BLOCK):
        for j in range(0, grid.shape[1], BLOCK):
            yield numbers[i : i + BLOCK, j : j + BLOCK].ravel()


def _block_segments(
    centres: Float[np.ndarray, "cells 2"],
    segments: Float[np.ndarray, "segments 4"],
    count: int,
) -> Int[np.ndarray, " candidates"]:
    """The segments that can be among the `count` nearest of a cell of a block.

    Distance changes by at most the way between two points: from the block's middle,
    what is farther than the `count`-th nearest by twice the block's radius is out. A
    block that the map is out of reach of has none.
    """
    middle = (centres.min(0) + centres.max(0)) / 2
    radius = float(np.hypot(*(centres.max(0) - middle)))
    distance = np.sqrt(_squared_distance(middle[None], segments))[0]
    if distance.min() > ROW_REACH + radius:
        return np.zeros(0, np.int64)
    bound = np.partition(distance, count - 1)[count - 1] + 2 * radius + 0.01
    return np.flatnonzero(distance <= bound)


def _squared_distance(
    points: Float[np.ndarray, "points 2"], segments: Float[np.ndarray, "segments 4"]
) -> Float[np.ndarray, "points segments"]:
    """Squared distance of every point from every segment [m^2]."""
    along = segments[:, 2:] - segments[:, :2]
    squared = np.maximum((along**2).sum(-1), 1e-9)
    x = points[:, None, 0] - segments[:, 0]
    y = points[:, None, 1] - segments[:, 1]
    t = np.clip((x * along[:, 0] + y * along[:, 1]) / squared, 0.0, 1.0)
    x -= t * along[:, 0]
    y -= t * along[:, 1]
    return x * x + y * y
