"""What a procedural family hands to the traffic: a map, driving paths, places to start.

A `Layout` lives in its own plane frame; `place` turns it, moves it and puts it on a
gently sloping plane z = z0 + g . (x, y).
"""

import enum
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float, Int

from sim.procedural_geometry import STEP, decimate, headings, resample
from sim.scene import ObjectType, Polyline, RoadKind

LATERAL_ACCELERATION = 1.7  # m/s^2 that the speed profile allows in a bend
COMFORTABLE_BRAKING = 1.4  # m/s^2 with which the profile falls towards a bend


class Signal(enum.IntEnum):
    """What a path's light asks for."""

    GO = 0
    CAUTION = 1
    STOP = 2


@dataclass(frozen=True, kw_only=True)
class DrivingPath:
    """Where one kind of road user goes, every `STEP` metres (nearly)."""

    points: Float[np.ndarray, "n 2"]  # m
    yaw: Float[np.ndarray, " n"]  # rad, unwrapped tangent
    curvature: Float[np.ndarray, " n"]  # 1/m
    speed: Float[np.ndarray, " n"]  # m/s, the highest that is comfortable here
    step: float  # m between samples
    stop: float = np.inf  # m, station of the stop line
    signal: int = -1  # row of `Layout.signals`, -1: none
    must_stop: bool = False  # a stop sign stands at the stop line
    rank: int = 0  # the smaller goes first where paths cross

    @property
    def length(self) -> float:
        """Arc length in metres."""
        return self.step * (len(self.yaw) - 1)


def speed_profile(
    curvature: Float[np.ndarray, " n"], step: float, limit: float
) -> Float[np.ndarray, " n"]:
    """Highest speed for the bends, approached with comfortable braking."""
    bend = np.sqrt(LATERAL_ACCELERATION / np.maximum(np.abs(curvature), 1e-6))
    square = np.minimum(bend, limit) ** 2
    # v(s)^2 <= v(s')^2 + 2 b (s' - s) for every s' >= s: a running minimum.
    ramp = 2 * COMFORTABLE_BRAKING * step * np.arange(len(square))
    reach = np.minimum.accumulate((square + ramp)[::-1])[::-1] - ramp
    return np.sqrt(reach)


def driving_path(
    points: Float[np.ndarray, "n 2"],
    limit: float,
    stop: float = np.inf,
    signal: int = -1,
    must_stop: bool = False,
    rank: int = 0,
) -> DrivingPath:
    """A path along these points with the speed limit `limit` in m/s."""
    even = resample(points)
    step = float(np.hypot(*(even[1:] - even[:-1]).T).mean())
    yaw = headings(even)
    curvature = np.gradient(yaw, step)
    return DrivingPath(
        points=even,
        yaw=yaw,
        curvature=curvature,
        speed=speed_profile(curvature, step, limit),
        step=step,
        stop=stop,
        signal=signal,
        must_stop=must_stop,
        rank=rank,
    )


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where road users of one kind may start: these paths share these stations."""

    paths: tuple[int, ...]
    low: float  # m, first station
    high: float  # m, last station
    kind: ObjectType = ObjectType.VEHICLE
    share: float = 1.0  # of vehicles, relative to other sources
    queue: bool = False  # a standing queue may end at `high`


@dataclass(frozen=True, kw_only=True)
class Layout:
    """A map with its paths, in its own frame."""

    family: str
    map: "MapBuilder"
    paths: tuple[DrivingPath, ...]
    sources: tuple[Source, ...]
    signals: Int[np.ndarray, "signals steps"]  # `Signal`, warm-up steps included
    signal_lanes: tuple[int, ...] = ()  # lane id of each light
    signal_arrows: tuple[bool, ...] = ()
    signal_points: Float[np.ndarray, "signals 2"] = field(
        default_factory=lambda: np.zeros((0, 2))
    )
    parking: Float[np.ndarray, "slots 3"] = field(
        default_factory=lambda: np.zeros((0, 3))
    )  # x, y, yaw
    sidewalks: tuple[Float[np.ndarray, "_ 2"], ...] = ()
    zipper: bool = True  # paths that join do so in turn; else the rank decides
    vehicles: int = 12  # moving ones to aim at
    slow_share: float = 0.2  # of vehicles that slow down for a while


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Where a layout lies in the world."""

    yaw: float
    x: float
    y: float
    z: float
    slope: tuple[float, float]  # rise per metre along x and y

    def points(self, plane: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Plane points in the world, on the ground."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        x = self.x + cos * plane[..., 0] - sin * plane[..., 1]
        y = self.y + sin * plane[..., 0] + cos * plane[..., 1]
        dx, dy = x - self.x, y - self.y
        return np.stack(
            [x, y, self.z + self.slope[0] * dx + self.slope[1] * dy], axis=-1
        )


@final
class MapBuilder:
    """Collects features and gives them ids; lanes can be joined afterwards."""

    def __init__(self) -> None:
        """Starts empty."""
        self._kinds: list[RoadKind] = []
        self._points: list[Float[np.ndarray, "_ 2"]] = []
        self._limits: list[float] = []
        self._entries: dict[int, list[int]] = {}
        self._exits: dict[int, list[int]] = {}

    def add(
        self, kind: RoadKind, points: Float[np.ndarray, "_ 2"], limit: float = 0.0
    ) -> int:
        """Adds a feature as it is and returns its id."""
        self._kinds.append(kind)
        self._points.append(points)
        self._limits.append(limit)
        return len(self._kinds) - 1

    def trace(
        self, kind: RoadKind, points: Float[np.ndarray, "_ 2"], limit: float = 0.0
    ) -> int:
        """Adds a densely sampled curve, decimated."""
        return self.add(kind, decimate(points), limit)

    def join(self, first: int, second: int) -> None:
        """Lane `second` follows lane `first`."""
        self._exits.setdefault(first, []).append(second)
        self._entries.setdefault(second, []).append(first)

    def edges(
        self,
    ) -> tuple[Float[np.ndarray, "segments 2"], Float[np.ndarray, "segments 2"]]:
        """Starts and ends of all road-edge segments."""
        lines = [
            points
            for kind, points in zip(self._kinds, self._points, strict=True)
            if kind.is_edge
        ]
        return (
            np.concatenate([line[:-1] for line in lines]),
            np.concatenate([line[1:] for line in lines]),
        )

    def polylines(self, frame: Frame) -> tuple[Polyline, ...]:
        """The features in the world."""
        return tuple(
            Polyline(
                kind,
                frame.points(points),
                feature_id=index,
                entry_lanes=tuple(self._entries.get(index, ())),
                exit_lanes=tuple(self._exits.get(index, ())),
                speed_limit=limit,
            )
            for index, (kind, points, limit) in enumerate(
                zip(self._kinds, self._points, self._limits, strict=True)
            )
        )


def chain(parts: Sequence[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "m 2"]:
    """Curves joined end to start, without the doubled points."""
    joined = np.concatenate(parts)
    keep = np.hypot(*np.diff(joined, axis=0).T) > 0.05 * STEP
    return joined[np.concatenate([[True], keep])]
