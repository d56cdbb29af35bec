"""Procedural family "curved": a winding road, one to three lanes each way.

The carriageway lies around a reference line of random bends (radii of 32 m and up).
Offsets are to the left of it: forward lanes on the right (negative), oncoming lanes
on the left; between them a double yellow line or a median island. A parking bay may
widen either side.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sim.procedural_geometry import STEP, Reference, integrate, smooth, smoothstep
from sim.procedural_map import (
    DrivingPath,
    Layout,
    MapBuilder,
    Source,
    driving_path,
)
from sim.scene import ObjectType, RoadKind

_BAY = 2.5  # m, width of a parking bay
_SLOT = 6.6  # m, length of a parking slot
GUTTER = 0.4  # m between the outermost lane and the road edge
_SECTION = 110.0  # m, length of a lane feature before the next one


@dataclass(frozen=True, kw_only=True)
class Profile:
    """A cross-section: everything in metres, one way if there is no oncoming lane."""

    forward: int
    oncoming: int
    lane: float
    median: float  # width of the island, 0: a double yellow line

    def centre(self, index: int, *, oncoming: bool) -> float:
        """Offset of a lane's centre line; 0 is the innermost lane."""
        away = self.median / 2 + (index + 0.5) * self.lane
        return away if oncoming else -away

    def side(self, *, oncoming: bool) -> float:
        """Offset of the outermost lane's outer border."""
        lanes = self.oncoming if oncoming else self.forward
        away = self.median / 2 + lanes * self.lane
        return away if oncoming else -away


def winding(
    rng: np.random.Generator, length: float, tightest: float, widest: float
) -> Reference:
    """A road of random bends and straights that never turns back on itself."""
    curvature = np.zeros(round(length / STEP) + 1)
    at, heading = rng.uniform(0, 60), 0.0
    while at < length:
        radius = np.exp(rng.uniform(np.log(tightest), np.log(widest)))
        sign = -np.sign(heading) if abs(heading) > 0.6 else rng.choice([-1.0, 1.0])
        angle = rng.uniform(0.35, 1.3)
        bend = min(radius * angle, 130.0)
        curvature[round(at / STEP) : round((at + bend) / STEP)] = sign / radius
        heading += sign * bend / radius
        at += bend + rng.choice([5.0, 25.0, 60.0]) * rng.uniform(0.5, 1.5)
    return integrate(smooth(curvature, 14.0))


def curved_road(rng: np.random.Generator, steps: int) -> Layout:
    """Draws a layout of this family."""
    tightest, widest = (32.0, 160.0) if rng.random() < 0.5 else (400.0, 8000.0)
    road = winding(rng, 430.0, tightest, widest)
    oncoming = int(rng.integers(0, 4)) if rng.random() < 0.8 else 0
    profile = Profile(
        forward=int(rng.integers(1, 4)),
        oncoming=oncoming,
        lane=rng.uniform(3.4, 3.8),
        median=rng.uniform(1.5, 3.5) if oncoming and rng.random() < 0.35 else 0.0,
    )
    limit = rng.uniform(9.0, 17.0)
    builder = MapBuilder()
    _mark(builder, road, profile)
    paths: list[DrivingPath] = []
    sources: list[Source] = []
    parking, sidewalks = [], []
    for is_oncoming in (False, True)[: 1 + (oncoming > 0)]:
        _lanes(builder, road, profile, limit, is_oncoming)
        _drive(rng, road, profile, limit, is_oncoming, paths, sources)
        edge, slots = kerb(rng, road, profile, is_oncoming, (60.0, 350.0))
        builder.trace(RoadKind.EDGE_BOUNDARY, edge)
        parking.append(slots)
        outward = 5.0 if is_oncoming else -5.0
        sidewalks.append(road.offset(profile.side(oncoming=is_oncoming) + outward))
    if not oncoming:
        builder.trace(RoadKind.EDGE_BOUNDARY, road.offset(GUTTER)[::-1])
    return Layout(
        family="curved",
        map=builder,
        paths=tuple(paths),
        sources=tuple(sources),
        signals=np.zeros((0, steps), np.int64),
        parking=np.concatenate(parking),
        sidewalks=tuple(sidewalks),
        vehicles=int(rng.integers(7, 16)),
        slow_share=rng.choice([0.1, 0.4]),
    )


