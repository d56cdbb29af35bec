"""The lanes of a scene as a directed graph, and which of them a recorded drive took.

Graph: a lane's successors are its `exit_lanes` (and the lanes whose `entry_lanes` name
it). Where no lane of a scene names any (GPUDrive, `tf.Example`), a lane follows another
if it begins within `JOIN_DISTANCE` of the other's end and their directions there differ
by less than `JOIN_ANGLE`; on the recorded scene that has a graph this finds its edges.

Matching: the most likely sequence of lanes under a log, after Newson and Krumm, Hidden
Markov map matching through noise and sparseness, 2009: every pose has a cost in every
lane that it can be on (distance and heading), going on along the graph costs little,
any other change of lane `HOP_COST`. So a pose where several lanes overlap, as behind a
fork, is on the one that the drive stays on. Departures: distances and headings are
normal, changes of lane have one price instead of one by distance, and a pose may be on
no lane at all (`OFF_COST`).
"""

import dataclasses
import heapq
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sim.scene import Polyline, RoadKind
from sim.tables import keep_points

JOIN_DISTANCE = 0.1  # m; recorded lanes join within 1 mm
JOIN_ANGLE = np.deg2rad(45.0)
LANE_REACH = 3.5  # m: an object farther from a lane's centre is not on it
LANE_ANGLE = np.deg2rad(45.0)  # nor one that heads elsewhere
LANE_BEYOND = 1.0  # m: nor one that has left it at its end
TOLERANCE = 0.01  # m between a lane and what is kept of it
DISTANCE_SCALE = 1.0  # m, standard deviation of an object's offset
ANGLE_SCALE = np.deg2rad(20.0)  # standard deviation of its heading
NEXT_COST = 0.1  # of going on along the graph: staying is the default
HOP_COST = 12.0  # of any other change: worth 3.5 m for two poses
OFF_COST = 12.0  # of a pose on no lane: above any that is on one
SKIP = 5.0  # m of short lanes that a drive may pass between two poses, beyond its move
BLOCK = 16  # poses whose surroundings are looked at together
NOWHERE = -1  # the lane of a pose that is on none


class Segments(NamedTuple):
    """Straight pieces of polylines; `line` ascends."""

    start: Float[np.ndarray, "segments 2"]  # m
    along: Float[np.ndarray, "segments 2"]  # m, to the end
    arc: Float[np.ndarray, " segments"]  # m, the start's arc length on its line
    line: Int[np.ndarray, " segments"]


@dataclass(frozen=True)
class LaneGraph:
    """Lanes of at least two points, and what follows each."""

    lines: tuple[Float[np.ndarray, "_ 2"], ...]  # m, decimated to `TOLERANCE`
    arcs: tuple[Float[np.ndarray, " _"], ...]  # m, of the source's polyline there
    exits: tuple[tuple[int, ...], ...]
    bike: Bool[np.ndarray, " lanes"]
    speed_limit: Float[np.ndarray, " lanes"]  # m/s, 0 where unknown
    feature_ids: tuple[int, ...]
    segments: Segments
    bikes: bool = True  # whether its traffic uses bike lanes

    @property
    def usable(self) -> Bool[np.ndarray, " lanes"]:
        """The lanes that its traffic may be on."""
        return ~self.bike | self.bikes

    def without_bikes(self) -> "LaneGraph":
        """The graph for motor vehicles: bike lanes keep their numbers, unconnected."""
        exits = tuple(
            tuple(lane for lane in following if not self.bike[lane])
            for following in self.exits
        )
        return dataclasses.replace(self, exits=exits, bikes=False)

    def at(self, lane: int, arc: float) -> tuple[Float[np.ndarray, "2"], float]:
        """The point of a lane at an arc length [m], and its heading there [rad]."""
        line, arcs = self.lines[lane], self.arcs[lane]
        index = int(np.clip(np.searchsorted(arcs, arc) - 1, 0, len(line) - 2))
        along = line[index + 1] - line[index]
        part = (arc - arcs[index]) / (arcs[index + 1] - arcs[index])
        return line[index] + part * along, float(_angle(along))

    def reach(
        self,
        starts: Sequence[tuple[int, float]],
        limit: float,
        passed: Collection[int] = (),
    ) -> dict[int, float]:
        """The shortest way [m] to the start of every lane within `limit`.

        `starts` are lanes with the way to their starts. Each lane is reached once and
        those `passed` before not again, so rings end.
        """
        found: dict[int, float] = {}
        heap = [(way, lane) for lane, way in starts]
        heapq.heapify(heap)
        while heap:
            way, lane = heapq.heappop(heap)
            if lane in found or lane in passed or way > limit:
                continue
            found[lane] = way
            length = float(self.arcs[lane][-1])
            for following in self.exits[lane]:
                heapq.heappush(heap, (way + length, following))
        return found

    def shortest(self, start: int, end: int, limit: float) -> tuple[int, ...] | None:
        """The lanes between two, if their length is within `limit` (none: ())."""
        heap: list[tuple[float, tuple[int, ...]]] = [(0.0, ())]
        seen: set[int] = set()
        while heap:
            way, between = heapq.heappop(heap)
            last = between[-1] if between else start
            if end in self.exits[last]:
                return between
            if last in seen:
                continue
            seen.add(last)
            for lane in self.exits[last]:
                further = way + float(self.arcs[lane][-1])
                if further <= limit:
                    heapq.heappush(heap, (further, (*between, lane)))
        return None


