"""Argoverse 2 motion forecasting: `scenario_<id>.parquet` and the map beside it.

The table has a row per track and step at which the track was seen: position of the
box's centre [m, the city's frame], heading [rad, counter-clockwise from x], velocity
[m/s], the track's type and category, and whether the step is observed. Source:
`data_schema.py` and the guide of argoverse/av2-api; `sim.argoverse2_map` reads the map.

The recording vehicle is the track `AV`; tracks to predict are the focal track and the
scored ones, and the focal track is the object of interest. The current step is the
last observed one, 49 of 110 (as WOMD's is the last one known, 10 of 91), so that 60
steps are to be driven; a scenario that ends there (the test split) is acted at from
its last step but one.

The form lacks what follows, which is filled in:
- the step is 0.1 s;
- sizes, typical ones by type (length, width, height in m): vehicle 4.7 1.9 1.7, the AV
  4.9 1.9 1.5 (a Ford Fusion), bus 12.0 2.6 3.2, motorcyclist 2.2 0.8 1.7, cyclist 1.8
  0.7 1.8, pedestrian 0.7 0.7 1.8, riderless bicycle 1.8 0.6 1.1, all others 1.0 each;
- heights: the map's surface below the object (its nearest known point) and half the
  object's height;
- traffic lights and stop signs: there are none;
- ids are the tracks' numbers; one that is no number (`AV`) becomes -1 minus its row.

Cyclists and motorcyclists are `CYCLIST`, buses `VEHICLE`; whatever is static or unknown
is `OTHER`.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from sim.argoverse2_map import Ground, parse_map
from sim.scene import ObjectType, Polyline, Scene, SceneError, no_lights
from sim.validate import check_scene

MAGIC = b"PAR1"  # a Parquet file's first and last bytes

_DT = 0.1  # s
_AV = "AV"
_SCORED, _FOCAL = 2, 3  # categories
_MOST_STEPS = 10_000
_MOST_STATES = 10_000_000  # objects times steps

_TYPES = {
    "vehicle": ObjectType.VEHICLE,
    "bus": ObjectType.VEHICLE,
    "pedestrian": ObjectType.PEDESTRIAN,
    "cyclist": ObjectType.CYCLIST,
    "motorcyclist": ObjectType.CYCLIST,
}
_SIZES = {
    "vehicle": (4.7, 1.9, 1.7),
    "bus": (12.0, 2.6, 3.2),
    "pedestrian": (0.7, 0.7, 1.8),
    "cyclist": (1.8, 0.7, 1.8),
    "motorcyclist": (2.2, 0.8, 1.7),
    "riderless_bicycle": (1.8, 0.6, 1.1),
}
_AV_SIZE = (4.9, 1.9, 1.5)
_OTHER_SIZE = (1.0, 1.0, 1.0)

_TEXTS = ("track_id", "object_type", "scenario_id", "focal_track_id")
_COUNTS = ("timestep", "object_category", "observed")
_NUMBERS = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
COLUMNS = (*_TEXTS, *_COUNTS, *_NUMBERS)

# pyarrow is imported only when such a file is read: it takes 0.1 s and 50 MB.
_Table: TypeAlias = Any
_Column: TypeAlias = Any
_ArrowType: TypeAlias = Any


class _Rows(NamedTuple):
    """The table's columns that are read, as arrays."""

    track: Int[np.ndarray, " rows"]  # row of the scene
    step: Int[np.ndarray, " rows"]
    observed: Bool[np.ndarray, " rows"]
    values: Float[np.ndarray, "rows 5"]  # `_NUMBERS`


