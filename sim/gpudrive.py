"""Scenes as JSON, as the GPUDrive project converts them from WOMD.

One scene a file: `objects` (per step position, heading [rad], velocity and valid;
one size), `roads` (`type`, `map_element_id` in the numbers of `RoadKind`, geometry),
`tl_states` (per lane id: parallel lists of state, x, y, z and the time index of each)
and `metadata` (SDC index, tracks to predict). Frames and the orientation of road
edges are WOMD's. Source: `data_utils/process_waymo_files.py` of Emerge-Lab/gpudrive.

Departures, all from the format holding less than WOMD: the step is 0.1 s and the
current step 10 (or the last one of a shorter scene); lanes have neither connections
nor speed limits, stop signs name no lanes. Objects of interest are ids in the file:
one that no object has marks nothing and is left out. Values at invalid steps (-10000)
are zeros here. Files of the converter's first versions, which lack `metadata`, ids and
`map_element_id`, are read too: there the SDC is the last object (WOMD puts it there),
headings are degrees if one exceeds a full turn in radians, and a road's kind follows
from its `type`.
"""

import math
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float

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
from sim.womd import each_once, open_polygon, rows_of

_DT = 0.1  # s
_CURRENT_STEP = 10

_KINDS = {
    "lane": RoadKind.LANE_UNKNOWN,
    "road_line": RoadKind.LINE_UNKNOWN,
    "road_edge": RoadKind.EDGE_UNKNOWN,
    "stop_sign": RoadKind.STOP_SIGN,
    "crosswalk": RoadKind.CROSSWALK,
    "speed_bump": RoadKind.SPEED_BUMP,
    "driveway": RoadKind.DRIVEWAY,
}
_POLYGONS = (RoadKind.CROSSWALK, RoadKind.SPEED_BUMP, RoadKind.DRIVEWAY)

_Id = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]


class _Point(msgspec.Struct, frozen=True, gc=False):
    """A position in the map's frame, m."""

    x: float
    y: float
    z: float = 0.0


class _Velocity(msgspec.Struct, frozen=True, gc=False):
    """A velocity in the map's frame, m/s."""

    x: float
    y: float


class _Object(msgspec.Struct, frozen=True):
    """A track; the four lists have an entry per step."""

    position: list[_Point]
    heading: list[float]
    velocity: list[_Velocity]
    valid: list[bool]
    length: float
    width: float
    type: str
    height: float = 0.0
    id: _Id | None = None


class _Road(msgspec.Struct, frozen=True):
    """A map feature."""

    geometry: list[_Point]
    type: str
    map_element_id: int | None = None
    id: _Id = -1


class _Light(msgspec.Struct, frozen=True):
    """A lane's traffic light: the entries belong together across the lists."""

    state: list[str]
    x: list[float]
    y: list[float]
    z: list[float]
    time_index: list[int]


class _Prediction(msgspec.Struct, frozen=True):
    """A track that WOMD's challenge asks for."""

    track_index: int


class _Metadata(msgspec.Struct, frozen=True):
    """What the file says about its tracks."""

    sdc_track_index: int
    tracks_to_predict: list[_Prediction] = []
    objects_of_interest: list[_Id] = []


class _File(msgspec.Struct, frozen=True):
    """A whole file."""

    objects: list[_Object]
    roads: list[_Road]
    name: str = ""
    scenario_id: str = ""
    tl_states: dict[str, _Light] = {}
    metadata: _Metadata | None = None


_DECODER = msgspec.json.Decoder(_File)


