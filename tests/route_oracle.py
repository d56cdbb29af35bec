"""Route metrics by brute force: every recorded point of every path, no tables."""

from collections.abc import Iterator, Sequence

import numpy as np

from sim.lane_paths import OFF, ON, Line, Piece, sample_pieces
from sim.lanes import lane_graph
from sim.routes import drive_of, paths_of
from sim.scene import ObjectType, Scene

Part = tuple[np.ndarray, float, int]  # points [n, 2], arc length of the first, flags


def raw_lanes(scene: Scene, origin: np.ndarray) -> list[np.ndarray]:
    """The lanes as recorded, less the origin, in the order of the graph's."""
    lines = [r.points[:, :2] - origin[:2] for r in scene.roads if r.kind.is_lane]
    return [line for line in lines if np.abs(np.diff(line, axis=0)).sum() > 1e-6]


def raw_paths(scene: Scene, origin: np.ndarray) -> list[list[Part]]:
    """Every object's paths as the recorded polylines that they are made of."""
    lanes = raw_lanes(scene, origin)
    graph = lane_graph(scene.roads, origin[:2])
    motor = graph.without_bikes()
    every = []
    for index in range(scene.objects):
        drive = drive_of(scene, index, origin[:2])
        cyclist = scene.object_types[index] == ObjectType.CYCLIST
        pieces: list[Piece] = []
        if index == scene.sdc_index and scene.sdc_paths and drive:
            ends = drive.xy[[drive.start, -1]]
            pieces = sample_pieces(scene.sdc_paths, origin[:2], ends)
        elif drive and lanes and scene.object_types[index] != ObjectType.PEDESTRIAN:
            pieces = paths_of(graph if cyclist else motor, drive)[0]
        every.append(
            [
                (line.points if isinstance(line, Line) else lanes[line], offset, flags)
                for line, offset, flags in pieces
            ]
        )
    return every


def part_segments(parts: Sequence[Part]) -> tuple[np.ndarray, ...]:
    """Start [n, 2], along [n, 2], arc length of the start [n], flags [n]."""
    starts, alongs, arcs, flags = [], [], [], []
    for points, offset, flag in parts:
        along = np.diff(points, axis=0)
        lengths = np.hypot(*along.T)
        starts.append(points[:-1])
        alongs.append(along)
        arcs.append(offset + np.cumsum(lengths) - lengths)
        flags.append(np.full(len(along), flag))
    return tuple(np.concatenate(column) for column in (starts, alongs, arcs, flags))


def distances(
    parts: Sequence[Part], xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points [m, 2]: distance and arc length [m, n] on every segment; flags [n]."""
    start, along, arc, flags = part_segments(parts)
    offset = xy[:, None] - start
    length = np.maximum(np.hypot(*along.T), 1e-9)
    t = np.clip((offset * along).sum(-1) / length**2, 0, 1)
    distance = np.hypot(*np.moveaxis(offset - t[..., None] * along, -1, 0))
    return distance, arc + t * length, flags


def walks(
    exits: Sequence[Sequence[int]],
    lengths: Sequence[float],
    path: tuple[int, ...],
    way: float,
    limit: float,
) -> Iterator[tuple[tuple[int, ...], list[float]]]:
    """All paths on from `path`'s last lane (it starts at `way`) that repeat no lane."""
    behind = way + lengths[path[-1]]
    onward = [lane for lane in exits[path[-1]] if lane not in path and behind <= limit]
    if not onward:
        yield path, [way]
    for lane in onward:
        for walk, ways in walks(exits, lengths, (*path, lane), behind, limit):
            yield walk, [way, *ways]


def flags_by_definition(
    exits: Sequence[Sequence[int]],
    lengths: Sequence[float],
    runs: Sequence[Sequence[int]],
    starts: Sequence[float],
    limit: float,
) -> dict[int, int]:
    """Lane to flags: on-route paths are those that contain the last run's lanes."""
    flags = {lane: ON for run in runs for lane in run}
    for number, (run, start) in enumerate(zip(runs, starts, strict=True)):
        for walk, _ in walks(exits, lengths, (run[0],), start, limit):
            contains = walk[: len(run)] == tuple(run)
            on = contains and number == len(runs) - 1
            for lane in walk:
                flags[lane] = flags.get(lane, 0) | (ON if on else OFF)
    return flags
