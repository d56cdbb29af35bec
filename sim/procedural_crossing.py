"""Procedural family "crossing": four legs, lights or stop signs, rounded kerbs.

Leg k's reference line runs outwards from the centre and is straight for the first
`_STRAIGHT` metres. Looking outwards, traffic leaves on the right (negative offsets)
and arrives on the left; traffic that arrives by leg k turns right into leg k + 1,
goes straight on to k + 2 and turns left into k + 3. Legs of one road are alike.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from sim.procedural_geometry import STEP, Reference, integrate, smooth, turn
from sim.procedural_map import (
    DrivingPath,
    Layout,
    MapBuilder,
    Signal,
    Source,
    chain,
    driving_path,
)
from sim.procedural_roads import GUTTER, Profile, island, kerb
from sim.procedural_traffic import DT
from sim.scene import ObjectType, RoadKind

_LEG = 200.0  # m
_STRAIGHT = 60.0  # m
_YELLOW, _CLEARING = 3.0, 1.0  # s
_RIGHT, _AHEAD, _LEFT = 1, 2, 3  # legs to walk on to


@dataclass(frozen=True, kw_only=True)
class _Leg:
    """One arm of the crossing."""

    road: Reference
    yaw: float  # rad, outwards
    profile: Profile
    line: float  # m from the centre to the stop line

    @property
    def half(self) -> float:
        """Offset of the road edge."""
        return abs(self.profile.side(oncoming=True)) + GUTTER

    def at(self, station: float, left: float) -> Float[np.ndarray, "2"]:
        """A point on the straight part."""
        out = np.array([np.cos(self.yaw), np.sin(self.yaw)])
        return station * out + left * np.array([-out[1], out[0]])

    def arriving(self, lane: int) -> Float[np.ndarray, "_ 2"]:
        """Centre line of an arriving lane, walked inwards to the stop line."""
        centre = self.profile.centre(lane, oncoming=True)
        return self.road.span(centre, self.line, _LEG)[::-1]

    def leaving(self, lane: int) -> Float[np.ndarray, "_ 2"]:
        """Centre line of a leaving lane, walked outwards from the stop line."""
        centre = self.profile.centre(lane, oncoming=False)
        return self.road.span(centre, self.line, _LEG)


@dataclass(frozen=True, kw_only=True)
class _Control:
    """Who must wait: signals, stop signs on all legs, or on the minor road's."""

    lights: bool
    stops: tuple[bool, bool]  # per road
    protected: bool  # left turns have a phase of their own

    def group(self, leg: int, move: int) -> int:
        """Index of the phase in which a movement has green."""
        return 2 * (leg % 2) + (self.protected and move == _LEFT)


def crossing(rng: np.random.Generator, steps: int) -> Layout:
    """Draws a layout of this family."""
    radius = rng.uniform(6.0, 11.0)
    legs = _legs(rng, radius)
    kind = rng.random()
    control = _Control(
        lights=kind < 0.65,
        stops=(0.65 <= kind < 0.85, kind >= 0.65),
        protected=bool(rng.random() < 0.4),
    )
    shown = _phases(rng, control, steps)
    builder = MapBuilder()
    parking = [_corner(rng, builder, legs, k, radius) for k in range(4)]
    for leg in legs:
        _mark(builder, leg)
    scene = _Ways(rng, builder, legs, control, radius)
    for k in range(4):
        scene.connect(k)
        _walk_across(rng, scene, k, control, shown)
    groups = np.array(scene.groups, dtype=np.int64)
    return Layout(
        family="crossing",
        map=builder,
        paths=tuple(scene.paths),
        sources=tuple(scene.sources),
        signals=shown[groups] if control.lights else np.zeros((0, steps), np.int64),
        signal_lanes=tuple(scene.lanes) if control.lights else (),
        signal_arrows=tuple(g % 2 == 1 for g in scene.groups) if control.lights else (),
        signal_points=np.array(scene.lines if control.lights else []).reshape(-1, 2),
        parking=np.concatenate(parking),
        sidewalks=tuple(
            leg.road.span(side * (leg.half + 4.6), leg.line + 5.0, 120.0)
            for leg in legs
            for side in (-1, 1)
        )[:: int(rng.integers(2, 4))],
        zipper=False,
        vehicles=int(rng.integers(9, 17)),
        slow_share=0.1,
    )


