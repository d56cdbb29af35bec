"""Routes of a scene's objects, as the bank holds them.

- `route`: the logged path, continued beyond the log's end by `ROUTE_AHEAD` along the
  lane that the log ends on and, at forks, its straightest successors; straight where
  no lane is within 3.5 m with a heading within 45 degrees, behind a lane's last
  successor, and for pedestrians.
- `path_*`: the lane paths that it could take (`sim.lane_paths`), as chunks of a table.
- `stop_position`: where each stop sign's lanes cross it.
"""

from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from sim import lane_paths
from sim.lane_paths import CHUNK, MAX_CHUNKS, ON, Chunks, Line, Piece
from sim.lanes import (
    LANE_REACH,
    NOWHERE,
    LaneGraph,
    arc_lengths,
    lane_graph,
    nearest,
    on_lane,
    turned,
)
from sim.scene import ObjectType, RoadKind, Scene, SceneError

ROUTE_POINTS = 64
ROUTE_AHEAD = 80.0  # m that a route goes on behind the log's end
ROUTE_STEP = 0.5  # m: shorter moves are jitter of a standing object
REJOIN = 5.0  # m ahead at which a route has come from the log's end onto the lane
FORK_LOOK = 15.0  # m of a successor whose direction decides at a fork
SIGN_REACH = 10.0  # m between a stop sign and a lane that it may stand for

PER_OBJECT = (
    *("route_spacing", "route_start", "route_end", "route_speed"),
    *("path_start", "path_end"),
)
PER_CHUNK = ("path_chunk", "path_flags", "path_offset")


class Drive(NamedTuple):
    """The valid part of an object's log."""

    xy: Float[np.ndarray, "steps 2"]  # m
    yaw: Float[np.ndarray, " steps"]
    start: int  # the first at or behind the scene's current step; else the last


class _Row(NamedTuple):
    """An object's paths: chunks of the scene's table, on-route and near ones first."""

    chunk: Int[np.ndarray, " chunks"]
    flags: Int[np.ndarray, " chunks"]
    offset: Float[np.ndarray, " chunks"]  # m, arc length of the chunk's start


def routes_of(scene: Scene, origin: Float[np.ndarray, "3"]) -> dict[str, Any]:
    """The scene's part of the bank's arrays of routes, positions less `origin`."""
    graph = lane_graph(scene.roads, origin[:2])
    motor = graph.without_bikes()
    table = _Table(graph)
    route = np.zeros((scene.objects, ROUTE_POINTS, 2), np.float32)
    spacing = np.ones(scene.objects, np.float32)
    marks = np.zeros((5, scene.objects), np.float32)
    rows = [_Row(*np.zeros((3, 0)))] * scene.objects
    for index in range(scene.objects):
        drive = drive_of(scene, index, origin[:2])
        if drive is None:
            continue
        cyclist = scene.object_types[index] == ObjectType.CYCLIST
        walks = scene.object_types[index] == ObjectType.PEDESTRIAN
        own = graph if cyclist else motor
        first = last = NOWHERE
        pieces: list[Piece] = []
        if not walks and len(own.lines):
            pieces, first, last = paths_of(own, drive)
        if index == scene.sdc_index and scene.sdc_paths:
            ends = drive.xy[[drive.start, -1]]
            pieces = lane_paths.sample_pieces(scene.sdc_paths, origin[:2], ends)
        onward = np.zeros((0, 2)) if walks else _onward(own, drive, last)
        route[index], spacing[index], *marks[:2, index] = _logged(drive, onward)
        marks[2, index] = own.speed_limit[first] if first != NOWHERE else 0.0
        rows[index] = table.row(pieces)
        marks[3:, index] = table.extent(rows[index], drive)
    if len(table.points) > 2**16:
        raise SceneError(
            f"{scene.source or scene.scenario_id}: {len(table.points)} lane pieces, "
            f"at most {2**16}; crop the map"
        )
    return {
        "route": route,
        **dict(zip(PER_OBJECT, [spacing, *marks], strict=True)),
        **_packed(rows),
        "chunks": np.array(table.points, np.float32).reshape(-1, 2, CHUNK + 1),
        "stop_position": _stops(scene, graph, origin[:2]).astype(np.float32),
    }


def drive_of(scene: Scene, index: int, origin: Float[np.ndarray, "2"]) -> Drive | None:
    """The object's log, positions less `origin`; None where it has none."""
    seen = np.flatnonzero(scene.valid[index])
    if not len(seen):
        return None
    start = min(int(np.searchsorted(seen, scene.current_step)), len(seen) - 1)
    xy = scene.position[index, seen, :2] - origin
    return Drive(xy, scene.yaw[index, seen], start)


