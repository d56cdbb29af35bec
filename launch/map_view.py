"""The map of a scene as Rerun entities.

    ROOT/map/{surface,lane_lines,road_edges,crosswalks,...}   one per kind of feature

A map is logged at the step where its scene begins rather than as static data, so that
one timeline can run through several scenes. Lanes are drawn as the road's surface,
`LANE_WIDTH` wide about their centre lines: the recordings hold no lane polygons.
Broken lines are dashed 3 m on and 6 m off, closer than the MUTCD's 10 ft and 30 ft
(section 3A.06) so that a dash stays visible across a junction.
"""

from dataclasses import dataclass

import numpy as np
import rerun as rr
from jaxtyping import Float, UInt

from launch.scene_view import Colour, ViewScene, send
from sim.scene import RoadKind

LANE_WIDTH = 3.7  # m, for drawing only
DASH, GAP = 3.0, 6.0  # m
STRIPE, STRIPE_GAP = 0.6, 0.7  # m, of a crosswalk
SURFACE_DEPTH = (
    0.3  # m below the centre lines: lanes beside each other differ in height
)

Strips = list[Float[np.ndarray, "_ 3"]]

_WHITE: Colour = (214, 218, 224, 255)
_YELLOW: Colour = (232, 183, 60, 255)
_EDGE: Colour = (148, 158, 171, 255)
_MEDIAN: Colour = (112, 122, 135, 255)
_CENTRE: Colour = (76, 84, 96, 255)
_BIKE: Colour = (66, 120, 98, 255)
_SURFACE: Colour = (47, 52, 60, 255)
_CROSSWALK: Colour = (126, 133, 143, 255)
_BUMP: Colour = (214, 160, 60, 255)
_DRIVEWAY: Colour = (92, 84, 104, 255)
_STOP: Colour = (226, 62, 54, 255)

_YELLOW_KINDS = frozenset(
    (
        RoadKind.LINE_BROKEN_YELLOW,
        RoadKind.LINE_BROKEN_DOUBLE_YELLOW,
        RoadKind.LINE_SOLID_YELLOW,
        RoadKind.LINE_SOLID_DOUBLE_YELLOW,
        RoadKind.LINE_PASSING_DOUBLE_YELLOW,
    )
)
_BROKEN_KINDS = frozenset(
    (
        RoadKind.LINE_BROKEN_WHITE,
        RoadKind.LINE_BROKEN_YELLOW,
        RoadKind.LINE_BROKEN_DOUBLE_YELLOW,
    )
)
_DOUBLE_KINDS = frozenset(
    (
        RoadKind.LINE_DOUBLE_WHITE,
        RoadKind.LINE_BROKEN_DOUBLE_YELLOW,
        RoadKind.LINE_SOLID_DOUBLE_YELLOW,
        RoadKind.LINE_PASSING_DOUBLE_YELLOW,
    )
)


def _lengths(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """Distance along a polyline of each of its points, m."""
    steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    return np.concatenate([np.zeros(1), np.cumsum(steps)])


def _along(
    points: Float[np.ndarray, "points 3"],
    lengths: Float[np.ndarray, " points"],
    start: float,
    end: float,
) -> Float[np.ndarray, "part 3"]:
    """The part of a polyline between two distances along it."""
    inner = lengths[(lengths > start) & (lengths < end)]
    wanted = np.concatenate([[start], inner, [end]])
    return np.stack([np.interp(wanted, lengths, axis) for axis in points.T], axis=-1)


def dashes(points: Float[np.ndarray, "points 3"]) -> Strips:
    """Cuts a polyline into dashes."""
    lengths = _lengths(points)
    starts = np.arange(0.0, float(lengths[-1]), DASH + GAP)
    ends = np.minimum(starts + DASH, lengths[-1])
    return [
        _along(points, lengths, start, end)
        for start, end in zip(starts, ends, strict=True)
    ]


def _beside(
    points: Float[np.ndarray, "points 3"], offset: float
) -> Float[np.ndarray, "points 3"]:
    """A polyline moved to its left, m."""
    direction = np.gradient(points[:, :2], axis=0)
    norm = np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-6)
    left = np.stack([-direction[:, 1], direction[:, 0]], axis=-1) / norm
    moved = points.copy()
    moved[:, :2] += offset * left
    return moved


def line_strips(kind: RoadKind, points: Float[np.ndarray, "points 3"]) -> Strips:
    """A road line as it is painted: dashed where broken, two strips where double."""
    offsets = (-0.15, 0.15) if kind in _DOUBLE_KINDS else (0.0,)
    strips: Strips = []
    for offset in offsets:
        beside = _beside(points, offset) if offset else points
        broken = kind in _BROKEN_KINDS or (
            kind == RoadKind.LINE_PASSING_DOUBLE_YELLOW and offset > 0
        )
        strips.extend(dashes(beside) if broken else [beside])
    return strips


def _closed(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "closed 3"]:
    """A polygon as the strip around it."""
    return np.concatenate([points, points[:1]])


def stripes(points: Float[np.ndarray, "points 3"]) -> Strips:
    """The zebra of a crosswalk: cuts across the polygon's longer axis."""
    centre = points.mean(axis=0)
    flat = (points - centre)[:, :2]
    _, vectors = np.linalg.eigh(flat.T @ flat)
    along, across = flat @ vectors[:, 1], flat @ vectors[:, 0]
    following = np.roll(points, -1, axis=0)
    next_along, slope = np.roll(along, -1), np.roll(across, -1) - across
    strips: Strips = []
    for cut in np.arange(along.min() + STRIPE, along.max(), STRIPE + STRIPE_GAP):
        crossing = (along < cut) != (next_along < cut)
        span = (next_along - along)[crossing]
        weight = ((cut - along[crossing]) / span)[:, None]
        ends = points[crossing] + weight * (following - points)[crossing]
        if len(ends) < 2:
            continue
        order = np.argsort(across[crossing] + weight[:, 0] * slope[crossing])
        strips.append(ends[order[[0, -1]]])
    return strips