def _legs(rng: np.random.Generator, radius: float) -> list[_Leg]:
    """Two roads that cross at 75 to 105 degrees."""
    lane = rng.uniform(3.4, 3.7)
    profiles = []
    for shares in ([0.2, 0.5, 0.3], [0.35, 0.5, 0.15]):
        count = int(rng.choice([1, 2, 3], p=shares))
        median = rng.uniform(1.5, 4.0) if count > 1 and rng.random() < 0.4 else 0.0
        profiles.append(
            Profile(forward=count, oncoming=count, lane=lane, median=median)
        )
    skew = rng.uniform(-0.26, 0.26) if rng.random() < 0.5 else 0.0
    half = [abs(p.side(oncoming=True)) + GUTTER for p in profiles]
    setback = rng.uniform(4.5, 5.5)
    legs = []
    for k in range(4):
        own, other = half[k % 2], half[1 - k % 2]
        # Towards leg k + 1 the roads enclose `angle`, towards k - 1 pi - angle.
        angle = np.pi / 2 + (skew if k % 2 == 0 else -skew)
        reach = max(
            (other + own * np.cos(phi)) / np.sin(phi) + radius / np.tan(phi / 2)
            for phi in (angle, np.pi - angle)
        )
        yaw = k * np.pi / 2 + (skew if k % 2 else 0.0)
        curvature = np.zeros(round(_LEG / STEP) + 1)
        bend = rng.uniform(-0.4, 0.4) / 60.0
        curvature[round(75 / STEP) : round(135 / STEP)] = bend
        road = integrate(smooth(curvature, 12.0), yaw)
        # The stop line lies on a sample, so that lanes end where connectors begin.
        line = np.ceil((reach + setback) / STEP) * STEP
        legs.append(_Leg(road=road, yaw=yaw, profile=profiles[k % 2], line=line))
    return legs


def _phases(
    rng: np.random.Generator, control: _Control, steps: int
) -> Int[np.ndarray, "4 steps"]:
    """What each of the four groups sees, from a random moment of the cycle on."""
    shown = np.full((4, steps), int(Signal.STOP))
    order = [1, 0, 3, 2] if control.protected else [0, 2]
    greens = [rng.uniform(4, 7) if g % 2 else rng.uniform(7, 14) for g in order]
    at = -rng.uniform(0, greens[0] + _YELLOW + _CLEARING)
    begin = int(rng.integers(0, len(order)))
    for turn_of in range(begin, begin + 8):
        group, green = order[turn_of % len(order)], greens[turn_of % len(order)]
        go, caution = round(at / DT), round((at + green) / DT)
        stop = round((at + green + _YELLOW) / DT)
        shown[group, max(go, 0) : max(caution, 0)] = Signal.GO
        shown[group, max(caution, 0) : max(stop, 0)] = Signal.CAUTION
        at += green + _YELLOW + _CLEARING
    return shown


def _corner(
    rng: np.random.Generator,
    builder: MapBuilder,
    legs: list[_Leg],
    k: int,
    radius: float,
) -> Float[np.ndarray, "slots 3"]:
    """The kerb from leg k's arriving side around the corner to the next leg."""
    here, there = legs[k], legs[(k + 1) % 4]
    inward, parked_in = kerb(rng, here.road, here.profile, True, (70.0, 150.0))
    outward, parked_out = kerb(rng, there.road, there.profile, False, (70.0, 150.0))
    first, last = round(here.line / STEP), round(there.line / STEP)
    bend = turn(
        here.at(here.line, here.half),
        here.yaw + np.pi,
        there.at(there.line, -there.half),
        there.yaw,
        radius * np.tan((np.pi - _between(here, there)) / 2),
    )
    edge = chain([inward[: len(inward) - first], bend, outward[last:]])
    builder.trace(RoadKind.EDGE_BOUNDARY, edge)
    return np.concatenate([parked_in, parked_out])


