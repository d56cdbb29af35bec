"""The records of `state.bin`, and the stores that write them.

    0     samples u64, oldest u64, clean u64 (1: closed in order)
    64    boot id, ASCII[40]
    512   commit record A        1024  commit record B
    4096  writers, 64 bytes each: writer, used, epoch, next sequence, rows, life, CRC32

A commit record is (generation, inserts, the entry of the writer of the last batch and
its place among the writers, CRC32). Commit g goes into place g % 2.
"""

import abc
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import final

import numpy as np

from replay.folder import STATE, MappedFile
from replay.storage import WriterMark

MAX_WRITERS = 16_384
SAMPLES, OLDEST, CLEAN, BOOT, BOOT_BYTES = 0, 8, 16, 64, 40
COMMITS = (512, 1024)
ENTRIES = 4096
ENTRY_BYTES = 64
_ENTRY = struct.Struct("<IIQQQQ")
_COMMIT = struct.Struct("<QQII")
_CRC = struct.Struct("<I")
NO_PLACE = 0xFFFFFFFF
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class AbstractStores(abc.ABC):
    """The stores that recovery relies on; tests stop them half-way."""

    @abc.abstractmethod
    def put(self, name: str, offset: int, data: bytes | memoryview) -> None:
        """Copies bytes into a file; a stop may leave a part of them."""

    @abc.abstractmethod
    def put64(self, name: str, offset: int, value: int) -> None:
        """One aligned 8-byte store; a stop leaves the old value or the new."""


@final
class FileStores(AbstractStores):
    """Stores into the mapped files."""

    def __init__(self, files: Mapping[str, MappedFile]) -> None:
        """All files by name."""
        self._maps = {name: file.map for name, file in files.items()}
        self._cells = np.frombuffer(self._maps[STATE], "<u8", BOOT // 8)

    def put(self, name: str, offset: int, data: bytes | memoryview) -> None:
        """See the base class."""
        self._maps[name][offset : offset + len(data)] = data

    def put64(self, name: str, offset: int, value: int) -> None:
        """See the base class."""
        assert name == STATE
        self._cells[offset // 8] = value


def encode_entry(mark: WriterMark) -> bytes:
    """A writer's entry, with its checksum."""
    body = _ENTRY.pack(
        mark.writer, 1, mark.epoch, mark.next_sequence, mark.rows, mark.life
    )
    return (body + _CRC.pack(zlib.crc32(body))).ljust(ENTRY_BYTES, b"\0")


EMPTY = bytes(ENTRY_BYTES)


def decode_entry(entry: bytes) -> WriterMark | None:
    """The writer of an entry; None if it is not whole."""
    writer, used, epoch, sequence, rows, life = _ENTRY.unpack_from(entry)
    (crc,) = _CRC.unpack_from(entry, _ENTRY.size)
    if used != 1 or crc != zlib.crc32(entry[: _ENTRY.size]):
        return None
    return WriterMark(
        writer=writer, epoch=epoch, next_sequence=sequence, rows=rows, life=life
    )


def encode_commit(generation: int, inserts: int, place: int, entry: bytes) -> bytes:
    """Commit `generation`: `entry` is that of the writer at `place`."""
    body = _COMMIT.pack(generation, inserts, place, 0) + entry
    return body + _CRC.pack(zlib.crc32(body))


COMMIT_BYTES = _COMMIT.size + ENTRY_BYTES + _CRC.size


def decode_commit(record: bytes) -> tuple[int, int, int, bytes] | None:
    """(generation, inserts, place, entry) of a whole record."""
    body, (crc,) = record[: -_CRC.size], _CRC.unpack(record[-_CRC.size :])
    generation, inserts, place, _ = _COMMIT.unpack_from(body)
    if generation == 0 or crc != zlib.crc32(body):
        return None
    return generation, inserts, place, body[_COMMIT.size :]


def boot_id() -> bytes:
    """Tells one start of the machine from another; zeros where it does not say."""
    try:
        return _BOOT_ID.read_bytes().strip()[:BOOT_BYTES].ljust(BOOT_BYTES, b"\0")
    except OSError:
        return bytes(BOOT_BYTES)
