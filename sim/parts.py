"""Converted scenes one by one: in memory, or as a work file of a conversion.

A work file is two frames of `sim.tfrecord`: a description (JSON) and the arrays' bytes
in the order that it names them. Checksums tell a whole file from what a full disk or
a loss of power has left: `read_part` takes that for no file.
"""

import os
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple, final

import msgspec
import numpy as np

from sim import convert, tfrecord
from sim.convert import Converted
from sim.layout import Sizes, sizes_of
from sim.scene import Scene, SceneError


class Part(NamedTuple):
    """A converted scene: what a bank's header says of it, and where its arrays are."""

    scenario_id: str
    origin: tuple[float, float, float]  # m, map frame
    dt: float  # s
    dropped: int  # objects that there was no slot for
    left_out: int  # map features that could not be used
    source: str  # for messages
    sizes: Callable[[], Sizes]
    load: Callable[[], Converted]


@final
class _Description(msgspec.Struct, frozen=True, kw_only=True):
    """The first frame of a work file."""

    scenario_id: str
    origin: tuple[float, float, float]
    dt: float
    dropped: int
    left_out: int
    source: str
    shapes: dict[str, tuple[int, ...]]
    dtypes: dict[str, str]
    largest: dict[str, int]
    failure: str = ""  # why there is no scene


def part_of(scene: Scene, *, dropped: int = 0) -> Part:
    """A scene converted, its arrays in memory."""
    converted = convert.convert(scene)
    x, y, z = convert.origin_of(scene).tolist()
    return Part(
        scenario_id=scene.scenario_id,
        origin=(x, y, z),
        dt=round(scene.dt, 6),
        dropped=dropped,
        left_out=scene.left_out,
        source=scene.source or scene.scenario_id,
        sizes=lambda: sizes_of(converted),
        load=lambda: converted,
    )


def write_part(path: Path, part: Part) -> None:
    """Makes a part's work file; it gets its name once it is written."""
    sizes, converted = part.sizes(), part.load()
    description = _Description(
        scenario_id=part.scenario_id,
        origin=part.origin,
        dt=part.dt,
        dropped=part.dropped,
        left_out=part.left_out,
        source=part.source,
        shapes=sizes.shapes,
        dtypes={name: dtype.str for name, dtype in sizes.dtypes.items()},
        largest=sizes.largest,
    )
    data = b"".join(np.ascontiguousarray(a).tobytes() for a in converted.values())
    _write(path, description, data)


def write_failure(path: Path, failure: SceneError) -> None:
    """Makes a work file that says why a scene could not be converted."""
    description = _Description(
        scenario_id="",
        origin=(0.0, 0.0, 0.0),
        dt=0.0,
        dropped=0,
        left_out=0,
        source="",
        shapes={},
        dtypes={},
        largest={},
        failure=str(failure),
    )
    _write(path, description, b"")


def _write(path: Path, description: _Description, data: bytes) -> None:
    temporary = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        head = tfrecord.frame(msgspec.json.encode(description))
        temporary.write_bytes(head + tfrecord.frame(data))
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def read_part(path: Path) -> Part | SceneError | None:
    """What a work file holds; None if there is none, or not a whole one."""
    description = _description(path)
    if description is None:
        return None
    if description.failure:
        return SceneError(description.failure)
    return Part(
        scenario_id=description.scenario_id,
        origin=description.origin,
        dt=description.dt,
        dropped=description.dropped,
        left_out=description.left_out,
        source=description.source,
        sizes=partial(_sizes, path),
        load=partial(_load, path),
    )


def is_whole(path: Path) -> bool:
    """Whether all of a work file is as it was written; reads it."""
    records = list(tfrecord.read_records(path))
    return [isinstance(record, tfrecord.Record) for record in records] == [True, True]


def _description(path: Path) -> _Description | None:
    """The first frame, and whether the file is as long as it should be."""
    try:
        record = tfrecord.read_record(path, 0)
        description = msgspec.json.decode(record.payload, type=_Description)
        start = len(tfrecord.frame(record.payload))
        with path.open("rb") as file:
            file.seek(start)
            (length,) = struct.unpack("<Q", file.read(8))
        whole = start + len(tfrecord.frame(b"")) + length == path.stat().st_size
    except (SceneError, OSError, msgspec.MsgspecError, struct.error):
        return None
    return description if whole else None


def _known(path: Path) -> _Description:
    """The description of a work file that was there a moment ago."""
    description = _description(path)
    if description is None:
        raise SceneError(f"{path}: is damaged or gone; give the same command again")
    return description


def _sizes(path: Path) -> Sizes:
    known = _known(path)
    dtypes = {name: np.dtype(text) for name, text in known.dtypes.items()}
    return Sizes(known.shapes, dtypes, known.largest)


def _load(path: Path) -> Converted:
    known = _known(path)
    records = list(tfrecord.read_records(path))
    data = records[-1]
    if isinstance(data, SceneError):
        # So that the next conversion does not take it for whole.
        path.unlink(missing_ok=True)
        raise SceneError(f"{path}: is damaged; give the same command again")
    arrays, start = {}, 0
    for name, shape in known.shapes.items():
        count = int(np.prod(shape))
        dtype = np.dtype(known.dtypes[name])
        flat = np.frombuffer(data.payload, dtype, count, start)
        arrays[name] = flat.reshape(shape)
        start += count * dtype.itemsize
    return arrays