def _between(here: _Leg, there: _Leg) -> float:
    """Angle from one leg to the next, counter-clockwise."""
    return float((there.yaw - here.yaw) % (2 * np.pi))


def _mark(builder: MapBuilder, leg: _Leg) -> None:
    """Lines, the median island and the crosswalk of a leg."""
    profile, half = leg.profile, leg.profile.median / 2
    for index in range(1, profile.forward):
        for oncoming in (False, True):
            left = profile.centre(index, oncoming=oncoming)
            left -= np.sign(left) * profile.lane / 2
            line = leg.road.span(left, leg.line, _LEG)
            builder.trace(RoadKind.LINE_BROKEN_WHITE, line)
    if half:
        for left in (-half, half):
            line = leg.road.span(left, leg.line, _LEG)
            builder.trace(RoadKind.LINE_SOLID_YELLOW, line)
        outline = island(leg.road, leg.line + 1.5, _LEG, half - 0.3)
        builder.trace(RoadKind.EDGE_MEDIAN, outline)
    else:
        line = leg.road.span(0.0, leg.line, _LEG)
        builder.trace(RoadKind.LINE_SOLID_DOUBLE_YELLOW, line)
    near, far = leg.line - 4.0, leg.line - 1.2
    ring = [(near, -leg.half), (far, -leg.half), (far, leg.half), (near, leg.half)]
    builder.add(RoadKind.CROSSWALK, np.array([leg.at(*corner) for corner in ring]))


