"""The vector map of an Argoverse 2 scenario, `log_map_archive_<id>.json`.

`lane_segments` (boundaries with their marks, type, predecessors and successors),
`drivable_areas` (polygons) and `pedestrian_crossings` (two edges each); metres in the
city's frame, x east and y north. Source: the map section of the guide of
argoverse/av2-api.

    lane segment         a lane: its `centerline` where the file has one, else the mean
                         of both boundaries at equal shares of their lengths; heights
                         always from the boundaries (the files' centre lines lie at 0).
                         BIKE is LANE_BIKE, VEHICLE and BUS are LANE_STREET, in and out
                         of intersections
    its boundaries       road lines where they are painted, each once though two lanes
                         share it
    pedestrian crossing  a crosswalk: one edge there, the other back
    drivable areas       road edges: the outline of their union, holes as medians, run
                         with the drivable side on the left

Areas are tiled, and the map is cut where its tiles end: outline along such a cut (a
stretch parallel to an axis at a multiple of 10 m) is no edge of the road and is left
out, so that a road goes on where the map ends. Gaps of up to 10 cm between two areas
count as drawn by accident and are closed. The union is one of the plane: of a bridge
and the road below it makes one area. WOMD's types have no mark for a double broken
white line, for broken beside solid white and for blue: the first is read as broken
white, the second as solid white, the third as a line of unknown type. The files hold no
speed limits.
"""

import itertools
from collections.abc import Iterator
from typing import Annotated, Any, TypeAlias, final

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from sim.gpudrive import json_problem
from sim.scene import Polyline, RoadKind, SceneError

_TILE = 10.0  # m: tiles end at multiples of it
_QUANTUM = 0.01  # m, of the files' coordinates
_GAP = 0.1  # m
_SPACING = 2.0  # m between the points of a line whose heights are looked up
_MOST_POINTS = 1000  # of one such line, lest a broken map asks for memory without end
_LIMIT = 1e8  # m

_LANES = {
    "VEHICLE": RoadKind.LANE_STREET,
    "BUS": RoadKind.LANE_STREET,
    "BIKE": RoadKind.LANE_BIKE,
}
_MARKS = {
    "DASHED_WHITE": RoadKind.LINE_BROKEN_WHITE,
    "DOUBLE_DASH_WHITE": RoadKind.LINE_BROKEN_WHITE,
    "SOLID_WHITE": RoadKind.LINE_SOLID_WHITE,
    "DASH_SOLID_WHITE": RoadKind.LINE_SOLID_WHITE,
    "SOLID_DASH_WHITE": RoadKind.LINE_SOLID_WHITE,
    "DOUBLE_SOLID_WHITE": RoadKind.LINE_DOUBLE_WHITE,
    "DASHED_YELLOW": RoadKind.LINE_BROKEN_YELLOW,
    "DOUBLE_DASH_YELLOW": RoadKind.LINE_BROKEN_DOUBLE_YELLOW,
    "SOLID_YELLOW": RoadKind.LINE_SOLID_YELLOW,
    "DOUBLE_SOLID_YELLOW": RoadKind.LINE_SOLID_DOUBLE_YELLOW,
    "DASH_SOLID_YELLOW": RoadKind.LINE_PASSING_DOUBLE_YELLOW,
    "SOLID_DASH_YELLOW": RoadKind.LINE_PASSING_DOUBLE_YELLOW,
}
_UNPAINTED = "NONE"

_Points: TypeAlias = Float[np.ndarray, "_ 3"]
_Geometry: TypeAlias = Any  # shapely is imported only when such a map is read
_Id = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


class _Point(msgspec.Struct, frozen=True, gc=False):
    """A position in the city's frame, m."""

    x: float
    y: float
    z: float = 0.0


class _Lane(msgspec.Struct, frozen=True):
    """A lane segment; both boundaries run in its direction."""

    id: _Id
    lane_type: str
    left_lane_boundary: list[_Point]
    right_lane_boundary: list[_Point]
    left_lane_mark_type: str = _UNPAINTED
    right_lane_mark_type: str = _UNPAINTED
    predecessors: list[_Id] = []
    successors: list[_Id] = []
    centerline: list[_Point] = []


class _Crossing(msgspec.Struct, frozen=True):
    """A pedestrian crossing; people walk along its edges."""

    id: _Id
    edge1: list[_Point]
    edge2: list[_Point]


