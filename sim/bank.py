"""The scene bank: all scenes of a run as fixed tables in one memory-mapped file.

A scene is converted once. Every array of `Bank` holds all scenes; per-scene tables of
different lengths stand one behind the other with the scene's first row in a `_start`
array, so that a reset is a change of index. Positions are local to the scene: its
origin, kept in double precision, is subtracted before anything is rounded to float32.

File: the magic, the header's length (uint64, little-endian), the header (JSON: version,
sizes, scenario ids, origins, one {name, dtype, shape, offset} per array, the SHA-256 of
all this and of the data), then the arrays, each at a multiple of `ALIGNMENT` so that
JAX on a CPU can use the mapped pages as they are.
"""

import hashlib
import json
import math
import mmap
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from sim import convert
from sim.scene import Scene

MAGIC = b"SLIPBANK"
VERSION = 3
ALIGNMENT = 4096


class BankError(Exception):
    """A bank cannot be read or written; the message says what, where, what to do."""


class Bank(NamedTuple):
    """The arrays, one leading axis `scenes` or a flat table that `_start` indexes."""

    current_step: Int[Array, " scenes"]  # first step to act at
    steps: Int[Array, " scenes"]  # recorded steps, <= the log's axis
    objects: Int[Array, " scenes"]  # recorded objects, <= the log's axis
    sdc: Int[Array, " scenes"]  # the recording vehicle's row
    tracks: Int[Array, "scenes tracks"]  # rows to predict, filled with the log's length
    log: Float[Array, "scenes steps objects 8"]  # LOG_FIELDS
    log_valid: Bool[Array, "scenes steps objects"]
    object_type: Int[Array, "scenes objects"]  # `ObjectType`
    route: Float[Array, "scenes objects points 2"]  # m, equally spaced along the log
    route_spacing: Float[Array, "scenes objects"]  # m between two route points
    route_start: Float[Array, "scenes objects"]  # m, arc length at `current_step`
    route_end: Float[Array, "scenes objects"]  # m, arc length at the log's end
    route_speed: Float[Array, "scenes objects"]  # m/s, limit where it starts, 0 unknown
    path_chunk: UInt[Array, "scenes objects chunks"]  # row of `chunks`, of the scene's
    path_flags: UInt[Array, "scenes objects chunks"]  # `lane_paths.ON`, `OFF`; 0 fills
    path_offset: Float[Array, "scenes objects chunks"]  # m, arc length where it starts
    path_start: Float[Array, "scenes objects"]  # m, arc length at `current_step`
    path_end: Float[Array, "scenes objects"]  # m, arc length at the log's end
    chunk_start: Int[Array, " scenes"]  # first row of `chunks`
    chunks: Float[Array, "rows 9 2"]  # m, stretches of lanes; the last point fills up
    stop_position: Float[Array, "scenes stops 2"]  # m, where lanes pass stop signs
    stops: Int[Array, " scenes"]  # stop positions of the scene
    light_position: Float[Array, "scenes lights 2"]  # m, the stop point
    light_through: Float[Array, "scenes lights 2"]  # m, on its lane behind that point
    light_state: Int[Array, "scenes steps lights"]  # `LightState`
    lights: Int[Array, " scenes"]  # lights of the scene
    grid_origin: Float[Array, "scenes 2"]  # m
    grid_shape: Int[Array, "scenes 2"]  # cells along x and y
    cell_start: Int[Array, " scenes"]  # first element of `cell_row`, `cell_edges`
    cell_row: Int[Array, " cells"]  # row of `rows`, -1: the map is out of reach
    rows: UInt[Array, "kept rows"]  # segments by distance, of the scene's own
    row_count: UInt[Array, " kept"]  # how many of them there are
    segment_start: Int[Array, " scenes"]  # first row of `segments`
    segments: Float[Array, "segments 4"]  # m, x0 y0 x1 y1
    segment_kind: Int[Array, " segments"]  # `RoadKind`
    cell_edges: Int[Array, " cells"]  # -1 drivable, -2 not, else row of `fine_state`
    fine_state: Int[Array, "mixed parts"]  # -1, -2, else row of `fine_edges`
    fine_edges: Int[Array, "decisive candidates"]  # rows of `edges`, repeated to fill
    edges: Float[Array, "edges 10"]  # m, `sim.edge_table.Edges.packed`


@dataclass(frozen=True)
class BankFile:
    """An opened bank. `arrays` are read-only views of the mapped file."""

    path: Path
    content_hash: str  # SHA-256 of all that it says, hexadecimal
    scenario_ids: tuple[str, ...]
    origins: tuple[tuple[float, float, float], ...]  # m, map frame
    dt: float  # s
    arrays: dict[str, np.ndarray]

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.scenario_ids)

    @property
    def bank(self) -> Bank:
        """The arrays on JAX's default device (on a CPU: without a copy)."""
        return Bank(**jax.device_put(self.arrays))


def write_bank(
    scenes: Iterable[Scene],
    path: Path,
    *,
    progress: Callable[[int], None] | None = None,
    workers: int = 1,
) -> None:
    """Converts scenes and writes them under `path` only once the file is whole.

    Args:
        scenes: any number; all of one step length.
        path: the bank's file; a partial one beside it is renamed at the end.
        progress: told how many scenes are converted.
        workers: processes that convert. More than one are spawned, so the caller's main
            module must be guarded by `if __name__ == "__main__"`.
    """
    ids, origins, dts = [], [], set()

    def noted() -> Iterator[Scene]:
        for scene in scenes:
            ids.append(scene.scenario_id)
            origins.append(tuple(float(value) for value in convert.origin_of(scene)))
            dts.add(round(scene.dt, 6))
            yield scene

    converted = []
    for part in convert.convert_all(noted(), workers=workers):
        converted.append(part)
        if progress:
            progress(len(converted))
    if not converted:
        raise BankError(f"{path}: no scene to write; name at least one scene")
    if len(dts) > 1:
        raise BankError(
            f"{path}: scenes of different step lengths {sorted(dts)} s; "
            "convert them into banks of their own"
        )
    arrays = convert.stack(converted)
    _write_file(
        path, arrays, {"scenario_ids": ids, "origins": origins, "dt": dts.pop()}
    )