@final
class _Ways:
    """Collects lanes, paths and lights while the legs are connected."""

    def __init__(
        self,
        rng: np.random.Generator,
        builder: MapBuilder,
        legs: list[_Leg],
        control: _Control,
        radius: float,
    ) -> None:
        """Adds the lanes of all legs."""
        self.rng, self.builder, self.legs = rng, builder, legs
        self.control, self.radius = control, radius
        self.limit = [rng.uniform(11.0, 17.0), rng.uniform(9.0, 14.0)]
        self.paths: list[DrivingPath] = []
        self.sources: list[Source] = []
        self.lanes: list[int] = []
        self.groups: list[int] = []
        self.lines: list[Float[np.ndarray, " 2"]] = []
        self.ids = {
            (k, lane, leaving): builder.trace(
                RoadKind.LANE_STREET,
                leg.leaving(lane) if leaving else leg.arriving(lane),
                self.limit[k % 2],
            )
            for k, leg in enumerate(legs)
            for lane in range(leg.profile.forward)
            for leaving in (False, True)
        }

    def connect(self, k: int) -> None:
        """Everything that traffic arriving by leg k may do."""
        leg = self.legs[k]
        count = leg.profile.forward
        for lane in range(count):
            own = []
            for move in (_AHEAD, _RIGHT, _LEFT):
                if move == _RIGHT and lane != count - 1:
                    continue
                if move == _LEFT and lane != 0:
                    continue
                own.append(self._way(k, lane, move))
            path = self.paths[own[0]]
            self.sources.append(
                Source(
                    paths=tuple(own),
                    low=path.stop - 110.0,
                    high=path.stop - 5.0,
                    queue=True,
                )
            )
            # Others are past the crossing already.
            past = path.stop + leg.line + self.legs[(k + 2) % 4].line
            away = Source(paths=(own[0],), low=past + 6.0, high=past + 80.0, share=0.25)
            self.sources.append(away)
        if self.control.stops[k % 2]:
            spot = leg.at(leg.line, leg.half + 0.8)
            self.builder.add(RoadKind.STOP_SIGN, spot[None])
        self._cycle(k)

    def _way(self, k: int, lane: int, move: int) -> int:
        """One movement from one lane: its connector, light and path."""
        here, there = self.legs[k], self.legs[(k + move) % 4]
        count = there.profile.forward
        onto = {_AHEAD: lane, _RIGHT: count - 1, _LEFT: 0}[move]
        start, end = here.arriving(lane), there.leaving(onto)
        tangent = np.inf
        if move == _RIGHT:
            gap = GUTTER + here.profile.lane / 2
            half = (np.pi - _between(here, there)) / 2
            tangent = (self.radius + gap) * np.tan(half) + 0.8
        elif move == _LEFT:
            tangent = self.rng.uniform(10.0, 15.0)
        yaws = here.yaw + np.pi, there.yaw
        bend = turn(start[-1], yaws[0], end[0], yaws[1], tangent)
        limit = self.limit[k % 2]
        connector = self.builder.trace(RoadKind.LANE_STREET, bend, limit)
        self.builder.join(self.ids[k, lane, False], connector)
        self.builder.join(connector, self.ids[(k + move) % 4, onto, True])
        self.lanes.append(connector)
        self.groups.append(self.control.group(k, move))
        self.lines.append(start[-1])
        must_stop = self.control.stops[k % 2]
        # Where everybody stops, the order of arrival decides among equal ranks.
        rank = {_AHEAD: 1, _RIGHT: 2, _LEFT: 3}[move]
        rank = 10 if all(self.control.stops) else rank + 10 * must_stop
        self.paths.append(
            driving_path(
                chain([start, bend, end]),
                limit,
                stop=STEP * (len(start) - 1),
                signal=len(self.lanes) - 1 if self.control.lights else -1,
                must_stop=must_stop,
                rank=rank,
            )
        )
        return len(self.paths) - 1

    def _cycle(self, k: int) -> None:
        """Perhaps a cyclist's path straight on at the right-hand side."""
        if self.rng.random() > 0.12:
            return
        here, there = self.legs[k], self.legs[(k + 2) % 4]
        aside = here.half - GUTTER - 0.4
        start = here.road.span(aside, here.line, _LEG)[::-1]
        end = there.road.span(-aside, there.line, _LEG)
        straight = self.paths[self.sources[-2].paths[0]]
        self.sources.append(
            Source(
                paths=(len(self.paths),),
                low=straight.stop - 60.0,
                high=straight.stop - 8.0,
                kind=ObjectType.CYCLIST,
            )
        )
        self.paths.append(
            driving_path(
                chain([start, end]),
                self.limit[k % 2],
                stop=straight.stop,
                signal=straight.signal,
                must_stop=straight.must_stop,
                rank=straight.rank,
            )
        )


def _walk_across(
    rng: np.random.Generator,
    scene: _Ways,
    k: int,
    control: _Control,
    shown: Int[np.ndarray, "4 steps"],
) -> None:
    """Perhaps somebody on leg k's crosswalk, if its traffic must wait."""
    leg = scene.legs[k]
    waits = control.stops[k % 2]
    if control.lights:
        waits = bool((shown[control.group(k, _AHEAD)] == Signal.STOP).all())
    if not waits or rng.random() > (0.6 if control.lights else 0.3):
        return
    far = leg.half + 12.0
    side = rng.choice([-1.0, 1.0])
    ends = [leg.at(leg.line - 2.6, side * far), leg.at(leg.line - 2.6, -side * far)]
    low = rng.uniform(0.0, leg.half + 6.0)
    scene.sources.append(
        Source(
            paths=(len(scene.paths),),
            low=low,
            high=low + 4.0,
            kind=ObjectType.PEDESTRIAN,
        )
    )
    scene.paths.append(driving_path(np.array(ends), 2.0, rank=-1))
