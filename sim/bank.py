"""The scene bank: all scenes of a run as fixed tables in one memory-mapped file.

A scene is converted once. Every array of `Bank` holds all scenes; per-scene tables of
different lengths stand one behind the other with the scene's first row in a `_start`
array, so that a reset is a change of index. Positions are local to the scene: its
origin, kept in double precision, is subtracted before anything is rounded to float32.

File: the magic, the header's length (uint64, little-endian), the header (JSON,
`Header`), then the arrays, each at a multiple of `ALIGNMENT` so that JAX on a CPU can
use the mapped pages as they are. `sim.bank_writer` writes it.
"""

import hashlib
import math
import mmap
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple, final

import jax
import msgspec
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

MAGIC = b"SLIPBANK"
VERSION = 4
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
    chunks: Float[Array, "rows 2 9"]  # m, x and y of lanes; the last point fills up
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
    segment_rows: Float[Array, "segments 11"]  # `sim.tables.segment_rows`
    cell_edges: Int[Array, " cells"]  # -1 drivable, -2 not, else row of `fine_state`
    fine_start: Int[Array, " scenes"]  # first row of `fine_state`; rows are the scene's
    fine_state: Int[Array, "mixed parts"]  # -1, -2, else list of candidates
    list_start: Int[Array, " scenes"]  # first list; lists too are the scene's own
    list_first: Int[Array, " lists"]  # a list's first element of `list_edges`
    list_count: UInt[Array, " lists"]  # how many it has
    list_edges: Int[Array, " elements"]  # rows of `edges`, of the scene's own
    candidates: Int[Array, " longest"]  # 0, 1, ...: as many as the longest list has
    edge_start: Int[Array, " scenes"]  # first row of `edges`
    edges: Float[Array, "edges 10"]  # m, `sim.edge_table.Edges.packed`


@final
class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where in the file an array is."""

    name: str
    dtype: str  # numpy's name of the type, with the byte order
    shape: tuple[Annotated[int, msgspec.Meta(ge=0)], ...]
    offset: Annotated[int, msgspec.Meta(ge=0)]  # bytes from the start of the data

    @property
    def size(self) -> int:
        """Bytes of the array."""
        return math.prod(self.shape) * np.dtype(self.dtype).itemsize


@final
class Header(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """All that a bank says besides its arrays."""

    version: int
    sha256: str  # `digest_of` the header and the arrays, hexadecimal
    bytes: int  # of the data, a multiple of `ALIGNMENT`
    dt: float  # s
    arrays: tuple[Entry, ...]
    scenario_ids: tuple[str, ...]
    origins: tuple[tuple[float, float, float], ...]  # m, map frame
    dropped: tuple[int, ...]  # objects of each scene that there was no slot for
    left_out: tuple[int, ...]  # map features of each scene that could not be used


@final
class _Versioned(msgspec.Struct):
    """What headers of all versions have."""

    version: int


@dataclass(frozen=True)
class BankFile:
    """An opened bank. `arrays` are read-only views of the mapped file."""

    path: Path
    header: Header
    arrays: dict[str, np.ndarray]

    @property
    def content_hash(self) -> str:
        """SHA-256 of all that it says, hexadecimal."""
        return self.header.sha256

    @property
    def scenario_ids(self) -> tuple[str, ...]:
        """The scenes' ids, by row."""
        return self.header.scenario_ids

    @property
    def origins(self) -> tuple[tuple[float, float, float], ...]:
        """Each scene's origin in the map's frame [m]."""
        return self.header.origins

    @property
    def dt(self) -> float:
        """Seconds between two steps."""
        return self.header.dt

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.scenario_ids)

    @property
    def bank(self) -> Bank:
        """The arrays on JAX's default device (on a CPU: without a copy)."""
        return Bank(**jax.device_put(self.arrays))


def digest_of(header: Header, digests: Iterable[bytes]) -> str:
    """SHA-256, hexadecimal, of a header (without its hash) and its arrays' SHA-256.

    Of the arrays' hashes and not of the arrays, as they are written, and can be read,
    all at once.
    """
    found = hashlib.sha256(
        msgspec.json.encode(msgspec.structs.replace(header, sha256=""))
    )
    for digest in digests:
        found.update(digest)
    return found.hexdigest()


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
        arrays = {
            entry.name: _array(mapped, start, entry, header.bytes)
            for entry in header.arrays
        }
    except (ValueError, TypeError, OverflowError, SyntaxError) as error:
        raise _broken(path) from error
    if set(arrays) != set(Bank._fields):
        raise BankError(f"bank {path} lacks arrays; convert its scenes again")
    each = (header.scenario_ids, header.origins, header.dropped, header.left_out)
    if len({len(values) for values in each}) > 1:
        raise _broken(path)
    return BankFile(path, header, arrays)


def _array(mapped: mmap.mmap, start: int, entry: Entry, size: int) -> np.ndarray:
    """A view of one array of the file."""
    if entry.offset % ALIGNMENT or entry.offset + entry.size > size:
        raise ValueError("an array outside of the data")
    dtype, offset = np.dtype(entry.dtype), start + entry.offset
    flat = np.frombuffer(mapped, dtype, math.prod(entry.shape), offset)
    return flat.reshape(entry.shape)


def _broken(path: Path) -> BankError:
    return BankError(f"bank {path}: broken header; convert its scenes again")


def _read_header(path: Path, mapped: mmap.mmap) -> tuple[Header, int]:
    """The header and the byte offset at which the data start."""
    if mapped[: len(MAGIC)] != MAGIC:
        raise BankError(f"{path} is not a bank; make one with `slipstream scenes`")
    length = int.from_bytes(mapped[8:16], "little")
    if 16 + length > len(mapped):
        raise BankError(
            f"bank {path} is truncated at byte {len(mapped)}, within its header; "
            "convert its scenes again"
        )
    text = mapped[16 : 16 + length]
    try:
        version = msgspec.json.decode(text, type=_Versioned).version
        if version != VERSION:
            raise BankError(
                f"bank {path} has version {version}, this program reads {VERSION}; "
                "convert its scenes again"
            )
        header = msgspec.json.decode(text, type=Header)
    except (msgspec.MsgspecError, ValueError) as error:
        raise _broken(path) from error
    start = aligned(16 + length)
    if len(mapped) != start + header.bytes:
        raise BankError(
            f"bank {path} is truncated: {len(mapped)} bytes of "
            f"{start + header.bytes}; convert its scenes again"
        )
    return header, start


def verify(file: BankFile) -> None:
    """Reads every byte and compares the hash; BankError if they differ."""

    def digest(entry: Entry) -> bytes:
        # An empty array cannot be cast to bytes.
        array = file.arrays[entry.name]
        data = array.data.cast("B") if array.size else b""
        return hashlib.sha256(data).digest()

    # hashlib lets other threads run meanwhile.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        found = digest_of(file.header, pool.map(digest, file.header.arrays))
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


def aligned(size: int) -> int:
    """The next multiple of `ALIGNMENT`."""
    return -(-size // ALIGNMENT) * ALIGNMENT
