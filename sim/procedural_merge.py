"""Procedural family "merge": an on-ramp joins a highway of two or three lanes.

Everything is an offset to the left of the highway's reference line (the median side
of its innermost lane), so the lanes lie at negative offsets. The ramp comes from the
right: f(u) metres beyond its acceleration lane, a parabola that ends in a straight,

    f(x) = x^2 / 2R  for x < x_1,   then with the slope x_1 / R,   x = u_join - u.

Between the kerbs of ramp and highway the edge runs to a blunt nose.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sim.procedural_geometry import STEP, Reference, smoothstep
from sim.procedural_map import (
    DrivingPath,
    Layout,
    MapBuilder,
    Source,
    driving_path,
)
from sim.procedural_roads import winding
from sim.scene import RoadKind

_LENGTH = 660.0  # m
_TAPER = 60.0  # m, from the end of the acceleration lane to the plain road


@dataclass(frozen=True, kw_only=True)
class _Highway:
    """The drawn dimensions, in metres."""

    road: Reference
    lanes: int
    lane: float
    shoulder: float
    join: float  # station where the ramp is parallel to the highway
    end: float  # station where the acceleration lane ends
    radius: float  # of the ramp's bend
    slope: float  # of the ramp before its bend

    def centre(self, index: int) -> float:
        """Offset of a lane's centre; `lanes` is the acceleration lane."""
        return -(index + 0.5) * self.lane

    def ramp(self) -> Float[np.ndarray, " n"]:
        """Offset of the ramp's centre line at every station."""
        x = np.maximum(self.join - self.road.stations(), 0.0)
        bent = np.minimum(x, self.slope * self.radius)
        away = bent**2 / (2 * self.radius) + self.slope * (x - bent)
        return self.centre(self.lanes) - away

    def nose(self) -> float:
        """Station where the kerbs of ramp and highway come within half a metre."""
        inner = self.ramp() + self.lane / 2 + 1.0
        apart = inner < -self.lanes * self.lane - self.shoulder - 0.5
        return STEP * float(apart.sum() - 1)

    def right_edge(self) -> Float[np.ndarray, " n"]:
        """Offset of the outer edge: ramp, acceleration lane, taper, highway."""
        along = (self.road.stations() - self.end) / _TAPER
        return (
            self.ramp() - self.lane / 2 - self.shoulder + self.lane * smoothstep(along)
        )


def merge(rng: np.random.Generator, steps: int) -> Layout:
    """Draws a layout of this family."""
    tightest, widest = (220.0, 600.0) if rng.random() < 0.35 else (1500.0, 20000.0)
    join = rng.uniform(170.0, 240.0)
    highway = _Highway(
        road=winding(rng, _LENGTH, tightest, widest),
        lanes=int(rng.integers(2, 4)),
        lane=rng.uniform(3.5, 3.8),
        shoulder=rng.uniform(0.8, 2.5),
        join=join,
        end=join + rng.uniform(110.0, 170.0),
        radius=rng.uniform(90.0, 200.0),
        slope=rng.uniform(0.2, 0.45),
    )
    builder = MapBuilder()
    limit = rng.uniform(18.0, 28.0)
    _edges(builder, highway)
    _lines(builder, highway)
    _lanes(builder, highway, limit)
    paths: list[DrivingPath] = []
    sources: list[Source] = []
    for index in range(highway.lanes):
        _drive(rng, highway, index, limit, paths, sources)
    _enter(rng, highway, limit, paths, sources)
    if rng.random() < 0.6:
        _opposite(rng, builder, highway, limit, paths, sources)
    return Layout(
        family="merge",
        map=builder,
        paths=tuple(paths),
        sources=tuple(sources),
        signals=np.zeros((0, steps), np.int64),
        vehicles=int(rng.integers(11, 20)),
        slow_share=rng.choice([0.05, 0.3]),
    )


def _edges(builder: MapBuilder, highway: _Highway) -> None:
    """The three chains of road edge."""
    road, nose = highway.road, highway.nose()
    kerb = road.span(-highway.lanes * highway.lane - highway.shoulder, 0.0, nose)
    inner = highway.ramp() + highway.lane / 2 + 1.0
    back = road.span(inner, 0.0, nose)[::-1]
    for part in (
        np.concatenate([kerb, back]),
        road.offset(highway.right_edge()),
        road.offset(1.0)[::-1],
    ):
        builder.trace(RoadKind.EDGE_BOUNDARY, part)