def is_scenario(path: Path) -> bool:
    """Whether a Parquet file's footer names this table's columns.

    Raises:
        SceneError: the file has no whole footer.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(size - 8, 0))
            tail = file.read(8)
            length = int.from_bytes(tail[:4], "little")
            if tail[4:] != MAGIC or length + 12 > size:
                raise SceneError(
                    f"{path}: truncated at byte {size}: the Parquet file's footer is "
                    "not there; fetch the file again"
                )
            file.seek(size - 8 - length)
            footer = file.read(length)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    return all(name.encode() in footer for name in COLUMNS)


def is_map(text: bytes) -> bool:
    """Whether a JSON file is the map of a scenario."""
    return b'"lane_segments"' in text and b'"drivable_areas"' in text


def read_argoverse2(path: Path) -> Scene:
    """Reads a scenario and the map beside it."""
    table = _table(path)
    columns = {name: _texts(table, name, path) for name in _TEXTS}
    scenario_id = columns["scenario_id"][0]
    names = list(dict.fromkeys(columns["track_id"]))
    rows = _rows(table, columns["track_id"], names, path)
    roads, ground = _map_beside(path, scenario_id)
    focal = columns["focal_track_id"][0]
    types = dict(zip(columns["track_id"], columns["object_type"], strict=True))
    categories = _counts(table, "object_category", path)
    scored = set(rows.track[categories == _SCORED].tolist())
    scored |= set(rows.track[categories == _FOCAL].tolist())
    first = [names.index(focal)] if focal in names else []
    sizes = np.array([_size(name, types[name]) for name in names])
    values, valid = _states(rows, len(names), path)
    return check_scene(
        Scene(
            scenario_id=scenario_id,
            dt=_DT,
            current_step=_current_step(rows),
            sdc_index=_sdc(names, focal, path),
            object_ids=np.array([_id(n, row) for row, n in enumerate(names)], np.int64),
            object_types=np.array(
                [_TYPES.get(types[name], ObjectType.OTHER) for name in names], np.int64
            ),
            position=_placed(values, valid, sizes, ground),
            yaw=values[..., 2],
            velocity=values[..., 3:],
            size=np.where(valid[..., None], sizes[:, None], 0.0),
            valid=valid,
            roads=roads,
            lights=no_lights(valid.shape[1]),
            tracks_to_predict=tuple(dict.fromkeys([*first, *sorted(scored)])),
            objects_of_interest=tuple(first),
            source=str(path),
        )
    )


def _table(path: Path) -> _Table:
    """The columns that are read, with at least one row."""
    import pyarrow as pa  # type: ignore[import-untyped]
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read(columns=list(COLUMNS))
    except (pa.ArrowException, OSError, ValueError) as error:
        raise SceneError(
            f"{path}: not a readable Parquet file: {_line(error)}"
        ) from error
    missing = [name for name in COLUMNS if name not in table.column_names]
    if missing:
        raise SceneError(
            f"{path}: no column {missing[0]!r}; only Argoverse 2 motion scenarios are "
            "supported"
        )
    if not table.num_rows:
        raise SceneError(f"{path}: there is no object")
    return table


def _line(error: Exception) -> str:
    """An error's first line; it may quote bytes of the file."""
    first = (str(error).splitlines() or [type(error).__name__])[0][:200]
    return "".join(char if char.isprintable() else "?" for char in first)


def _column(table: _Table, name: str, kind: _ArrowType, path: Path) -> _Column:
    """A column of this Arrow type without gaps."""
    import pyarrow as pa

    try:
        column = table.column(name).cast(kind)
    except pa.ArrowException as error:
        raise SceneError(f"{path}: column {name!r}: {_line(error)}") from error
    if column.null_count:
        raise SceneError(f"{path}: column {name!r} has {column.null_count} empty cells")
    return column


def _texts(table: _Table, name: str, path: Path) -> list[str]:
    """A column of text."""
    import pyarrow as pa

    try:
        texts: list[str] = _column(table, name, pa.string(), path).to_pylist()
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: column {name!r} is no text: {error}") from error
    return texts


def _counts(table: _Table, name: str, path: Path) -> Int[np.ndarray, " rows"]:
    """A column of whole numbers or flags."""
    import pyarrow as pa

    return _column(table, name, pa.int64(), path).to_numpy()