class _Area(msgspec.Struct, frozen=True):
    """A polygon that can be driven on."""

    area_boundary: list[_Point]


class _Map(msgspec.Struct, frozen=True):
    """A whole file; the keys are the ids again."""

    lane_segments: dict[str, _Lane]
    drivable_areas: dict[str, _Area]
    pedestrian_crossings: dict[str, _Crossing] = {}


_DECODER = msgspec.json.Decoder(_Map)


@final
class Ground:
    """Heights of the map's surface: those of the nearest known point in the plane."""

    def __init__(self, lines: list[_Points]) -> None:
        """Knows the points of these lines and points between them."""
        import shapely  # type: ignore[import-untyped]

        every = [_resampled(line, _count(line)) for line in lines if len(line)]
        self._points = np.concatenate([*every, *lines, np.zeros((0, 3))])
        self._tree = shapely.STRtree(shapely.points(self._points[:, :2]))

    def heights(self, xy: Float[np.ndarray, "some 2"]) -> Float[np.ndarray, " some"]:
        """The surface's height at each point [m]; 0 where the map is empty."""
        import shapely

        if not len(self._points) or not len(xy):
            return np.zeros(len(xy))
        return self._points[self._tree.nearest(shapely.points(xy)), 2]


def parse_map(text: bytes, *, source: str) -> tuple[tuple[Polyline, ...], Ground]:
    """The map's features and its surface; `source` names it in error messages."""
    try:
        content = _DECODER.decode(text)
    except msgspec.ValidationError as error:
        raise SceneError(f"{source}: not an Argoverse 2 map: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SceneError(f"{source}: {json_problem(text, error)}") from error
    lanes = list(content.lane_segments.values())
    areas = [_array(area.area_boundary, source) for area in _areas(content)]
    sides = [
        _array(side, source)
        for lane in lanes
        for side in (lane.left_lane_boundary, lane.right_lane_boundary)
    ]
    # A polygon's last side leads back to its first point.
    ground = Ground([*sides, *(np.concatenate([area, area[:1]]) for area in areas)])
    roads = [
        *(_lane(lane, source) for lane in lanes),
        *_lines(lanes, source),
        *(_crosswalk(c, source) for c in content.pedestrian_crossings.values()),
        *_edges(areas, ground, source),
    ]
    return tuple(roads), ground


def _areas(content: _Map) -> Iterator[_Area]:
    """The areas that have an extent."""
    for area in content.drivable_areas.values():
        if len(area.area_boundary) > 2:
            yield area


def _array(points: list[_Point], source: str) -> _Points:
    """Points as an array, which must be of this world."""
    array = np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(-1, 3)
    # Here rather than when the whole scene is checked: what follows computes with them.
    if not (np.abs(array) <= _LIMIT).all():
        raise SceneError(f"{source}: a map point is not finite or beyond {_LIMIT:g} m")
    return array


def _lane(lane: _Lane, source: str) -> Polyline:
    """A lane's centre line."""
    left, right, given = (
        _array(points, source)
        for points in (
            lane.left_lane_boundary,
            lane.right_lane_boundary,
            lane.centerline,
        )
    )
    if not len(left) or not len(right):
        raise SceneError(f"{source}: lane segment {lane.id} lacks a boundary")
    count = len(given) or max(_count(left), _count(right))
    centre = (_resampled(left, count) + _resampled(right, count)) / 2
    if len(given):
        share = _shares(given)
        height = np.interp(share, _shares(centre), centre[:, 2])
        centre = np.concatenate([given[:, :2], height[:, None]], 1)
    return Polyline(
        _LANES.get(lane.lane_type, RoadKind.LANE_UNKNOWN),
        centre,
        lane.id,
        entry_lanes=tuple(lane.predecessors),
        exit_lanes=tuple(lane.successors),
    )


def _count(line: _Points) -> int:
    """How many points `_SPACING` apart a line has."""
    length = float(np.hypot(*np.diff(line[:, :2], axis=0).T).sum())
    return int(min(np.ceil(length / _SPACING) + 1, _MOST_POINTS))


def _shares(line: _Points) -> Float[np.ndarray, " _"]:
    """Which share of a line's length lies before each of its points."""
    arc = np.concatenate([[0.0], np.hypot(*np.diff(line[:, :2], axis=0).T).cumsum()])
    return arc / max(arc[-1], 1e-9)


def _resampled(line: _Points, count: int) -> _Points:
    """`count` points at equal distances along a line, its ends among them."""
    at, share = np.linspace(0.0, 1.0, count), _shares(line)
    return np.stack([np.interp(at, share, line[:, k]) for k in range(3)], -1)


def _lines(lanes: list[_Lane], source: str) -> Iterator[Polyline]:
    """The painted boundaries, each once though it may run against itself."""
    seen = set()
    for lane in lanes:
        for mark, points in (
            (lane.left_lane_mark_type, lane.left_lane_boundary),
            (lane.right_lane_mark_type, lane.right_lane_boundary),
        ):
            key = tuple((p.x, p.y) for p in points)
            if mark == _UNPAINTED or key in seen:
                continue
            seen |= {key, key[::-1]}
            kind = _MARKS.get(mark, RoadKind.LINE_UNKNOWN)
            yield Polyline(kind, _array(points, source))


def _crosswalk(crossing: _Crossing, source: str) -> Polyline:
    """A crossing's outline; its edges may run alike or against each other."""
    there, back = _array(crossing.edge1, source), _array(crossing.edge2, source)
    if not len(there) or not len(back):
        raise SceneError(f"{source}: pedestrian crossing {crossing.id} lacks an edge")
    alike = np.hypot(*(there[-1] - back[-1])[:2]) + np.hypot(*(there[0] - back[0])[:2])
    across = np.hypot(*(there[-1] - back[0])[:2]) + np.hypot(*(there[0] - back[-1])[:2])
    back = back[::-1] if alike <= across else back
    return Polyline(RoadKind.CROSSWALK, np.concatenate([there, back]), crossing.id)


def _edges(areas: list[_Points], ground: Ground, source: str) -> Iterator[Polyline]:
    """The outlines of the areas' union, with the area on their left."""
    import shapely

    try:
        region = _union(areas)
    except shapely.errors.GEOSException as error:
        raise SceneError(
            f"{source}: the drivable areas do not unite: {error}"
        ) from error
    for polygon in shapely.get_parts(region):
        if polygon.geom_type != "Polygon" or polygon.is_empty:
            continue
        outline = shapely.geometry.polygon.orient(polygon)
        rings = [(RoadKind.EDGE_BOUNDARY, outline.exterior)]
        rings += [(RoadKind.EDGE_MEDIAN, hole) for hole in outline.interiors]
        for kind, ring in rings:
            xy = shapely.get_coordinates(ring)
            points = np.concatenate([xy, ground.heights(xy)[:, None]], 1)
            # The map may end all around, but not at a hole.
            whole = kind is RoadKind.EDGE_MEDIAN
            for part in [points] if whole else _uncut(points):
                yield Polyline(kind, part)


def _union(areas: list[_Points]) -> _Geometry:
    """One region of all areas, whose borders with each other are gone."""
    import shapely

    polygons = [shapely.Polygon(area[:, :2]) for area in areas]
    polygons = [shapely.make_valid(polygon) for polygon in polygons]
    # Not on the files' own grid (`grid_size`), which takes a hundred times as long:
    # slivers that its rounding leaves are narrower than gaps that are closed anyhow.
    region = shapely.union_all(polygons)
    wider = shapely.buffer(region, _GAP / 2, join_style="mitre")
    return shapely.buffer(wider, -_GAP / 2, join_style="mitre")


def _uncut(ring: _Points) -> Iterator[_Points]:
    """The stretches of a closed ring between the cuts; the whole ring without any."""
    cut = _is_cut(ring)
    if not cut.any():
        yield ring
        return
    first = int(cut.argmax())
    points = np.roll(ring[:-1], -first, axis=0)
    points = np.concatenate([points, points[:1]])
    # `first` is a cut: every stretch starts and ends at one.
    ends = [*np.flatnonzero(np.roll(cut, -first)).tolist(), len(cut)]
    for before, after in itertools.pairwise(ends):
        if after - before > 1:
            yield points[before + 1 : after + 1]


def _is_cut(ring: _Points) -> Bool[np.ndarray, " _"]:
    """Which segments of a ring lie where a tile ends."""
    start, end = ring[:-1, :2], ring[1:, :2]
    along = np.abs(start - end) < _QUANTUM
    on_tile = np.abs(start - np.round(start / _TILE) * _TILE) < _QUANTUM
    return np.asarray((along & on_tile).any(axis=1))