def _mark(builder: MapBuilder, road: Reference, profile: Profile) -> None:
    """Paints the lines and builds the median island."""
    for count, oncoming in ((profile.forward, False), (profile.oncoming, True)):
        for index in range(1, count):
            left = profile.centre(index, oncoming=oncoming)
            left -= np.sign(left) * profile.lane / 2
            builder.trace(RoadKind.LINE_BROKEN_WHITE, road.offset(left))
    if profile.median:
        half = profile.median / 2
        builder.trace(RoadKind.LINE_SOLID_YELLOW, road.offset(-half))
        builder.trace(RoadKind.LINE_SOLID_YELLOW, road.offset(half)[::-1])
        builder.trace(RoadKind.EDGE_MEDIAN, island(road, 0.0, road.length, half - 0.3))
    elif profile.oncoming:
        builder.trace(RoadKind.LINE_SOLID_DOUBLE_YELLOW, road.offset(0.0))
    else:
        builder.trace(RoadKind.LINE_SOLID_YELLOW, road.offset(0.0))


def island(
    road: Reference, low: float, high: float, half: float
) -> Float[np.ndarray, "n 2"]:
    """A closed outline, clockwise: the road lies on its left all around.

    It starts in the middle of a long side, so that the closing vertex is a flat one.
    """
    right = road.span(-half, low, high)
    left = road.span(half, low, high)
    middle = len(left) // 2
    return np.concatenate([left[middle:], right[::-1], left[: middle + 1]])


def _lanes(
    builder: MapBuilder,
    road: Reference,
    profile: Profile,
    limit: float,
    oncoming: bool,
) -> None:
    """Adds each lane of one direction as joined sections."""
    cuts = np.linspace(0.0, road.length, max(2, round(road.length / _SECTION) + 1))
    for index in range(profile.oncoming if oncoming else profile.forward):
        centre = profile.centre(index, oncoming=oncoming)
        sections = [
            road.span(centre, low, high) for low, high in itertools.pairwise(cuts)
        ]
        if oncoming:
            sections = [section[::-1] for section in reversed(sections)]
        ids = [
            builder.trace(RoadKind.LANE_STREET, section, limit) for section in sections
        ]
        for first, second in itertools.pairwise(ids):
            builder.join(first, second)


def _drive(
    rng: np.random.Generator,
    road: Reference,
    profile: Profile,
    limit: float,
    oncoming: bool,
    paths: list[DrivingPath],
    sources: list[Source],
) -> None:
    """Paths along every lane, lane changes between neighbours, a cyclist's path."""
    count = profile.oncoming if oncoming else profile.forward
    walk = slice(None, None, -1) if oncoming else slice(None)
    for index in range(count):
        here = profile.centre(index, oncoming=oncoming)
        own = [len(paths)]
        paths.append(driving_path(road.offset(here)[walk], limit))
        other = index + int(rng.choice([-1, 1]))
        if 0 <= other < count:
            there = profile.centre(other, oncoming=oncoming)
            begin, length = rng.uniform(90, 200), rng.uniform(45, 75)
            along = road.stations()[walk]
            share = smoothstep((along - begin) / length)
            left = here + share * (there - here)
            own.append(len(paths))
            # The blend runs along the walk; `offset` wants the reference's order.
            paths.append(driving_path(road.offset(left[walk])[walk], limit))
        low, high = 5.0, road.length - 60.0
        sources.append(Source(paths=tuple(own), low=low, high=high))
    if rng.random() < 0.5:
        side = profile.side(oncoming=oncoming)
        left = side - np.sign(side) * 0.35
        sources.append(
            Source(
                paths=(len(paths),),
                low=60.0,
                high=road.length - 100.0,
                kind=ObjectType.CYCLIST,
            )
        )
        paths.append(driving_path(road.offset(left)[walk], limit))


def kerb(
    rng: np.random.Generator,
    road: Reference,
    profile: Profile,
    oncoming: bool,
    within: tuple[float, float],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "slots 3"]]:
    """The road edge of one direction, perhaps with a parking bay and its slots."""
    side = profile.side(oncoming=oncoming)
    outward = np.sign(side)
    along = road.stations()
    width = np.full(len(along), GUTTER)
    slots = np.zeros((0, 3))
    if rng.random() < 0.5:
        count = int(rng.integers(3, 9))
        low = rng.uniform(within[0], within[1] - count * _SLOT)
        high = low + count * _SLOT
        taper = 5.0
        rise = np.minimum((along - low + taper) / taper, (high + taper - along) / taper)
        width = width + np.clip(rise, 0.0, 1.0) * _BAY
        at = low + _SLOT * (np.arange(count) + 0.5)
        index = np.round(at / STEP).astype(np.int64)
        middle = road.offset(side + outward * (GUTTER + _BAY / 2))[index]
        yaw = road.yaw[index] + (np.pi if oncoming else 0.0)
        slots = np.concatenate([middle, yaw[:, None]], axis=-1)
    edge = road.offset(side + outward * width)
    return (edge[::-1] if oncoming else edge), slots
