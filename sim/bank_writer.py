"""Writes a bank scene by scene; `sim.bank` says what is in the file.

What is in memory is a buffer for each array, and a few numbers for each scene. The
file appears under its name only when it is whole and on the disk.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import final

import msgspec
import numpy as np

from sim.bank import (
    MAGIC,
    VERSION,
    Bank,
    BankError,
    Entry,
    Header,
    aligned,
    digest_of,
)
from sim.layout import (
    COUNTED,
    STARTS,
    TABLES,
    Layout,
    LayoutError,
    Spec,
    placed,
)
from sim.parts import Part, part_of
from sim.scene import Scene

_BUFFER = 2**20  # bytes


def write_bank(
    scenes: Iterable[Scene],
    path: Path,
    *,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Converts scenes in this process and writes them as a bank.

    They must be of one step length and, converted, fit into memory; for more of them
    there is `sim.conversion`.
    """
    parts = []
    for scene in scenes:
        parts.append(part_of(scene))
        if progress:
            progress(len(parts))
    write_parts(parts, path)


def write_parts(
    parts: Sequence[Part],
    path: Path,
    *,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Writes converted scenes under `path`, where nothing appears until all is there.

    Args:
        parts: at least one, all of one step length.
        path: the bank's file; a partial one beside it is renamed at the end.
        progress: told how many scenes are written.
    """
    if not parts:
        raise BankError(f"{path}: no scene to write; name at least one scene")
    dts = sorted({part.dt for part in parts})
    if len(dts) > 1:
        raise BankError(
            f"{path}: scenes of different step lengths {dts} s; "
            "convert them into banks of their own"
        )
    layout = Layout()
    for part in parts:
        layout.add(part.sizes())
    try:
        specs = layout.specs()
    except LayoutError as error:
        raise BankError(f"{path}: {error}") from error
    header = _header_of(parts, specs)
    try:
        with _renamed(path) as file:
            _write(file, header, specs, _told(parts, progress))
    except OSError as error:
        raise BankError(
            f"cannot write bank {path}: {error.strerror or error}"
        ) from error


def _told(
    parts: Iterable[Part], progress: Callable[[int], None] | None
) -> Iterator[Part]:
    """The parts, each reported once the next one is asked for."""
    for count, part in enumerate(parts, 1):
        yield part
        if progress:
            progress(count)


def _header_of(parts: Sequence[Part], specs: Mapping[str, Spec]) -> Header:
    """The header of a bank of these parts, still without its hash."""
    entries, end = [], 0
    for name in Bank._fields:
        spec = specs[name]
        entry = Entry(name=name, dtype=spec.dtype.str, shape=spec.shape, offset=end)
        entries.append(entry)
        end += aligned(entry.size)
    return Header(
        version=VERSION,
        sha256=hashlib.sha256().hexdigest(),  # as long as the one that follows
        bytes=end,
        dt=parts[0].dt,
        arrays=tuple(entries),
        scenario_ids=tuple(part.scenario_id for part in parts),
        origins=tuple(part.origin for part in parts),
        dropped=tuple(part.dropped for part in parts),
        left_out=tuple(part.left_out for part in parts),
    )


@final
class _Stream:
    """One array of the file: bytes come in order, are hashed and written in blocks."""

    def __init__(self, descriptor: int, offset: int) -> None:
        """Nothing has come yet."""
        self._descriptor, self._offset = descriptor, offset
        self._waiting = bytearray()
        self.written = 0
        self.digest = hashlib.sha256()

    def add(self, data: bytes) -> None:
        """The next bytes."""
        self._waiting += data
        if len(self._waiting) >= _BUFFER:
            self.flush()

    def flush(self) -> None:
        """Writes what waits."""
        self.digest.update(self._waiting)
        left = memoryview(self._waiting)
        while left:
            count = os.pwrite(self._descriptor, left, self._offset + self.written)
            self.written += count
            left = left[count:]
        left.release()
        self._waiting = bytearray()


def _write(
    descriptor: int, header: Header, specs: Mapping[str, Spec], parts: Iterable[Part]
) -> None:
    """Writes header and arrays."""
    start = aligned(len(MAGIC) + 8 + len(msgspec.json.encode(header)))
    # Before anything is converted to its final place: a disk that is too small
    # is found now, and not after an hour.
    os.posix_fallocate(descriptor, 0, start + header.bytes)
    streams = {
        entry.name: _Stream(descriptor, start + entry.offset) for entry in header.arrays
    }
    rows = dict.fromkeys(TABLES, 0)
    for part in parts:
        converted = part.load()
        for name, table in STARTS.items():
            streams[name].add(np.array(rows[table], specs[name].dtype).tobytes())
        for name, array in converted.items():
            streams[name].add(placed(name, array, specs[name], rows))
        for name in rows:
            rows[name] += len(converted[name])
    counted = specs[COUNTED[0]]
    streams[COUNTED[0]].add(np.arange(*counted.shape, dtype=counted.dtype).tobytes())
    for entry in header.arrays:
        stream = streams[entry.name]
        stream.flush()
        if stream.written < entry.size:  # the one row of a table without any
            stream.add(bytes(entry.size - stream.written))
            stream.flush()
    digests = [streams[entry.name].digest.digest() for entry in header.arrays]
    header = msgspec.structs.replace(header, sha256=digest_of(header, digests))
    text = msgspec.json.encode(header)
    os.pwrite(descriptor, MAGIC + len(text).to_bytes(8, "little") + text, 0)


@contextmanager
def _renamed(path: Path) -> Iterator[int]:
    """A file that gets the name `path` once the block has ended well."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        stack.callback(temporary.unlink, missing_ok=True)
        descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        stack.callback(os.close, descriptor)
        yield descriptor
        os.fsync(descriptor)
        os.replace(temporary, path)
        # The name too has to survive a loss of power.
        folder = os.open(path.parent, os.O_RDONLY)
        stack.callback(os.close, folder)
        os.fsync(folder)
