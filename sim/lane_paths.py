"""The lane paths that an object could take, and which of them the log took.

Of an object's log from the step at which it acts (the first recorded one at or after
`current_step`) `sim.lanes.match` gives the lanes. Where the drive goes on along the
graph they are one *run*; a lane change, or a stretch off all lanes, begins another.

- On-route is what contains the log's lanes: the runs' lanes, and everything that the
  graph reaches from the last of them. A stretch off the lanes (a car park, a driveway)
  is on-route as it was driven, since no lane path could contain it.
- Off-route is everything else that the graph reaches from a run's first lane.
- Where the log starts it may be as well on other lanes (not farther by more than `TIE`:
  behind a fork, between two lanes). What these reach is off-route; if they are as near
  all along, as where the log stands, it is on-route.
- Arc length is 0 where the log starts, negative behind it. It goes on from run to run
  by the distance driven between them, so that it grows along the log; beyond a fork
  that joins again it is that of the shorter way.

Paths end `AHEAD` behind the log's end or `RANGE` behind its start, whichever is
farther, and before a lane that they hold already, so that rings end; of more than
`MAX_CHUNKS` chunks the farthest are left out, off-route ones first. A lane that the
log took twice is there twice, and the nearest point on it has two arc lengths: the
smaller one is taken. Vehicles do not use bike lanes, pedestrians use none; an object
that is never on a lane has no paths.

Where the matched lanes would leave the log itself off-route (two lanes overlap, and the
log is nearer to the one that it does not follow) these poses are matched again without
that lane, so that a log is never off-route.

The SDC's paths are the scene's `sdc_paths` where there are some, cut in the same way;
arc length is then along the first of the on-route samples that a stretch is part of.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sim.lanes import (
    NOWHERE,
    SKIP,
    TOLERANCE,
    LaneGraph,
    Near,
    arc_lengths,
    match,
    nearest,
    on_lane,
    segments_of,
    without_repeats,
)
from sim.scene import LanePath
from sim.tables import keep_points

ON, OFF = 1, 2  # flags of a stretch; one that both kinds of path share has both
AHEAD = 50.0  # m
RANGE = 150.0  # m
CHUNK = 8  # segments a chunk
MAX_CHUNKS = 96  # of an object
STRIDE = 0.25  # m between the poses that are matched
TIE = 1.0  # m
LOOK = 8.0  # m around the log in which lanes are compared with it
MAX_ON = 5.0  # m: a log is off-route where it is farther from its paths
MAX_BEHIND = 2.0  # m: or by this nearer to another path
ROUNDS = 6  # of leaving out single lanes at a pose, before all


class Line(NamedTuple):
    """A polyline that paths are made of."""

    points: Float[np.ndarray, "points 2"]  # m
    arc: Float[np.ndarray, " points"]  # m


class Piece(NamedTuple):
    """A line as part of an object's paths."""

    line: int | Line  # a lane's number, or a line of its own
    offset: float  # m, arc length of its start along the on-route path
    flags: int


class _Run(NamedTuple):
    """A stretch of the log along the graph, or off all lanes (no lanes)."""

    lanes: tuple[int, ...]
    first: int  # pose
    last: int


def object_pieces(
    graph: LaneGraph,
    xy: Float[np.ndarray, "poses 2"],
    yaw: Float[np.ndarray, " poses"],
) -> tuple[list[Piece], Int[np.ndarray, " poses"]]:
    """An object's paths, and the lane of each pose (`NOWHERE`: none)."""
    near = nearest(graph.segments, xy, yaw, LOOK)
    moved = np.hypot(*np.diff(xy, axis=0).T)
    barred = np.zeros(near.distance.shape, bool)
    for round_ in range(ROUNDS + len(xy)):
        lanes = match(graph, near, moved, barred)
        runs = _runs(graph, lanes, moved)
        if not any(run.lanes for run in runs):
            return [], lanes
        chains, driven, end = _chains(graph, near, xy, runs)
        limit = max(end + AHEAD, RANGE)
        pieces = driven + pieces_of(graph, chains, limit)
        pieces = _merged(pieces, _beside(graph, near, lanes, limit))
        wrong = np.flatnonzero(_off_route(near, pieces, xy))
        if not len(wrong):
            break
        if round_ < ROUNDS:
            barred[wrong] |= near.lines == lanes[wrong, None]
        else:
            barred[wrong] = True
    return pieces, lanes