def parse_gpudrive(text: bytes, *, source: str) -> Scene:
    """Reads one file's text; `source` names it in error messages."""
    try:
        file = _DECODER.decode(text)
    except msgspec.ValidationError as error:
        raise SceneError(f"{source}: not a GPUDrive scene: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise SceneError(f"{source}: {json_problem(text, error)}") from error
    if not file.objects:
        raise SceneError(f"{source}: there is no object")
    steps = len(file.objects[0].valid)
    if not steps:
        raise SceneError(f"{source}: object 0 has no steps")
    states = _states(file, steps, source)
    object_ids = [i if o.id is None else o.id for i, o in enumerate(file.objects)]
    metadata = file.metadata or _Metadata(sdc_track_index=len(file.objects) - 1)
    return check_scene(
        Scene(
            scenario_id=file.scenario_id or Path(file.name or source).stem,
            dt=_DT,
            current_step=max(min(_CURRENT_STEP, steps - 2), 0),
            sdc_index=metadata.sdc_track_index,
            object_ids=np.array(object_ids, np.int64),
            object_types=np.array(
                [_object_type(o.type, source) for o in file.objects], np.int64
            ),
            position=states[..., 1:4],
            yaw=states[..., 4],
            velocity=states[..., 5:7],
            size=states[..., 7:10],
            valid=states[..., 0] > 0,
            roads=tuple(_road(r, source) for r in file.roads if r.geometry),
            left_out=sum(not road.geometry for road in file.roads),
            lights=_lights(file.tl_states, steps, source),
            tracks_to_predict=each_once(
                p.track_index for p in metadata.tracks_to_predict
            ),
            objects_of_interest=rows_of(metadata.objects_of_interest, object_ids),
            source=source,
        )
    )


def json_problem(text: bytes, error: Exception) -> str:
    """Says where a JSON text is broken, by line and column (both from 1)."""
    message, _, byte = str(error).partition(" (byte ")
    offset = int(byte.rstrip(")")) if byte else len(text)
    if isinstance(error, UnicodeDecodeError):
        # The parser counts from the start of the string that is broken.
        message, offset = error.reason, _first_not_utf8(text)
    line = text.count(b"\n", 0, offset) + 1
    column = offset - (text.rfind(b"\n", 0, offset) + 1) + 1
    reason = message.removeprefix("JSON is malformed: ")
    return f"broken JSON at line {line} column {column} (byte {offset}): {reason}"


def _first_not_utf8(text: bytes) -> int:
    """The offset of the first byte that is not UTF-8."""
    try:
        text.decode()
    except UnicodeDecodeError as error:
        return error.start
    return len(text)


def _states(
    file: _File, steps: int, source: str
) -> Float[np.ndarray, "objects steps 10"]:
    """Valid, x, y, z, yaw, v_x, v_y, length, width, height; zeros where invalid."""
    states = np.zeros((len(file.objects), steps, 10))
    for index, track in enumerate(file.objects):
        lists = (track.position, track.heading, track.velocity, track.valid)
        lengths = [len(values) for values in lists]
        if lengths != [steps] * 4:
            raise SceneError(
                f"{source}: object {index} has {lengths} positions, headings, "
                f"velocities and valid flags, expected {steps} each"
            )
        states[index, :, 0] = track.valid
        states[index, :, 1:4] = [(p.x, p.y, p.z) for p in track.position]
        states[index, :, 4] = track.heading
        states[index, :, 5:7] = [(v.x, v.y) for v in track.velocity]
        states[index, :, 7:10] = (track.length, track.width, track.height)
    states[states[..., 0] == 0] = 0.0
    if file.metadata is None and np.abs(states[..., 4]).max(initial=0) > 2 * math.pi:
        states[..., 4] = np.radians(states[..., 4])
    return states


def _object_type(name: str, source: str) -> ObjectType:
    """The type that the format spells in lower case."""
    try:
        return ObjectType[name.upper()]
    except KeyError:
        known = ", ".join(kind.name.lower() for kind in ObjectType)
        raise SceneError(
            f"{source}: unknown object type {name!r}, known are {known}"
        ) from None


def _road(road: _Road, source: str) -> Polyline:
    """A map feature; `type` decides where `map_element_id` is missing or -1."""
    if road.map_element_id is not None and road.map_element_id != -1:
        try:
            kind = RoadKind(road.map_element_id)
        except ValueError:
            raise SceneError(
                f"{source}: road {road.id} has unknown map_element_id "
                f"{road.map_element_id}"
            ) from None
    elif road.type in _KINDS:
        kind = _KINDS[road.type]
    else:
        raise SceneError(f"{source}: road {road.id} is of unknown type {road.type!r}")
    points = np.array([(p.x, p.y, p.z) for p in road.geometry], np.float64)
    points = open_polygon(points) if kind in _POLYGONS else points
    return Polyline(kind, points, road.id)


def _lights(lights: dict[str, _Light], steps: int, source: str) -> TrafficLights:
    """The lights by lane; `LightState.UNKNOWN` at steps without an entry."""
    lights = {lane: light for lane, light in lights.items() if light.state}
    if not lights:
        return no_lights(steps)
    states = np.zeros((len(lights), steps), np.int64)
    for row, (lane, light) in enumerate(lights.items()):
        lists = (light.state, light.x, light.y, light.z, light.time_index)
        if len({len(values) for values in lists}) != 1:
            raise SceneError(f"{source}: tl_states {lane} has lists of several lengths")
        for name, step in zip(light.state, light.time_index, strict=True):
            if not 0 <= step < steps:
                raise SceneError(
                    f"{source}: tl_states {lane} has time index {step}, but there are "
                    f"{steps} steps"
                )
            states[row, step] = _light_state(name, source)
    return TrafficLights(
        np.array([_lane_id(lane, source) for lane in lights], np.int64),
        np.array([(li.x[0], li.y[0], li.z[0]) for li in lights.values()]),
        states,
    )


def _light_state(name: str, source: str) -> LightState:
    """The state that the format spells in lower case."""
    try:
        return LightState[name.upper()]
    except KeyError:
        raise SceneError(f"{source}: unknown traffic light state {name!r}") from None


def _lane_id(text: str, source: str) -> int:
    """A key of `tl_states`, which JSON makes a string of."""
    try:
        return int(np.int64(int(text)))
    except (ValueError, OverflowError):
        raise SceneError(f"{source}: tl_states has lane id {text!r}") from None
