"""Who takes part in a procedural scene: sizes, temperaments, starting places."""

from typing import final

import numpy as np
from jaxtyping import Float

from sim.procedural_map import DrivingPath, Layout, Signal, Source
from sim.procedural_traffic import Fleet
from sim.scene import ObjectType

_TRIES = 60  # places that are tried before the road counts as full


def draw_size(
    rng: np.random.Generator, kind: ObjectType, truck_share: float = 0.08
) -> tuple[float, float, float]:
    """Length, width and height in metres."""
    if kind == ObjectType.PEDESTRIAN:
        return rng.uniform(0.5, 0.8), rng.uniform(0.5, 0.8), rng.uniform(1.55, 1.9)
    if kind == ObjectType.CYCLIST:
        return rng.uniform(1.6, 1.9), rng.uniform(0.6, 0.8), rng.uniform(1.6, 1.9)
    if rng.random() < truck_share:
        return rng.uniform(6.5, 8.5), rng.uniform(2.25, 2.45), rng.uniform(2.8, 3.6)
    return rng.uniform(4.2, 5.2), rng.uniform(1.8, 2.1), rng.uniform(1.45, 1.9)


@final
class _Crowd:
    """Road users that were placed so far."""

    def __init__(self) -> None:
        """Starts empty."""
        self.rows: list[dict[str, float]] = []
        self.poses: list[tuple[float, float, float, float, float]] = []

    def fits(
        self, path: DrivingPath, station: float, length: float, headroom: float
    ) -> bool:
        """Whether nobody is within `headroom` along, or beside, that place."""
        if not self.poses:
            return True
        x, y, yaw = _pose(path, station)
        other = np.array(self.poses)
        dx, dy = other[:, 0] - x, other[:, 1] - y
        along = np.abs(np.cos(yaw) * dx + np.sin(yaw) * dy)
        aside = np.abs(np.cos(yaw) * dy - np.sin(yaw) * dx)
        room = (length + other[:, 3]) / 2 + np.maximum(headroom, other[:, 4])
        near = (along < room) & (aside < 2.6)
        return not bool(near.any())

    def add(
        self, path: DrivingPath, row: dict[str, float], length: float, headroom: float
    ) -> None:
        """Places one."""
        x, y, yaw = _pose(path, row["station"])
        self.rows.append(row)
        self.poses.append((x, y, yaw, length, headroom))


def _pose(path: DrivingPath, station: float) -> tuple[float, float, float]:
    index = min(int(station / path.step), len(path.yaw) - 1)
    return (
        float(path.points[index, 0]),
        float(path.points[index, 1]),
        float(path.yaw[index]),
    )


def populate(rng: np.random.Generator, layout: Layout) -> Fleet:
    """Draws the road users of a layout and where they start."""
    crowd = _Crowd()
    _queue_up(rng, layout, crowd)
    for source in layout.sources:
        if source.kind != ObjectType.VEHICLE:
            _start(rng, layout, source, crowd)
    sources = [s for s in layout.sources if s.kind == ObjectType.VEHICLE]
    share = np.array([source.share for source in sources])
    chosen = rng.choice(len(sources), size=_TRIES, p=share / share.sum())
    wanted = layout.vehicles + len(crowd.rows)
    for index in chosen:
        if len(crowd.rows) >= wanted:
            break
        _start(rng, layout, sources[index], crowd)
    return _fleet(rng, layout, crowd)


def _queue_up(rng: np.random.Generator, layout: Layout, crowd: _Crowd) -> None:
    """Standing vehicles in front of lines that are closed at the start."""
    for source in layout.sources:
        closed = _closed(layout, layout.paths[source.paths[0]])
        if not (source.queue and closed and rng.random() < 0.45):
            continue
        path = layout.paths[source.paths[0]]
        at = path.stop - rng.uniform(0.6, 1.5)
        for _ in range(int(rng.integers(1, 5))):
            size = draw_size(rng, source.kind)
            row = _row(rng, source, at - size[0] / 2, 0.0, size)
            if not crowd.fits(path, row["station"], size[0], 1.0):
                break
            crowd.add(path, row, size[0], 1.0)
            at -= size[0] + rng.uniform(1.8, 3.5)


def _closed(layout: Layout, path: DrivingPath) -> bool:
    """Whether the path's line holds traffic back at the start."""
    if path.signal >= 0:
        return bool(layout.signals[path.signal, 0] == Signal.STOP)
    return path.must_stop


def _start(
    rng: np.random.Generator, layout: Layout, source: Source, crowd: _Crowd
) -> None:
    """Places one road user of a source, if there is room."""
    station = rng.uniform(source.low, source.high)
    size = draw_size(rng, source.kind)
    row = _row(rng, source, station, 0.0, size)
    path = layout.paths[int(row["path"])]
    index = min(int(station / path.step), len(path.yaw) - 1)
    speed = min(path.speed[index] * row["desired"], row["cap"])
    speed *= rng.uniform(0.75, 1.0)
    if source.kind == ObjectType.PEDESTRIAN:
        speed = row["cap"]
    elif path.must_stop or path.signal >= 0:
        ahead = path.stop - station - size[0] / 2
        if ahead > 0 and _closed(layout, path):
            speed = min(speed, float(np.sqrt(2 * 1.5 * max(ahead - 8.0, 0.0))))
    headroom = 3.0 + 0.9 * speed
    if crowd.fits(path, station, size[0], headroom):
        crowd.add(path, row | {"speed": speed}, size[0], headroom)


def _row(
    rng: np.random.Generator,
    source: Source,
    station: float,
    speed: float,
    size: tuple[float, float, float],
) -> dict[str, float]:
    """Draws one road user's properties (see `Fleet`)."""
    cap = {
        ObjectType.CYCLIST: rng.uniform(3.5, 6.5),
        ObjectType.PEDESTRIAN: rng.uniform(1.1, 1.7),
    }.get(source.kind, np.inf)
    car = source.kind == ObjectType.VEHICLE
    return {
        "kind": float(source.kind),
        "path": float(rng.choice(source.paths)),
        "station": station,
        "speed": speed,
        "length": size[0],
        "width": size[1],
        "height": size[2],
        "lateral": float(np.clip(rng.normal(0, 0.12), -0.2, 0.2)) if car else 0.0,
        "desired": rng.uniform(0.8, 1.08),
        "cap": cap,
    }


def _column(crowd: _Crowd, name: str) -> Float[np.ndarray, " n"]:
    return np.array([row[name] for row in crowd.rows])


def _fleet(rng: np.random.Generator, layout: Layout, crowd: _Crowd) -> Fleet:
    """Adds temperaments and whiles of slowness."""
    count = len(crowd.rows)
    car = _column(crowd, "kind") == ObjectType.VEHICLE
    slows = (rng.random(count) < layout.slow_share) & car
    begin = np.where(slows, rng.uniform(0.5, 7.0, count), np.inf)
    return Fleet(
        kind=_column(crowd, "kind").astype(np.int64),
        path=_column(crowd, "path").astype(np.int64),
        station=_column(crowd, "station"),
        speed=_column(crowd, "speed"),
        size=np.stack([_column(crowd, k) for k in ("length", "width", "height")], -1),
        lateral=_column(crowd, "lateral"),
        desired=_column(crowd, "desired"),
        cap=_column(crowd, "cap"),
        gap=rng.uniform(1.8, 3.0, count),
        headway=rng.uniform(0.9, 1.6, count),
        slow_from=begin,
        slow_until=begin + rng.uniform(3.0, 8.0, count),
        slow_factor=rng.uniform(0.15, 0.6, count),
    )