def poses(
    xy: Float[np.ndarray, "steps 2"],
) -> Int[np.ndarray, " poses"]:
    """The steps at which a log has moved by more than `STRIDE` since the one before."""
    kept = [0]
    for step in range(1, len(xy)):
        if np.hypot(*(xy[step] - xy[kept[-1]])) > STRIDE:
            kept.append(step)
    return np.array(kept)


def _runs(
    graph: LaneGraph,
    lanes: Int[np.ndarray, " poses"],
    moved: Float[np.ndarray, " moves"],
) -> list[_Run]:
    runs: list[_Run] = []
    for pose, lane in enumerate(lanes.tolist()):
        run = runs[-1] if runs else None
        if run and lane == (run.lanes[-1] if run.lanes else NOWHERE):
            runs[-1] = run._replace(last=pose)
            continue
        between = None
        if run and run.lanes and lane != NOWHERE:
            limit = SKIP + float(moved[pose - 1])
            between = graph.shortest(run.lanes[-1], lane, limit)
        if run and between is not None:
            runs[-1] = _Run((*run.lanes, *between, lane), run.first, pose)
        else:
            runs.append(_Run(() if lane == NOWHERE else (lane,), pose, pose))
    return runs


class Chain(NamedTuple):
    """A run's lanes with the arc lengths of their starts."""

    lanes: tuple[int, ...]
    offsets: tuple[float, ...]  # m


def _chains(
    graph: LaneGraph, near: Near, xy: Float[np.ndarray, "poses 2"], runs: list[_Run]
) -> tuple[list[Chain], list[Piece], float]:
    """The runs on lanes, those off them, and the arc length at the log's end."""
    column = {int(lane): index for index, lane in enumerate(near.lines)}
    station = near.arc + near.beyond
    chains: list[Chain] = []
    driven: list[Piece] = []
    reached = 0.0
    for run in runs:
        before = max(run.first - 1, 0)
        left, reached = reached, reached + _length(xy[before : run.first + 1])
        if run.lanes:
            start = reached - float(station[run.first, column[run.lanes[0]]])
            lengths = [float(graph.arcs[lane][-1]) for lane in run.lanes]
            offsets = tuple((start + np.cumsum([0.0, *lengths[:-1]])).tolist())
            reached = offsets[-1] + float(station[run.last, column[run.lanes[-1]]])
            chains.append(Chain(run.lanes, offsets))
            continue
        reached += _length(xy[run.first : run.last + 1])
        points = xy[before : run.last + 2]
        if len(points) > 1:
            driven.append(Piece(Line(points, arc_lengths(points)), left, ON))
    return chains, driven, reached


def _length(points: Float[np.ndarray, "points 2"]) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def pieces_of(graph: LaneGraph, chains: list[Chain], limit: float) -> list[Piece]:
    """The paths through these runs, over lanes that begin within `limit`."""
    on: list[Piece] = []
    off: dict[int, float] = {}
    for number, (lanes, offsets) in enumerate(chains):
        final = number == len(chains) - 1
        # From the end: a lane with a fork behind it is on off-route paths, too.
        shared = OFF * (not final)
        for index in reversed(range(len(lanes))):
            lane, last = lanes[index], index == len(lanes) - 1
            behind = offsets[index] + float(graph.arcs[lane][-1])
            reached = graph.reach(
                [
                    (following, behind)
                    for following in graph.exits[lane]
                    if last or following != lanes[index + 1]
                ],
                limit,
                passed=lanes[: index + 1],
            )
            if final and last:
                on += [Piece(onward, way, ON) for onward, way in reached.items()]
            else:
                shared |= OFF * bool(reached)
                for other, way in reached.items():
                    off[other] = min(way, off.get(other, np.inf))
            on.append(Piece(lane, offsets[index], ON | shared))
    on_lanes = {piece.line for piece in on}
    pieces = [
        piece._replace(flags=piece.flags | OFF * (piece.line in off)) for piece in on
    ]
    pieces += [
        Piece(lane, way, OFF) for lane, way in off.items() if lane not in on_lanes
    ]
    return pieces


def _beside(
    graph: LaneGraph, near: Near, lanes: Int[np.ndarray, " poses"], limit: float
) -> dict[int, Piece]:
    """The paths from the lanes that the first pose is as well on as on its own."""
    pieces: dict[int, Piece] = {}
    if lanes[0] == NOWHERE:
        return pieces
    own = np.where(near.lines == lanes[:, None], near.distance, np.inf).min(1)
    tied = on_lane(graph, near) & (near.distance <= own[:, None] + TIE)
    for column in np.flatnonzero(tied[0] & (near.lines != lanes[0])):
        lane, way = int(near.lines[column]), -float(near.arc[0, column])
        flag = ON if tied[:, column].all() else OFF
        for other, start in graph.reach([(lane, way)], limit).items():
            known = pieces.get(other, Piece(other, start, flag))
            pieces[other] = known._replace(flags=known.flags | flag)
    return pieces