def paths_of(graph: LaneGraph, drive: Drive) -> tuple[list[Piece], int, int]:
    """The paths from where it starts to act, and the first and last lane."""
    xy, yaw = drive.xy[drive.start :], drive.yaw[drive.start :]
    kept = lane_paths.poses(xy)
    pieces, lanes = lane_paths.object_pieces(graph, xy[kept], yaw[kept])
    return pieces, int(lanes[0]), int(lanes[-1])


def _logged(
    drive: Drive, onward: Float[np.ndarray, "more 2"]
) -> tuple[Float[np.ndarray, "points 2"], float, float, float]:
    """The logged path and `onward`, equally spaced; the spacing; where the log is."""
    knots, reached = _knots(drive.xy)
    heading = np.array([np.cos(drive.yaw[-1]), np.sin(drive.yaw[-1])])
    if len(knots) > 1:
        heading = knots[-1] - knots[-2]
        heading /= np.hypot(*heading)
    if len(onward):
        heading = onward[-1] - (onward[-2] if len(onward) > 1 else knots[-1])
        heading /= max(np.hypot(*heading), 1e-9)
    points = np.concatenate([knots, onward])
    arc = arc_lengths(points)
    begun, end = arc[reached[drive.start]], arc[reached[-1]]
    missing = end + ROUTE_AHEAD - arc[-1]
    if missing > 1e-6:
        points = np.concatenate([points, points[-1:] + missing * heading])
        arc = arc_lengths(points)
    at = np.linspace(0.0, end + ROUTE_AHEAD, ROUTE_POINTS)
    even = np.stack([np.interp(at, arc, points[:, k]) for k in (0, 1)], -1)
    return even, float(at[1]), float(begun), float(end)


def _knots(
    path: Float[np.ndarray, "points 2"],
) -> tuple[Float[np.ndarray, "knots 2"], Int[np.ndarray, " points"]]:
    """The path less its jitter, and the last knot that each point had reached."""
    kept, reached = [0], []
    for index in range(len(path)):
        if np.hypot(*(path[index] - path[kept[-1]])) > ROUTE_STEP:
            kept.append(index)
        reached.append(len(kept) - 1)
    return path[kept], np.array(reached)


def _onward(graph: LaneGraph, drive: Drive, lane: int) -> Float[np.ndarray, "points 2"]:
    """The lanes' centres from `REJOIN` ahead of the log's end, `ROUTE_AHEAD` long."""
    none = np.zeros((0, 2))
    if not len(graph.lines):
        return none
    near = nearest(graph.segments, drive.xy[-1:], drive.yaw[-1:], LANE_REACH)
    on = on_lane(graph, near)[0]
    if not on.any():
        return none
    column = int(np.where(on, near.distance[0], np.inf).argmin())
    if (on & (near.lines == lane)).any():
        column = int(np.flatnonzero(near.lines == lane)[0])
    lane = int(near.lines[column])
    start = float(near.arc[0, column]) + REJOIN
    parts: list[np.ndarray] = []
    length, seen = 0.0, set[int]()
    while lane not in seen and length < ROUTE_AHEAD:
        seen.add(lane)
        line, arc = graph.lines[lane], graph.arcs[lane]
        if start < arc[-1]:
            at = np.r_[start, arc[arc > start]]
            parts.append(np.stack([np.interp(at, arc, line[:, k]) for k in (0, 1)], -1))
        length += max(float(arc[-1]) - start, 0.0)
        start = max(start - float(arc[-1]), 0.0)
        lane = _straightest(graph, lane)
    return np.concatenate([none, *parts])


def _straightest(graph: LaneGraph, lane: int) -> int:
    """The successor that turns least within `FORK_LOOK`; the lane itself at an end."""
    line = graph.lines[lane]
    yaw = _angle(line[-1] - line[-2])

    def turn(successor: int) -> float:
        points, arc = graph.lines[successor], graph.arcs[successor]
        ahead = [np.interp(FORK_LOOK, arc, points[:, k]) for k in (0, 1)]
        return float(turned(_angle(np.array(ahead) - points[0]), yaw))

    return min(graph.exits[lane], key=turn, default=lane)


def _angle(direction: Float[np.ndarray, "2"]) -> Float[np.ndarray, ""]:
    return np.asarray(np.arctan2(direction[1], direction[0]))


