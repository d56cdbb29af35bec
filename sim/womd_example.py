"""Waymo Open Motion Dataset records in the flat form, `tf.Example`.

A record is a dictionary of flat arrays: `state/{past,current,future}/*` for 128 object
slots, `roadgraph_samples/*` for up to 20,000 map points and
`traffic_light_state/{past,current,future}/*` for 16 light slots a step; from release
1.3.1 on `path_samples/*`, the ways that the SDC could have gone. Field numbers
are those of TensorFlow's public `example.proto` and `feature.proto`; names, shapes and
type numbers (those of `RoadKind`) are the data set's. Units and frames are as in
`sim.womd`, and road edges have the drivable side on their left.

Departures: the step is 0.1 s; slots that are never valid are left out, and so are
features other than those named below. Consecutive map points of one id and type are
one polyline: the form keeps neither lane connections nor speed limits, nor the lanes
of stop signs. Where several slots name one lane at a step, the last one counts. There
are as many paths as on-route flags; of each its valid points, in the file's order, are
kept, and one of fewer than two leads nowhere and is left out.
"""

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from google.protobuf.message import DecodeError
from jaxtyping import Bool, Float

from sim.protobuf import build_messages
from sim.scene import (
    LanePath,
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

_DT = 0.1  # s

MESSAGES = build_messages(
    "tensorflow",
    {
        "BytesList": (("value", 1, "bytes*"),),
        "FloatList": (("value", 1, "float*"),),
        "Int64List": (("value", 1, "int64*"),),
        "Feature": (
            ("bytes_list", 1, "BytesList"),
            ("float_list", 2, "FloatList"),
            ("int64_list", 3, "Int64List"),
        ),
        # A map field is a repeated message of key and value.
        "Entry": (("key", 1, "bytes"), ("value", 2, "Feature")),
        "Features": (("feature", 1, "Entry*"),),
        "Example": (("features", 1, "Features"),),
    },
)

_STATES = (
    *("valid", "x", "y", "z", "bbox_yaw"),
    *("velocity_x", "velocity_y", "length", "width", "height"),
)
_LIGHTS = ("valid", "id", "state", "x", "y", "z")

# Classes made at run time have no fields that a type checker could see.
_Proto: TypeAlias = Any
_Features: TypeAlias = dict[str, np.ndarray]


def is_example(payload: bytes) -> bool:
    """Whether a record is one field, number 1, of bytes: `Example.features`.

    A `Scenario` always has further fields behind its field 1.
    """
    if payload[:1] != b"\x0a":
        return False
    length = 0
    for index, byte in enumerate(payload[1:11]):
        length |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return length == len(payload) - index - 2
    return False


def parse_example(payload: bytes, *, source: str) -> Scene:
    """Reads one serialised `tf.Example`; `source` names it in error messages."""
    features = _features(payload, source)
    periods = ["past", "current"]
    if "state/future/x" in features:
        periods.append("future")
    slots = len(_get(features, "state/current/x", source))
    states = _timeline(features, "state", _STATES, periods, source)
    if states.shape[0] != slots or _get(features, "state/type", source).size != slots:
        raise SceneError(f"{source}: the object features are of different lengths")
    kept = np.flatnonzero((states[..., 0] > 0).any(axis=1))
    states = states[kept]
    states[states[..., 0] <= 0] = 0.0
    interest = "state/objects_of_interest"  # not in the first releases
    past = _get(features, "state/past/x", source).size // max(slots, 1)
    return check_scene(
        Scene(
            scenario_id=_text(features, "scenario/id", source),
            dt=_DT,
            current_step=past,
            sdc_index=_flagged(features, "state/is_sdc", kept, source, default=-1)[0],
            object_ids=_ints(
                _get(features, "state/id", source), slots, "state/id", source
            )[kept],
            object_types=_object_types(features, kept, source),
            position=states[..., 1:4],
            yaw=states[..., 4],
            velocity=states[..., 5:7],
            size=states[..., 7:10],
            valid=states[..., 0] > 0,
            roads=_roads(features, source),
            lights=_lights(features, periods, states.shape[1], source),
            tracks_to_predict=_flagged(
                features, "state/tracks_to_predict", kept, source
            ),
            objects_of_interest=_flagged(features, interest, kept, source)
            if interest in features
            else (),
            sdc_paths=_paths(features, source),
            source=source,
        )
    )


def _features(payload: bytes, source: str) -> _Features:
    """The record's arrays by name."""
    example: _Proto = MESSAGES["Example"]()
    try:
        example.ParseFromString(payload)
    except DecodeError as error:
        raise SceneError(f"{source}: not a tf.Example message ({error})") from error
    features: _Features = {}
    for entry in example.features.feature:
        name = entry.key.decode("utf-8", "replace")
        for kind in ("bytes_list", "float_list", "int64_list"):
            if entry.value.HasField(kind):
                features[name] = np.array(getattr(entry.value, kind).value)
    return features


def _get(features: _Features, name: str, source: str) -> np.ndarray:
    """A feature of numbers, which must be there."""
    values = features.get(name)
    if values is None or values.dtype.kind not in "fi":
        raise SceneError(
            f"{source}: the tf.Example has no numbers under {name!r}; only WOMD's "
            "motion examples are supported"
        )
    if values.dtype.kind == "i":
        return values
    with np.errstate(invalid="ignore"):  # signalling NaNs are refused further on
        return values.astype(np.float64)


def _text(features: _Features, name: str, source: str) -> str:
    """A feature of one string."""
    values = features.get(name, np.zeros(0))
    if values.dtype.kind != "S" or values.size != 1:
        raise SceneError(f"{source}: the tf.Example has no text under {name!r}")
    return bytes(values[0]).decode("utf-8", "replace")


def _timeline(
    features: _Features,
    group: str,
    names: Sequence[str],
    periods: Sequence[str],
    source: str,
) -> Float[np.ndarray, "slots steps values"]:
    """Puts the periods of each named feature of `group` one behind the other.

    Objects are stored slot by slot, lights step by step; both come out slot by slot.
    """
    slots = _get(features, f"{group}/current/{names[1]}", source).size
    columns = []
    for name in names:
        parts = []
        for period in periods:
            flat = _get(features, f"{group}/{period}/{name}", source)
            if not slots or flat.size % slots:
                raise SceneError(
                    f"{source}: {group}/{period}/{name} has {flat.size} values for "
                    f"{slots} slots"
                )
            by_slot = group == "state"
            part = flat.reshape((slots, -1) if by_slot else (-1, slots))
            parts.append(part if by_slot else part.T)
        columns.append(np.concatenate(parts, axis=1).astype(np.float64))
    if len({column.shape for column in columns}) != 1:
        raise SceneError(f"{source}: the {group} features are of different lengths")
    if not np.isfinite(columns[0]).all():
        raise SceneError(f"{source}: {group}/*/{names[0]} is not finite")
    return np.stack(columns, axis=-1)


def _ints(values: np.ndarray, count: int, name: str, source: str) -> np.ndarray:
    """Whole numbers, which the form stores as floats in places."""
    # Beyond 2^53 a float is no id, and the conversion would be undefined.
    if values.size != count or not (np.abs(values) < 2.0**53).all():
        raise SceneError(f"{source}: {name} is not {count} whole numbers")
    return values.astype(np.int64)


def _flagged(
    features: _Features,
    name: str,
    kept: np.ndarray,
    source: str,
    default: int | None = None,
) -> tuple[int, ...]:
    """Which of the kept objects a 0/1 feature (-1 in empty slots) marks."""
    slots = _get(features, "state/type", source).size
    flags = _ints(_get(features, name, source), slots, name, source)
    marked = tuple(int(i) for i in np.flatnonzero(flags[kept] == 1))
    return marked if marked or default is None else (default,)


def _object_types(features: _Features, kept: np.ndarray, source: str) -> np.ndarray:
    """The kept objects' types, which must be known."""
    values = _get(features, "state/type", source)
    types = _ints(values, values.size, "state/type", source)[kept]
    if not np.isin(types, list(ObjectType)).all():
        raise SceneError(f"{source}: an object is of an unknown type")
    return types


def _roads(features: _Features, source: str) -> tuple[Polyline, ...]:
    """The runs of valid map points that share an id and a type."""
    group = "roadgraph_samples"
    points = _get(features, f"{group}/xyz", source).astype(np.float64)
    valid, ids, kinds = (
        _ints(_get(features, f"{group}/{name}", source), points.size // 3, name, source)
        for name in ("valid", "id", "type")
    )
    if points.size % 3:
        raise SceneError(f"{source}: {group}/xyz has {points.size} values")
    use = valid > 0
    points, ids, kinds = points.reshape(-1, 3)[use], ids[use], kinds[use]
    unknown = ~np.isin(kinds, list(RoadKind))
    if unknown.any():
        raise SceneError(f"{source}: map points of unknown type {kinds[unknown][0]}")
    cuts = np.flatnonzero((np.diff(ids) != 0) | (np.diff(kinds) != 0)) + 1
    bounds = [0, *cuts.tolist(), len(ids)]
    return tuple(
        Polyline(RoadKind(int(kinds[start])), points[start:end], int(ids[start]))
        for start, end in itertools.pairwise(bounds)
        if end > start
    )


def _paths(features: _Features, source: str) -> tuple[LanePath, ...]:
    """The SDC's path samples; none where the record is of a release without."""
    group = "path_samples"
    if f"{group}/xyz" not in features:
        return ()
    xyz = _get(features, f"{group}/xyz", source).astype(np.float64)
    on_route, valid = (
        _ints(values, values.size, name, source)
        for name in (f"{group}/on_route", f"{group}/valid")
        for values in (_get(features, name, source),)
    )
    paths = on_route.size
    if not paths or valid.size % paths or xyz.size != 3 * valid.size:
        raise SceneError(
            f"{source}: {group} has {paths} on-route flags, {valid.size} valid flags "
            f"and {xyz.size} coordinates, which do not divide into paths"
        )
    points, use = xyz.reshape(paths, -1, 3), valid.reshape(paths, -1) > 0
    return tuple(
        LanePath(points[path, use[path]], bool(on_route[path] == 1))
        for path in range(paths)
        if use[path].sum() > 1
    )


def _lights(
    features: _Features, periods: Sequence[str], steps: int, source: str
) -> TrafficLights:
    """The lights by lane; a slot may serve several lanes over time."""
    if "traffic_light_state/current/id" not in features:
        return no_lights(steps)
    table = _timeline(features, "traffic_light_state", _LIGHTS, periods, source)
    seen: Bool[np.ndarray, "slots steps"] = table[..., 0] > 0
    if table.shape[1] != steps or not np.isfinite(table[seen]).all():
        raise SceneError(f"{source}: the traffic lights are not finite or not complete")
    lanes, first = np.unique(table[seen][:, 1], return_index=True)
    if not len(lanes):
        return no_lights(steps)
    states = np.zeros((len(lanes), steps), np.int64)
    rows = np.searchsorted(lanes, table[seen][:, 1])
    values = table[seen][:, 2]
    states[rows, np.nonzero(seen)[1]] = np.where(
        np.isin(values, list(LightState)), values, 0
    )
    lane_ids = _ints(lanes, len(lanes), "traffic_light_state/*/id", source)
    return TrafficLights(lane_ids, table[seen][first][:, 3:6], states)