def _merged(pieces: list[Piece], more: dict[int, Piece]) -> list[Piece]:
    """Both, a lane of both once: as in the first, with the flags of both."""
    merged = []
    for piece in pieces:
        lane = piece.line if isinstance(piece.line, int) else NOWHERE
        flags = more[lane].flags if lane in more else 0
        merged.append(piece._replace(flags=piece.flags | flags))
    known = {piece.line for piece in pieces if isinstance(piece.line, int)}
    return merged + [piece for lane, piece in more.items() if lane not in known]


def _off_route(
    near: Near, pieces: list[Piece], xy: Float[np.ndarray, "poses 2"]
) -> Bool[np.ndarray, " poses"]:
    """Where the log is off its own route; between two poses it may move by `STRIDE`."""
    distance = {ON: np.full(len(xy), np.inf), OFF: np.full(len(xy), np.inf)}
    column = {int(lane): index for index, lane in enumerate(near.lines)}
    for piece in pieces:
        if isinstance(piece.line, Line):
            lines = segments_of([piece.line.points], [piece.line.arc])
            own = nearest(lines, xy, np.zeros(len(xy)), np.inf).distance[:, 0]
        elif piece.line in column:
            own = near.distance[:, column[piece.line]]
        else:
            continue
        for flag, best in distance.items():
            if piece.flags & flag:
                np.minimum(best, own, out=best)
    on, off = distance[ON], distance[OFF]
    return (on > MAX_ON - STRIDE) | (on - off > MAX_BEHIND - 2 * STRIDE)


def sample_pieces(
    paths: Sequence[LanePath],
    origin: Float[np.ndarray, "2"],
    ends: Float[np.ndarray, "2 2"],
) -> list[Piece]:
    """The paths that samples describe; stretches that several share are there once.

    `ends` are where the log begins and ends [m]: a sample is cut as a lane path is.
    """
    points = [
        _cut(without_repeats(path.points[:, :2] - origin), ends) for path in paths
    ]
    flags: dict[bytes, int] = {}
    for path, line in zip(paths, points, strict=True):
        for key in _keys(line):
            flags[key] = flags.get(key, 0) | (ON if path.on_route else OFF)
    pieces: list[Piece] = []
    taken: set[bytes] = set()
    order = sorted(range(len(paths)), key=lambda index: not paths[index].on_route)
    for index in order:
        line, keys = points[index], _keys(points[index])
        arc = arc_lengths(line)
        # A piece ends where the flags change or what is known already begins.
        marks = [0 if key in taken else flags[key] for key in keys]
        taken.update(keys)
        cuts = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), len(marks)]
        for start, end in itertools.pairwise(cuts):
            if end > start and marks[start]:
                stretch = line[start : end + 1]
                part = Line(stretch, arc_lengths(stretch))
                pieces.append(Piece(part, float(arc[start]), marks[start]))
    return pieces


def _cut(
    line: Float[np.ndarray, "points 2"], ends: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "kept 2"]:
    """The path up to `AHEAD` behind the log's end or `RANGE` behind its start."""
    if len(line) < 2:
        return line
    arc = arc_lengths(line)
    at = nearest(segments_of([line], [arc]), ends, np.zeros(2), np.inf).arc[:, 0]
    return line[arc <= max(at[1] + AHEAD, at[0] + RANGE)]


def _keys(line: Float[np.ndarray, "points 2"]) -> list[bytes]:
    """A name for every segment: its ends, to a millimetre."""
    ends = np.round(line * 1000).astype(np.int64)
    return [row.tobytes() for row in np.concatenate([ends[:-1], ends[1:]], 1)]


class Chunks(NamedTuple):
    """Lines cut into equal rows, for a table."""

    points: Float[np.ndarray, "chunks 9 2"]  # m; the last point fills up
    arc: Float[np.ndarray, " chunks"]  # m, of the first point on its line


def chunks_of(line: Line) -> Chunks:
    """A line, decimated and cut."""
    kept = keep_points(line.points, TOLERANCE)
    points, arc = line.points[kept], line.arc[kept]
    first = np.arange(0, len(points) - 1, CHUNK)
    rows = np.minimum(first[:, None] + np.arange(CHUNK + 1), len(points) - 1)
    return Chunks(points[rows], arc[first])