def _lines(builder: MapBuilder, highway: _Highway) -> None:
    """Lane dividers and border lines."""
    road, lane = highway.road, highway.lane
    for index in range(1, highway.lanes):
        builder.trace(RoadKind.LINE_BROKEN_WHITE, road.offset(-index * lane))
    builder.trace(RoadKind.LINE_SOLID_YELLOW, road.offset(0.0))
    border = -highway.lanes * lane
    nose = highway.nose()
    for low, high, kind in (
        (0.0, nose, RoadKind.LINE_SOLID_WHITE),
        (nose, highway.end, RoadKind.LINE_BROKEN_WHITE),
        (highway.end + _TAPER, np.inf, RoadKind.LINE_SOLID_WHITE),
    ):
        builder.trace(kind, road.span(border, low, high))
    outer = highway.right_edge() + highway.shoulder
    builder.trace(RoadKind.LINE_SOLID_WHITE, road.span(outer, 0.0, highway.end))


def _lanes(builder: MapBuilder, highway: _Highway, limit: float) -> None:
    """Lane features, the ramp's and the one that joins it to the highway."""
    road, kind = highway.road, RoadKind.LANE_FREEWAY
    meet = STEP * round((highway.end + _TAPER) / STEP)
    end = STEP * round(highway.end / STEP)
    cuts = [0.0, STEP * round(highway.join / STEP), meet, road.length]
    last = -1
    for index in range(highway.lanes):
        ids = [
            builder.trace(kind, road.span(highway.centre(index), *cut), limit)
            for cut in itertools.pairwise(cuts)
        ]
        for first, second in itertools.pairwise(ids):
            builder.join(first, second)
        last = ids[-1]
    ramp = builder.trace(kind, road.span(highway.ramp(), 0.0, cuts[1]), limit)
    beside = builder.trace(kind, road.span(highway.ramp(), cuts[1], end), limit)
    joins = builder.trace(
        kind, road.span(_merging(highway, end, meet), end, meet), limit
    )
    builder.join(ramp, beside)
    builder.join(beside, joins)
    builder.join(joins, last)


def _merging(highway: _Highway, low: float, high: float) -> Float[np.ndarray, " n"]:
    """Offset of a path along the ramp that changes lane between two stations."""
    share = smoothstep((highway.road.stations() - low) / (high - low))
    onto = highway.centre(highway.lanes - 1)
    return (1 - share) * highway.ramp() + share * onto


def _drive(
    rng: np.random.Generator,
    highway: _Highway,
    index: int,
    limit: float,
    paths: list[DrivingPath],
    sources: list[Source],
) -> None:
    """A lane's path and, perhaps, a change to a neighbour."""
    road, here = highway.road, highway.centre(index)
    # Traffic is faster on the left.
    own_limit = limit * (1.06 - 0.06 * index)
    own = [len(paths)]
    paths.append(driving_path(road.offset(here), own_limit))
    other = index + int(rng.choice([-1, 1]))
    if 0 <= other < highway.lanes:
        begin, length = rng.uniform(120, 330), rng.uniform(70, 120)
        share = smoothstep((road.stations() - begin) / length)
        left = here + share * (highway.centre(other) - here)
        own.append(len(paths))
        paths.append(driving_path(road.offset(left), own_limit))
    outermost = index == highway.lanes - 1
    sources.append(
        Source(
            paths=tuple(own),
            low=5.0,
            high=400.0,
            share=1.3 if outermost else 0.8,
        )
    )


def _enter(
    rng: np.random.Generator,
    highway: _Highway,
    limit: float,
    paths: list[DrivingPath],
    sources: list[Source],
) -> None:
    """Paths from the ramp onto the highway, an early and a late one."""
    own = []
    for low, high in ((0.0, 0.35), (0.3, 0.6)):
        begin = highway.join + rng.uniform(low, high) * (highway.end - highway.join)
        left = _merging(highway, begin, begin + rng.uniform(60.0, 85.0))
        own.append(len(paths))
        paths.append(driving_path(highway.road.offset(left), limit))
    sources.append(
        Source(paths=tuple(own), low=20.0, high=highway.join + 10.0, share=1.6)
    )


def _opposite(
    rng: np.random.Generator,
    builder: MapBuilder,
    highway: _Highway,
    limit: float,
    paths: list[DrivingPath],
    sources: list[Source],
) -> None:
    """The other carriageway, behind a barrier or a strip of grass."""
    road, inner = highway.road, rng.uniform(2.6, 9.0)
    builder.trace(RoadKind.EDGE_BOUNDARY, road.offset(inner - 1.0))
    builder.trace(RoadKind.LINE_SOLID_YELLOW, road.offset(inner)[::-1])
    for index in range(2):
        left = inner + (index + 0.5) * highway.lane
        lane = road.offset(left)[::-1]
        builder.trace(RoadKind.LANE_FREEWAY, lane, limit)
        sources.append(Source(paths=(len(paths),), low=60.0, high=400.0, share=0.3))
        paths.append(driving_path(lane, limit))
    builder.trace(RoadKind.LINE_BROKEN_WHITE, road.offset(inner + highway.lane)[::-1])
    outer = inner + 2 * highway.lane
    builder.trace(RoadKind.EDGE_BOUNDARY, road.offset(outer + 1.5)[::-1])
