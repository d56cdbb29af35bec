"""Waymo Open Motion Dataset `Scenario` records, without TensorFlow.

Field numbers are those of the public `scenario.proto` and `map.proto` (package
`waymo.open_dataset`); only the fields that are read are listed. Positions are metres
in the map's frame, headings radians counter-clockwise from x, speed limits miles per
hour (converted to m/s). Road edges run with the drivable side on their left.

Departures: the step length is the mean of the timestamps' differences rounded to a
millisecond, since the recorded ones jitter by less; a lane, line, edge or light of a
type newer than the table is read as that feature's unknown type, a map feature of an
unknown kind or without points is left out; a light that is not reported at a step is
`LightState.UNKNOWN` there, and its stop point is the first one reported. Objects of
interest are ids in the file: one that no track has marks nothing and is left out. The
message has no field for the SDC's path samples of release 1.3.1, which come in the
flat form only (`sim.womd_example`).
"""

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Float

from sim.protobuf import build_messages
from sim.scene import (
    LightState,
    ObjectType,
    Polyline,
    RoadKind,
    Scene,
    SceneError,
    TrafficLights,
    no_lights,
)
from sim.validate import check_scene

# Classes made at run time have no fields that a type checker could see.
_Proto: TypeAlias = Any

_METRES_PER_SECOND = 0.44704  # one mile per hour

# (name, field number, type; "*" is repeated)
MESSAGES = build_messages(
    "waymo.open_dataset",
    {
        "MapPoint": (("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double")),
        "LaneCenter": (
            ("speed_limit_mph", 1, "double"),
            ("type", 2, "int32"),
            ("polyline", 8, "MapPoint*"),
            ("entry_lanes", 9, "int64*"),
            ("exit_lanes", 10, "int64*"),
        ),
        "RoadLine": (("type", 1, "int32"), ("polyline", 2, "MapPoint*")),
        "RoadEdge": (("type", 1, "int32"), ("polyline", 2, "MapPoint*")),
        "StopSign": (("lane", 1, "int64*"), ("position", 2, "MapPoint")),
        "Crosswalk": (("polygon", 1, "MapPoint*"),),
        "SpeedBump": (("polygon", 1, "MapPoint*"),),
        "Driveway": (("polygon", 1, "MapPoint*"),),
        "MapFeature": (
            ("id", 1, "int64"),
            ("lane", 3, "LaneCenter"),
            ("road_line", 4, "RoadLine"),
            ("road_edge", 5, "RoadEdge"),
            ("stop_sign", 7, "StopSign"),
            ("crosswalk", 8, "Crosswalk"),
            ("speed_bump", 9, "SpeedBump"),
            ("driveway", 10, "Driveway"),
        ),
        "TrafficSignalLaneState": (
            ("lane", 1, "int64"),
            ("state", 2, "int32"),
            ("stop_point", 3, "MapPoint"),
        ),
        "DynamicMapState": (("lane_states", 1, "TrafficSignalLaneState*"),),
        "ObjectState": (
            ("center_x", 2, "double"),
            ("center_y", 3, "double"),
            ("center_z", 4, "double"),
            ("length", 5, "float"),
            ("width", 6, "float"),
            ("height", 7, "float"),
            ("heading", 8, "float"),
            ("velocity_x", 9, "float"),
            ("velocity_y", 10, "float"),
            ("valid", 11, "bool"),
        ),
        "Track": (
            ("id", 1, "int32"),
            ("object_type", 2, "int32"),
            ("states", 3, "ObjectState*"),
        ),
        "RequiredPrediction": (("track_index", 1, "int32"),),
        "Scenario": (
            ("timestamps_seconds", 1, "double*"),
            ("tracks", 2, "Track*"),
            ("objects_of_interest", 4, "int32*"),
            ("scenario_id", 5, "bytes"),
            ("sdc_track_index", 6, "int32"),
            ("dynamic_map_states", 7, "DynamicMapState*"),
            ("map_features", 8, "MapFeature*"),
            ("current_time_index", 10, "int32"),
            ("tracks_to_predict", 11, "RequiredPrediction*"),
        ),
    },
)

# The offset of each feature's own type numbers in `RoadKind`, and how many there are.
_TYPED = {
    "lane": (RoadKind.LANE_UNKNOWN, 4),
    "road_line": (RoadKind.LINE_UNKNOWN, 9),
    "road_edge": (RoadKind.EDGE_UNKNOWN, 3),
}
_POLYGONS = {
    "crosswalk": RoadKind.CROSSWALK,
    "speed_bump": RoadKind.SPEED_BUMP,
    "driveway": RoadKind.DRIVEWAY,
}


def parse_scenario(payload: bytes, *, source: str) -> Scene:
    """Reads one serialised `Scenario`; `source` names it in error messages."""
    scenario: _Proto = MESSAGES["Scenario"]()
    try:
        scenario.ParseFromString(payload)
    except DecodeError as error:
        raise SceneError(f"{source}: not a WOMD Scenario message ({error})") from error
    if not scenario.tracks:
        raise SceneError(f"{source}: not a WOMD Scenario message, or without tracks")
    states = _states(scenario, source)
    roads = tuple(_roads(scenario.map_features))
    object_ids = [track.id for track in scenario.tracks]
    return check_scene(
        Scene(
            scenario_id=scenario.scenario_id.decode("utf-8", "replace"),
            dt=_step_length(scenario, source),
            current_step=scenario.current_time_index,
            sdc_index=scenario.sdc_track_index,
            object_ids=np.array(object_ids, np.int64),
            object_types=_object_types(scenario, source),
            position=states[..., 1:4],
            yaw=states[..., 7],
            velocity=states[..., 8:10],
            size=states[..., 4:7],
            valid=states[..., 0] > 0,
            roads=roads,
            lights=_lights(scenario),
            tracks_to_predict=each_once(
                p.track_index for p in scenario.tracks_to_predict
            ),
            objects_of_interest=rows_of(scenario.objects_of_interest, object_ids),
            left_out=len(scenario.map_features) - len(roads),
            source=source,
        )
    )