def lane_graph(roads: Sequence[Polyline], origin: Float[np.ndarray, "2"]) -> LaneGraph:
    """The graph of a scene's lanes, positions less `origin`."""
    lanes, lines, arcs = [], [], []
    for road in roads:
        points = without_repeats(road.points[:, :2] - origin)
        if road.kind.is_lane and len(points) > 1:
            kept = keep_points(points, TOLERANCE)
            lanes.append(road)
            lines.append(points[kept])
            arcs.append(arc_lengths(points)[kept])
    named = any(lane.exit_lanes or lane.entry_lanes for lane in lanes)
    return LaneGraph(
        lines=tuple(lines),
        arcs=tuple(arcs),
        exits=_named(lanes) if named else _joined(lines),
        bike=np.array([lane.kind == RoadKind.LANE_BIKE for lane in lanes], bool),
        speed_limit=np.array([lane.speed_limit for lane in lanes], float),
        feature_ids=tuple(lane.feature_id for lane in lanes),
        segments=segments_of(lines, arcs),
    )


def without_repeats(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "_ 2"]:
    """The polyline less the points that repeat the one before."""
    kept = np.ones(len(points), bool)
    kept[1:] = np.abs(np.diff(points, axis=0)).max(1, initial=0.0) > 1e-6
    return points[kept]


def arc_lengths(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
    """Each point's distance along the polyline [m]."""
    return np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]


def segments_of(lines: Sequence[np.ndarray], arcs: Sequence[np.ndarray]) -> Segments:
    """The pieces of some polylines."""
    empty = np.zeros((0, 2))
    return Segments(
        start=np.concatenate([empty, *(line[:-1] for line in lines)]),
        along=np.concatenate([empty, *(np.diff(line, axis=0) for line in lines)]),
        arc=np.concatenate([np.zeros(0), *(arc[:-1] for arc in arcs)]),
        line=np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines]),
    )


def _named(lanes: Sequence[Polyline]) -> tuple[tuple[int, ...], ...]:
    """Successors by feature id; ids that no lane has lead nowhere."""
    row = {lane.feature_id: index for index, lane in enumerate(lanes)}
    exits: list[set[int]] = [set() for _ in lanes]
    for index, lane in enumerate(lanes):
        exits[index].update(row[name] for name in lane.exit_lanes if name in row)
        for name in lane.entry_lanes:
            if name in row:
                exits[row[name]].add(index)
    return tuple(tuple(sorted(names)) for names in exits)


def _joined(lines: Sequence[np.ndarray]) -> tuple[tuple[int, ...], ...]:
    """Successors by where lanes begin and end."""
    starts = np.array([line[0] for line in lines]).reshape(-1, 2)
    order = np.argsort(starts[:, 0])
    sorted_x = starts[order, 0]
    exits = []
    for index, line in enumerate(lines):
        # By x first: all pairs would be too many where lanes are cut small.
        bounds = line[-1, 0] + np.array([-JOIN_DISTANCE, JOIN_DISTANCE])
        near = order[slice(*np.searchsorted(sorted_x, bounds))]
        near = near[np.hypot(*(starts[near] - line[-1]).T) < JOIN_DISTANCE]
        yaw = _angle(line[-1] - line[-2])
        exits.append(
            tuple(
                sorted(
                    int(lane)
                    for lane in near
                    if lane != index
                    and turned(_angle(lines[lane][1] - lines[lane][0]), yaw)
                    < JOIN_ANGLE
                )
            )
        )
    return tuple(exits)