def _rows(table: _Table, tracks: list[str], names: list[str], path: Path) -> _Rows:
    """The columns of numbers, checked as far as the arrays' sizes depend on them."""
    import pyarrow as pa

    row_of = {name: row for row, name in enumerate(names)}
    step = _counts(table, "timestep", path)
    if step.min() < 0 or step.max() >= _MOST_STEPS:
        raise SceneError(
            f"{path}: timesteps {step.min()} to {step.max()}, expected 0 to at most "
            f"{_MOST_STEPS - 1}"
        )
    columns = [_column(table, name, pa.float64(), path).to_numpy() for name in _NUMBERS]
    return _Rows(
        np.array([row_of[name] for name in tracks], np.int64),
        step,
        _counts(table, "observed", path) != 0,
        np.stack(columns, -1),
    )


def _states(
    rows: _Rows, objects: int, path: Path
) -> tuple[Float[np.ndarray, "objects steps 5"], Bool[np.ndarray, "objects steps"]]:
    """`_NUMBERS` by object and step, and where there are any; zeros elsewhere."""
    steps = int(rows.step.max()) + 1
    if objects * steps > _MOST_STATES:
        raise SceneError(
            f"{path}: {objects} tracks of {steps} steps, at most {_MOST_STATES} states"
        )
    seen = np.zeros((objects, steps), np.int64)
    np.add.at(seen, (rows.track, rows.step), 1)
    if seen.max() > 1:
        row, step = np.argwhere(seen > 1)[0]
        raise SceneError(f"{path}: track {row} has two states at step {step}")
    values = np.zeros((objects, steps, len(_NUMBERS)))
    values[rows.track, rows.step] = rows.values
    return values, seen > 0


def _current_step(rows: _Rows) -> int:
    """The last observed step, but not the scene's last."""
    observed = int(rows.step[rows.observed].max(initial=0))
    return max(min(observed, int(rows.step.max()) - 1), 0)


def _sdc(names: list[str], focal: str, path: Path) -> int:
    """The recording vehicle's row; without one the focal track's."""
    for name in (_AV, focal):
        if name in names:
            return names.index(name)
    raise SceneError(f"{path}: neither the track {_AV!r} nor the focal track is there")


def _size(name: str, kind: str) -> tuple[float, float, float]:
    """A track's length, width and height [m]."""
    return _AV_SIZE if name == _AV else _SIZES.get(kind, _OTHER_SIZE)


def _id(name: str, row: int) -> int:
    """A track's number."""
    return int(name) if re.fullmatch("[0-9]{1,18}", name) else -1 - row


def _placed(
    values: Float[np.ndarray, "objects steps 5"],
    valid: Bool[np.ndarray, "objects steps"],
    sizes: Float[np.ndarray, "objects 3"],
    ground: Ground,
) -> Float[np.ndarray, "objects steps 3"]:
    """The boxes' centres, on the map's surface."""
    position = np.zeros((*valid.shape, 3))
    position[..., :2] = values[..., :2]
    sound = valid & np.isfinite(values[..., :2]).all(axis=-1)
    half = np.broadcast_to(sizes[:, None, 2] / 2, valid.shape)
    position[sound, 2] = ground.heights(position[sound][:, :2]) + half[sound]
    return position


def _map_beside(path: Path, scenario_id: str) -> tuple[tuple[Polyline, ...], Ground]:
    """The map of the scenario, whose name holds the same id."""
    name = f"log_map_archive_{scenario_id}.json"
    # An id that is no plain name cannot be that of a file.
    known = re.fullmatch(r"[\w.-]{1,100}", scenario_id)
    beside = path.parent / name
    if known is None or not beside.is_file():
        shown = name if known else "log_map_archive_<scenario id>.json"
        raise SceneError(
            f"{path}: its map {shown} is not in {path.parent}; put it there"
        )
    try:
        text = beside.read_bytes()
    except OSError as error:
        raise SceneError(f"{beside}: cannot be read ({error.strerror})") from error
    return parse_map(text, source=str(beside))