def each_once(rows: Iterable[int]) -> tuple[int, ...]:
    """The rows in order, each once: one listed twice is not to be controlled twice."""
    return tuple(dict.fromkeys(rows))


def rows_of(ids: Iterable[int], object_ids: Sequence[int]) -> tuple[int, ...]:
    """The rows of the objects with these ids; an id that no object has has none."""
    row_of: dict[int, int] = {}
    for row, object_id in enumerate(object_ids):
        row_of.setdefault(object_id, row)
    return each_once(row_of[i] for i in ids if i in row_of)


def _step_length(scenario: _Proto, source: str) -> float:
    """Seconds between steps; the timestamps must be at least two and increase."""
    times = np.array(scenario.timestamps_seconds, np.float64)
    if len(times) < 2:
        raise SceneError(f"{source}: {len(times)} timestamps, at least 2 are needed")
    if not (np.diff(times) > 0).all():
        raise SceneError(f"{source}: the timestamps do not increase")
    return round(float(times[-1] - times[0]) / (len(times) - 1), 3)


def _states(scenario: _Proto, source: str) -> Float[np.ndarray, "objects steps 10"]:
    """Valid, x, y, z, length, width, height, yaw, v_x, v_y; zeros where invalid."""
    steps = len(scenario.timestamps_seconds)
    states = np.zeros((len(scenario.tracks), steps, 10))
    for index, track in enumerate(scenario.tracks):
        if len(track.states) != steps:
            raise SceneError(
                f"{source}: track {index} has {len(track.states)} states, but there "
                f"are {steps} timestamps"
            )
        for step, state in enumerate(track.states):
            if state.valid:
                states[index, step] = (
                    1.0,
                    state.center_x,
                    state.center_y,
                    state.center_z,
                    state.length,
                    state.width,
                    state.height,
                    state.heading,
                    state.velocity_x,
                    state.velocity_y,
                )
    return states


def _object_types(scenario: _Proto, source: str) -> np.ndarray:
    """The tracks' types, which must be known: their sizes and dynamics differ."""
    types = np.array([track.object_type for track in scenario.tracks], np.int64)
    unknown = np.flatnonzero(types > max(ObjectType))
    if len(unknown):
        raise SceneError(
            f"{source}: track {unknown[0]} is of unknown type {types[unknown[0]]}"
        )
    return types


def _roads(features: Iterable[_Proto]) -> Iterable[Polyline]:
    """The map features that have points."""
    for feature in features:
        road = _road(feature)
        if road is not None and len(road.points):
            yield road


def _road(feature: _Proto) -> Polyline | None:
    """One map feature, or None if it is of a kind that the table does not know."""
    for name, (base, count) in _TYPED.items():
        if feature.HasField(name):
            data = getattr(feature, name)
            known = data.type if 0 <= data.type < count else 0
            return _line(RoadKind(base + known), feature.id, data)
    for name, kind in _POLYGONS.items():
        if feature.HasField(name):
            points = _points(getattr(feature, name).polygon)
            return Polyline(kind, open_polygon(points), feature.id)
    if feature.HasField("stop_sign"):
        sign = feature.stop_sign
        points = _points([sign.position])
        lanes = tuple(sign.lane)
        return Polyline(RoadKind.STOP_SIGN, points, feature.id, stop_lanes=lanes)
    return None


def _line(kind: RoadKind, feature_id: int, data: _Proto) -> Polyline:
    """A lane, line or edge."""
    points = _points(data.polyline)
    if not kind.is_lane:
        return Polyline(kind, points, feature_id)
    return Polyline(
        kind,
        points,
        feature_id,
        entry_lanes=tuple(data.entry_lanes),
        exit_lanes=tuple(data.exit_lanes),
        speed_limit=data.speed_limit_mph * _METRES_PER_SECOND,
    )


def _points(points: Iterable[_Proto]) -> Float[np.ndarray, "points 3"]:
    """`MapPoint` messages as an array."""
    return np.array([(p.x, p.y, p.z) for p in points], np.float64).reshape(-1, 3)


def open_polygon(
    points: Float[np.ndarray, "points 3"],
) -> Float[np.ndarray, "kept 3"]:
    """Drops a polygon's last point if it repeats the first."""
    repeats = len(points) > 1 and np.array_equal(points[0], points[-1])
    return points[:-1] if repeats else points


def _lights(scenario: _Proto) -> TrafficLights:
    """Gathers the lights' states of all steps by lane, in order of appearance."""
    steps = len(scenario.timestamps_seconds)
    rows: dict[int, int] = {}
    stops: list[tuple[float, float, float]] = []
    seen: list[tuple[int, int, int]] = []
    for step, dynamic in enumerate(scenario.dynamic_map_states[:steps]):
        for state in dynamic.lane_states:
            if state.lane not in rows:
                rows[state.lane] = len(rows)
                stop = state.stop_point
                stops.append((stop.x, stop.y, stop.z))
            seen.append((rows[state.lane], step, state.state))
    if not rows:
        return no_lights(steps)
    states = np.zeros((len(rows), steps), np.int64)
    for row, step, value in seen:
        states[row, step] = value if 0 <= value <= max(LightState) else 0
    return TrafficLights(np.array(list(rows), np.int64), np.array(stops), states)
