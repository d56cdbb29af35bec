"""Bounds what a power loss costs: snapshots of the state behind a written ring.

Killing the service loses nothing, since the kernel keeps what was stored in the mapped
files. A power loss does: pages reach the disk in any order. So every few seconds

    1. the owner of the storage takes a snapshot of the counters and writers;
    2. this thread writes all changed pages to the disk (fdatasync), which includes
       every row that the snapshot counts;
    3. and then the snapshot, into the older of two places, and that to the disk.

After a power loss the newest whole snapshot is what is recovered. Between two
snapshots the ring goes on being overwritten, so a snapshot also says up to which id
rows may be written before the next (`reserved`); the owner waits rather than to go
beyond. Rows whose slots may have been overwritten are given up on recovery: at most
`reserved - inserts` of the oldest, which were next to go anyway.
"""

import struct
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from replay.folder import MappedFile

_HEAD = struct.Struct("<8sQQQQQI")
_MAGIC = b"SLSTSYNC"
_CRC = struct.Struct("<I")
HEAD_BYTES = 4096


@final
@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The state at one moment."""

    number: int
    inserts: int
    oldest: int
    samples: int
    reserved: int  # rows below this id may be written before the next snapshot
    entries: bytes  # the writers, as in `state.bin`

    def encode(self) -> bytes:
        """Header, checksum, entries."""
        head = _HEAD.pack(
            _MAGIC,
            self.number,
            self.inserts,
            self.oldest,
            self.samples,
            self.reserved,
            len(self.entries),
        )
        crc = zlib.crc32(self.entries, zlib.crc32(head))
        return (head + _CRC.pack(crc)).ljust(HEAD_BYTES, b"\0") + self.entries


def _decode(place: memoryview) -> Snapshot | None:
    """The snapshot in one of the two places; None if it is not whole."""
    head = bytes(place[: _HEAD.size])
    magic, number, inserts, oldest, samples, reserved, size = _HEAD.unpack(head)
    if magic != _MAGIC or HEAD_BYTES + size > len(place):
        return None
    entries = bytes(place[HEAD_BYTES : HEAD_BYTES + size])
    (crc,) = _CRC.unpack_from(place, _HEAD.size)
    if crc != zlib.crc32(entries, zlib.crc32(head)):
        return None
    return Snapshot(
        number=number,
        inserts=inserts,
        oldest=oldest,
        samples=samples,
        reserved=reserved,
        entries=entries,
    )


def newest_snapshot(file: MappedFile) -> Snapshot | None:
    """The newest whole one."""
    half = file.size // 2
    with memoryview(file.map) as view:
        found = [_decode(view[:half]), _decode(view[half:])]
    return max(
        (s for s in found if s is not None), key=lambda s: s.number, default=None
    )


def write_snapshot(
    snapshot: Snapshot, file: MappedFile, before: Sequence[MappedFile]
) -> None:
    """Steps 2 and 3 of the module's docstring; `OSError` if the disk refuses."""
    for other in before:
        other.sync()
    data = snapshot.encode()
    start = snapshot.number % 2 * (file.size // 2)
    file.map[start : start + len(data)] = data
    file.sync()


@final
class Syncer:
    """The thread that writes snapshots; one at a time."""

    def __init__(
        self, file: MappedFile, before: Sequence[MappedFile], durable: Snapshot
    ) -> None:
        """`durable`: what the disk holds already."""
        self._file = file
        self._before = tuple(before)
        self._changed = threading.Condition()
        self._waiting: Snapshot | None = None
        self._closed = False
        self.durable = durable
        """The newest snapshot on the disk."""
        self.error = ""
        """Why the last attempt failed; empty if it did not."""
        self._thread = threading.Thread(target=self._run, name="sync", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a snapshot is on its way."""
        return self._waiting is not None

    def start(self, snapshot: Snapshot) -> None:
        """Hands over a snapshot; only while not busy."""
        with self._changed:
            self._waiting = snapshot
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Until no snapshot is on its way; whether that came in time."""
        with self._changed:
            return self._changed.wait_for(lambda: self._waiting is None, timeout)

    def close(self) -> None:
        """Ends the thread after what is on its way."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                snapshot = self._waiting
            if snapshot is None:
                return
            try:
                write_snapshot(snapshot, self._file, self._before)
                error = ""
            except OSError as caught:
                error = (
                    f"{self._file.path.parent}: cannot write to the disk "
                    f"({caught.strerror}); inserts go on when it works again"
                )
            with self._changed:
                if not error:
                    self.durable = snapshot
                self.error = error
                self._waiting = None
                self._changed.notify_all()