def _angle(direction: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    return np.asarray(np.arctan2(direction[..., 1], direction[..., 0]))


def turned(
    yaw: Float[np.ndarray, "*n"], other: Float[np.ndarray, "*m"]
) -> Float[np.ndarray, "*k"]:
    """The angle between two headings, 0 to pi."""
    return np.asarray(np.abs((yaw - other + np.pi) % (2 * np.pi) - np.pi))


class Near(NamedTuple):
    """The nearest point of some lines to each pose."""

    lines: Int[np.ndarray, " lines"]  # numbers of the lines, ascending
    distance: Float[np.ndarray, "poses lines"]  # m
    arc: Float[np.ndarray, "poses lines"]  # m, along the line
    turn: Float[np.ndarray, "poses lines"]  # rad between heading and line, 0 to pi
    beyond: Float[np.ndarray, "poses lines"]  # m past the line's end; before it < 0


def nearest(
    segments: Segments,
    xy: Float[np.ndarray, "poses 2"],
    yaw: Float[np.ndarray, " poses"],
    reach: float,
) -> Near:
    """How poses stand to every line that is within `reach` of one of them.

    Farther segments of these lines may be left out.
    """
    ends = segments.start + segments.along
    low, high = np.minimum(segments.start, ends), np.maximum(segments.start, ends)
    kept = np.zeros(len(low), bool)
    for pose in range(0, len(xy), BLOCK):
        block = xy[pose : pose + BLOCK]
        inside = (low <= block.max(0) + reach).all(1)
        kept |= inside & (high >= block.min(0) - reach).all(1)
    start, along, arc, line = (value[kept] for value in segments)
    squared = np.maximum((along**2).sum(1), 1e-18)
    offset_x = xy[:, :1] - start[:, 0]
    offset_y = xy[:, 1:] - start[:, 1]
    part = (offset_x * along[:, 0] + offset_y * along[:, 1]) / squared
    t = np.clip(part, 0.0, 1.0)
    apart = np.hypot(offset_x - t * along[:, 0], offset_y - t * along[:, 1])
    lines, first = np.unique(line, return_index=True)
    close = np.minimum.reduceat(apart.min(0), first) <= reach
    bounds = np.stack([first, np.append(first, len(line))[1:]], -1)[close]
    lines = lines[close]
    shape = (len(xy), len(lines))
    distance, where, turn, beyond = (np.empty(shape) for _ in range(4))
    every = np.arange(len(xy))
    for column in range(len(lines)):
        begin, end = bounds[column]
        best = apart[:, begin:end].argmin(1) + begin
        length = np.sqrt(squared[best])
        distance[:, column] = apart[every, best]
        where[:, column] = arc[best] + t[every, best] * length
        turn[:, column] = turned(yaw, _angle(along[best]))
        beyond[:, column] = (part - t)[every, best] * length
    return Near(lines, distance, where, turn, beyond)


def on_lane(graph: LaneGraph, near: Near) -> Bool[np.ndarray, "poses lines"]:
    """Whether an object of a pose may be on a lane."""
    on = (near.distance <= LANE_REACH) & (near.turn <= LANE_ANGLE)
    return on & (np.abs(near.beyond) <= LANE_BEYOND) & graph.usable[near.lines]


def match(
    graph: LaneGraph,
    near: Near,
    moved: Float[np.ndarray, " moves"],
    barred: Bool[np.ndarray, "poses lines"],
) -> Int[np.ndarray, " poses"]:
    """The lane that a drive was on at each pose, `NOWHERE` where on none.

    `moved` are the metres from each pose to the next; `barred` lanes are not matched
    at a pose.
    """
    on = on_lane(graph, near) & ~barred
    used = np.flatnonzero(on.any(0))
    lanes = near.lines[used]
    cost = (near.distance / DISTANCE_SCALE) ** 2 / 2 + (
        near.turn / ANGLE_SCALE
    ) ** 2 / 2
    cost = np.where(on, cost, np.inf)[:, used]
    cost = np.concatenate([cost, np.full((len(cost), 1), OFF_COST)], 1)
    between = _between(graph, lanes, SKIP + float(moved.max(initial=0.0)))
    best, came = cost[0], []
    for move, own in zip(moved, cost[1:], strict=True):
        change = np.where(between <= SKIP + move, NEXT_COST, HOP_COST)
        np.fill_diagonal(change, 0.0)
        total = best[:, None] + change
        came.append(total.argmin(0))
        best = total.min(0) + own
    state = int(best.argmin())
    states = [state]
    for previous in reversed(came):
        state = int(previous[state])
        states.append(state)
    return np.append(lanes, NOWHERE)[states[::-1]]


def _between(
    graph: LaneGraph, lanes: Int[np.ndarray, " lanes"], limit: float
) -> Float[np.ndarray, "states states"]:
    """Metres of other lanes between the end of one and the start of another.

    The last state is on no lane and is connected to none.
    """
    result = np.full((len(lanes) + 1, len(lanes) + 1), np.inf)
    column = {int(lane): index for index, lane in enumerate(lanes)}
    for row, lane in enumerate(lanes):
        starts = [(exit_, 0.0) for exit_ in graph.exits[lane]]
        for reached, way in graph.reach(starts, limit).items():
            if reached in column:
                result[row, column[reached]] = way
    return result
