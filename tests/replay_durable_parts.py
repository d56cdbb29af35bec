"""What the tests of the durable replay share: stops half-way, checked rows."""

import contextlib
import os
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from replay.folder import MappedFile
from replay.local import ReplayConfig
from replay.mapped import MappedStorage, open_storage
from replay.records import AbstractStores, FileStores
from replay.spec import Field, RowSpec

CHECKED = RowSpec(
    (
        Field("writer", "i4"),
        Field("number", "i8"),
        Field("payload", "u1", (96,)),
        Field("crc", "u4"),
    )
)
# For kills under load: uniform (no torch to load), and a ratio of one.
LOADED = ReplayConfig(
    capacity=1 << 20,
    min_size=100,
    samples_per_insert=1.0,
    tolerance=10.0,
    sampler="uniform",
    durable=True,
    sync_s=0.2,
)


def checked_rows(start: int, count: int, *, writer: int) -> np.ndarray:
    """Rows whose payload follows from their number, with its checksum."""
    rows = np.zeros(count, CHECKED.dtype)
    rows["writer"] = writer
    rows["number"] = np.arange(start, start + count)
    mixed = rows["number"] * 2654435761 + writer
    rows["payload"] = (mixed[:, None] >> (np.arange(96) % 24)) & 255
    rows["crc"] = [checksum(row) for row in rows]
    return rows


def checksum(row: np.void) -> int:
    """Of everything but the checksum."""
    return zlib.crc32(row["payload"].tobytes(), int(row["writer"]) + int(row["number"]))


@contextlib.contextmanager
def fast_folder() -> Iterator[Path]:
    """A folder in memory where there is one: hundreds of syncs cost nothing there."""
    base = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(dir=base) as name:
        yield Path(name) / "replay"


class Killed(Exception):
    """The process ended here."""


class StoppingStores(AbstractStores):
    """Ends after so many bytes, in the middle of a store if need be."""

    def __init__(self, files: Mapping[str, MappedFile], budget: int) -> None:
        """`budget` in bytes."""
        self._inner = FileStores(files)
        self.budget = budget

    def put(self, name: str, offset: int, data: bytes | memoryview) -> None:
        allowed = min(len(data), self.budget)
        self.budget -= len(data)
        self._inner.put(name, offset, data[:allowed])
        if allowed < len(data):
            raise Killed

    def put64(self, name: str, offset: int, value: int) -> None:
        if self.budget < 8:
            raise Killed
        self.budget -= 8
        self._inner.put64(name, offset, value)


def open_here(
    folder: Path, *, spec: RowSpec, capacity: int, budget: int = 1 << 60
) -> MappedStorage:
    """A storage that stops after `budget` bytes of stores."""
    opened: list[dict[str, MappedFile]] = []

    def stores(files: Mapping[str, MappedFile]) -> AbstractStores:
        opened.append(dict(files))
        return StoppingStores(files, budget)

    return open_storage(
        folder,
        spec=spec,
        capacity=capacity,
        count_draws=True,
        sync_s=1e6,
        stores=stores,
    )


def kill(storage: MappedStorage) -> None:
    """Lets go of the files as the end of a process does: nothing more is written."""
    storage._syncer.close()
    for file in storage._files.values():
        file.close()
    os.close(storage._lock)