def surface_mesh(
    lanes: Strips,
) -> tuple[Float[np.ndarray, "vertices 3"], UInt[np.ndarray, "triangles 3"]]:
    """The lanes' surface: two vertices per centre point, two triangles per segment."""
    vertices: Strips = [np.zeros((0, 3), np.float32)]
    triangles = [np.zeros((0, 3), np.uint32)]
    count = 0
    for points in lanes:
        sides = np.stack(
            [_beside(points, LANE_WIDTH / 2), _beside(points, -LANE_WIDTH / 2)], axis=1
        )
        left = count + 2 * np.arange(len(points) - 1)
        quads = np.stack(
            [left, left + 1, left + 2, left + 1, left + 3, left + 2], axis=-1
        )
        vertices.append(sides.reshape(-1, 3).astype(np.float32))
        triangles.append(quads.reshape(-1, 3).astype(np.uint32))
        count += 2 * len(points)
    mesh = np.concatenate(vertices)
    mesh[:, 2] -= SURFACE_DEPTH
    return mesh, np.concatenate(triangles)


def _thinned(
    points: Float[np.ndarray, "points 3"], every: float
) -> Float[np.ndarray, "thinned 3"]:
    """Keeps about one point per `every` metres, and both ends."""
    if len(points) < 3:
        return points
    passed = np.floor(_lengths(points) / every)
    keep = np.diff(passed, prepend=-1) > 0
    keep[-1] = True
    return points[keep]


@dataclass(frozen=True)
class _Layer:
    """One entity of the map: strips, their colours and the half of their width."""

    strips: Strips
    colours: list[Colour]
    radius: float  # m


def _layers(
    scene: ViewScene,
) -> dict[str, _Layer]:
    """Sorts the map's polylines into entities."""
    layers = {
        "lane_centres": _Layer([], [], 0.04),
        "driveways": _Layer([], [], 0.08),
        "crosswalks": _Layer([], [], STRIPE / 2),
        "speed_bumps": _Layer([], [], 0.2),
        "lane_lines": _Layer([], [], 0.08),
        "road_edges": _Layer([], [], 0.14),
    }
    for kind, points in scene.polylines:
        if len(points) < 2:
            continue
        name, colour, strips = _drawn(kind, points)
        layers[name].strips.extend(strips)
        layers[name].colours.extend([colour] * len(strips))
    return layers


def _drawn(
    kind: RoadKind, points: Float[np.ndarray, "points 3"]
) -> tuple[str, Colour, Strips]:
    """Entity, colour and strips of one polyline."""
    if kind.is_lane:
        colour = _BIKE if kind == RoadKind.LANE_BIKE else _CENTRE
        return "lane_centres", colour, [_thinned(points, 1.5)]
    if kind.is_edge:
        return (
            "road_edges",
            _MEDIAN if kind == RoadKind.EDGE_MEDIAN else _EDGE,
            [points],
        )
    if kind == RoadKind.CROSSWALK:
        return "crosswalks", _CROSSWALK, stripes(points)
    if kind == RoadKind.SPEED_BUMP:
        return "speed_bumps", _BUMP, [_closed(points)]
    if kind == RoadKind.DRIVEWAY:
        return "driveways", _DRIVEWAY, [_closed(points)]
    colour = _YELLOW if kind in _YELLOW_KINDS else _WHITE
    return "lane_lines", colour, line_strips(kind, _thinned(points, 1.0))


def log_map(
    recording: rr.RecordingStream, root: str, scene: ViewScene, at: int
) -> None:
    """Logs the scene's map from step `at` of the timeline on.

    Every entity is logged, empty ones too: they replace the scene before.
    """
    for name, layer in _layers(scene).items():
        count = len(layer.strips)
        columns = rr.LineStrips3D.columns(
            strips=layer.strips,
            colors=layer.colours,
            radii=np.full(count, layer.radius, np.float32),
        )
        send(recording, f"{root}/map/{name}", [at], columns.partition([count]))
    lanes = [
        _thinned(points, 1.5)
        for kind, points in scene.polylines
        if kind.is_lane and kind != RoadKind.LANE_BIKE and len(points) > 1
    ]
    _send_surface(recording, f"{root}/map/surface", lanes, at)
    signs = [p[0] for kind, p in scene.polylines if kind == RoadKind.STOP_SIGN]
    columns = rr.Points3D.columns(
        positions=np.reshape(np.asarray(signs, np.float32), (-1, 3)),
        colors=[_STOP] * len(signs),
        radii=[0.7] * len(signs),
    )
    send(recording, f"{root}/map/stop_signs", [at], columns.partition([len(signs)]))


def _send_surface(
    recording: rr.RecordingStream, entity: str, lanes: Strips, at: int
) -> None:
    """Sends the lanes' surface as one mesh."""
    vertices, triangles = surface_mesh(lanes)
    shared = len(vertices)
    columns = rr.Mesh3D.columns(
        vertex_positions=vertices,
        vertex_normals=np.tile(np.array([0, 0, 1], np.float32), (shared, 1)),
        vertex_colors=[_SURFACE] * shared,
    )
    faces = rr.Mesh3D.columns(triangle_indices=triangles)
    index = [*columns.partition([shared]), *faces.partition([len(triangles)])]
    send(recording, entity, [at], index)