@final
class _Table:
    """The chunks of a scene's lanes that some object's paths use."""

    def __init__(self, graph: LaneGraph) -> None:
        """Starts empty."""
        self._graph = graph
        self._lanes: dict[int, tuple[int, Chunks]] = {}
        self.points: list[np.ndarray] = []

    def row(self, pieces: list[Piece]) -> _Row:
        """The chunks of some pieces."""
        parts = [np.zeros((3, 0))]
        for line, offset, flags in pieces:
            first, chunks = self._chunks(line)
            count = len(chunks.arc)
            parts.append(
                np.stack(
                    [
                        first + np.arange(count),
                        np.full(count, flags),
                        offset + chunks.arc,
                    ]
                )
            )
        row = np.concatenate(parts, 1)
        order = np.lexsort((row[2], row[1].astype(int) & ON == 0))
        chunk, flags, offset = row[:, order[:MAX_CHUNKS]]
        return _Row(chunk.astype(int), flags.astype(int), offset)

    def _chunks(self, line: int | Line) -> tuple[int, Chunks]:
        if isinstance(line, int) and line in self._lanes:
            return self._lanes[line]
        if isinstance(line, int):
            cut = lane_paths.chunks_of(
                Line(self._graph.lines[line], self._graph.arcs[line])
            )
        else:
            cut = lane_paths.chunks_of(line)
        entry = (len(self.points), cut)
        self.points += list(cut.points.transpose(0, 2, 1))
        if isinstance(line, int):
            self._lanes[line] = entry
        return entry

    def extent(self, row: _Row, drive: Drive) -> tuple[float, float]:
        """Arc lengths on the nearest on-route path where the log starts and ends."""
        on = row.flags & ON > 0
        if not on.any():
            return 0.0, 0.0
        points = np.array([self.points[chunk] for chunk in row.chunk[on]])
        ends = drive.xy[[drive.start, -1]]
        points = points.transpose(0, 2, 1)
        start, along = points[:, :-1], np.diff(points, axis=1)
        lengths = np.hypot(along[..., 0], along[..., 1])
        arc = row.offset[on][:, None] + np.cumsum(lengths, 1) - lengths
        found = []
        for xy in ends:
            t = ((xy - start) * along).sum(-1) / np.maximum(lengths**2, 1e-12)
            t = np.clip(t, 0.0, 1.0)
            away = ((xy - start - t[..., None] * along) ** 2).sum(-1)
            best = int(away.argmin())
            found.append(float((arc + t * lengths).flat[best]))
        return found[0], found[1]


def _packed(rows: list[_Row]) -> dict[str, np.ndarray]:
    """Rows of one width; what fills up belongs to no path."""
    width = max((len(row.chunk) for row in rows), default=0)
    shape = (len(rows), width)
    chunk, flags = np.zeros(shape, np.uint16), np.zeros(shape, np.uint8)
    offset = np.zeros(shape, np.float32)
    for index, row in enumerate(rows):
        count = len(row.chunk)
        chunk[index, :count] = row.chunk
        flags[index, :count] = row.flags
        offset[index, :count] = row.offset
    return dict(zip(PER_CHUNK, (chunk, flags, offset), strict=True))


def _stops(
    scene: Scene, graph: LaneGraph, origin: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "stops 2"]:
    """Where the lanes of each stop sign pass it: the nearest point of each.

    A sign that names none of the scene's lanes stands for the nearest lane within
    `SIGN_REACH` that has it on its right.
    """
    row = {name: index for index, name in enumerate(graph.feature_ids)}
    stops: list[np.ndarray] = []
    for road in scene.roads:
        if road.kind != RoadKind.STOP_SIGN or not len(graph.lines):
            continue
        sign = road.points[:1, :2] - origin
        near = nearest(graph.segments, sign, np.zeros(1), np.inf)  # all lanes, in order
        at = [graph.at(lane, float(arc)) for lane, arc in enumerate(near.arc[0])]
        named = [row[name] for name in road.stop_lanes if name in row]
        if named:
            stops += [at[lane][0] for lane in named]
            continue
        right = np.array([_cross(yaw, sign[0] - point) < 0 for point, yaw in at], bool)
        right &= near.distance[0] <= SIGN_REACH
        if right.any():
            stops.append(at[int(np.where(right, near.distance[0], np.inf).argmin())][0])
    return np.array(stops).reshape(-1, 2)


def _cross(yaw: float, offset: Float[np.ndarray, "2"]) -> float:
    """Positive where `offset` points to the left of the heading [m]."""
    return float(np.cos(yaw) * offset[1] - np.sin(yaw) * offset[0])