def _write_file(
    path: Path, arrays: dict[str, np.ndarray], description: dict[str, Any]
) -> None:
    arrays = {name: np.ascontiguousarray(arrays[name]) for name in Bank._fields}
    entries: list[dict[str, Any]] = []
    places: list[int] = []
    end = 0
    for name, data in arrays.items():
        entries.append(
            {"name": name, "dtype": data.dtype.str, "shape": data.shape, "offset": end}
        )
        places.append(end)
        end += _aligned(data.nbytes)
    header = json.dumps(
        {
            "version": VERSION,
            "sha256": _digest(arrays, description),
            "bytes": end,
            "arrays": entries,
            **description,
        }
    ).encode()
    start = _aligned(len(MAGIC) + 8 + len(header))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(temporary, "wb") as file:
                file.write(MAGIC + len(header).to_bytes(8, "little") + header)
                for place, data in zip(places, arrays.values(), strict=True):
                    file.seek(start + place)
                    file.write(_bytes(data))
                file.truncate(start + end)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise BankError(f"cannot write bank {path}: {error.strerror}") from error


def _bytes(data: np.ndarray) -> memoryview:
    """The array's memory; a view of no element cannot be cast."""
    return data.data.cast("B") if data.size else memoryview(b"")


def _digest(arrays: dict[str, np.ndarray], description: dict[str, Any]) -> str:
    """SHA-256 of all that a bank says: names, types, shapes, description and data."""
    shapes = [
        (name, arrays[name].dtype.str, arrays[name].shape) for name in Bank._fields
    ]
    text = json.dumps([VERSION, shapes, sorted(description.items())])
    digest = hashlib.sha256(text.encode())
    for name in Bank._fields:
        digest.update(_bytes(arrays[name]))
    return digest.hexdigest()


def open_bank(path: Path) -> BankFile:
    """Maps a bank. Costs milliseconds whatever its size; `verify` reads it whole."""
    try:
        with open(path, "rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "the file is empty"
        raise BankError(
            f"cannot open bank {path}: {reason}; make one with `slipstream scenes`"
        ) from error
    header, start = _read_header(path, mapped)
    try:
        bank = BankFile(
            path=path,
            content_hash=str(header["sha256"]),
            scenario_ids=tuple(str(name) for name in header["scenario_ids"]),
            origins=tuple(
                (float(x), float(y), float(z)) for x, y, z in header["origins"]
            ),
            dt=float(header["dt"]),
            arrays={
                str(entry["name"]): _array(mapped, start, entry)
                for entry in header["arrays"]
            },
        )
    except (ValueError, KeyError, TypeError, OverflowError, SyntaxError) as error:
        raise _broken(path) from error
    if set(bank.arrays) != set(Bank._fields):
        raise BankError(f"bank {path} lacks arrays; convert its scenes again")
    return bank


def _array(mapped: mmap.mmap, start: int, entry: dict[str, Any]) -> np.ndarray:
    """A view of one array of the file."""
    dtype, shape = np.dtype(entry["dtype"]), tuple(entry["shape"])
    if entry["offset"] < 0 or any(length < 0 for length in shape):
        raise ValueError("an array outside of the data")
    flat = np.frombuffer(mapped, dtype, math.prod(shape), start + entry["offset"])
    return flat.reshape(shape)


def _broken(path: Path) -> BankError:
    return BankError(f"bank {path}: broken header; convert its scenes again")


def _read_header(path: Path, mapped: mmap.mmap) -> tuple[dict[str, Any], int]:
    """The header and the byte offset at which the data start."""
    if mapped[: len(MAGIC)] != MAGIC:
        raise BankError(f"{path} is not a bank; make one with `slipstream scenes`")
    length = int.from_bytes(mapped[8:16], "little")
    if 16 + length > len(mapped):
        raise BankError(
            f"bank {path} is truncated at byte {len(mapped)}, within its header; "
            "convert its scenes again"
        )
    try:
        header = json.loads(mapped[16 : 16 + length])
        version, size = header["version"], int(header["bytes"])
    except (ValueError, KeyError, TypeError) as error:
        raise _broken(path) from error
    if version != VERSION:
        raise BankError(
            f"bank {path} has version {version}, this program reads {VERSION}; "
            "convert its scenes again"
        )
    start = _aligned(16 + length)
    if len(mapped) != start + size:
        raise BankError(
            f"bank {path} is truncated: {len(mapped)} bytes of {start + size}; "
            "convert its scenes again"
        )
    return header, start


def verify(file: BankFile) -> None:
    """Reads every byte and compares the hash; BankError if they differ."""
    found = _digest(
        file.arrays,
        {"scenario_ids": file.scenario_ids, "origins": file.origins, "dt": file.dt},
    )
    if found != file.content_hash:
        raise BankError(
            f"bank {file.path} is damaged: its content hashes to {found}, its "
            f"header says {file.content_hash}; convert its scenes again"
        )


def is_bank(path: Path) -> bool:
    """Whether the file begins as a bank does."""
    try:
        with open(path, "rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT
