"""The files of a durable replay: made, checked, locked and mapped.

    meta.json        format, capacity, row layout; written last, so a folder that has
                     one is complete
    rows.bin         the ring, capacity x row bytes
    priorities.bin   float32 per slot
    times.bin        uint32 per slot, where draws are counted
    state.bin        counters and writers, see `replay.mapped`
    sync.bin         two snapshots of that, see `replay.syncing`
    lock             held by the one service that uses the folder

All sizes are fixed. Disk space is taken when the folder is opened, so that a full disk
cannot hit later; only the rows' can be taken as they fill (`RowSpace`).
"""

import errno
import fcntl
import json
import mmap
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

from replay.spec import ReplayError, RowSpec

FORMAT = 2  # 1 had float64 priorities
META = "meta.json"
LOCK = "lock"
ROWS = "rows.bin"
PRIORITIES = "priorities.bin"
TIMES = "times.bin"
STATE = "state.bin"
SYNC = "sync.bin"
_RETRY_S = 0.5  # between two attempts to get room on a full disk
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class FolderError(ReplayError):
    """A folder cannot be used; one line says which, why and what to do."""


def lock_folder(folder: Path) -> int:
    """Makes and locks the folder; the lock ends with the descriptor or the process."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise FolderError(
            f"{folder}: cannot keep the replay here: {error.strerror}"
        ) from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise FolderError(
            f"{folder}: another replay service uses this folder; stop it, or choose "
            "another folder"
        ) from None
    return descriptor


def meta_of(spec: RowSpec, capacity: int) -> dict[str, Any]:
    """What `meta.json` says of a replay."""
    return {
        "format": FORMAT,
        "capacity": capacity,
        "row_bytes": spec.row_bytes,
        "schema_hash": spec.schema_hash.hex(),
        "fields": [[f.name, f.dtype, list(f.shape)] for f in spec.fields],
    }


def is_made(folder: Path, expected: Mapping[str, Any]) -> bool:
    """Whether the folder holds a replay; raises if it is not the expected one."""
    path = folder / META
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError:
        return False
    except ValueError:
        found = None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        version = found.get("format") if isinstance(found, dict) else None
        raise FolderError(
            f"{path}: replay format {version}, this version reads {FORMAT}; use the "
            "version that wrote it, or another folder"
        )
    for name in ("capacity", "row_bytes", "schema_hash"):
        if found.get(name) != expected[name]:
            raise FolderError(
                f"{folder}: holds a replay of {name} {found.get(name)}, this run has "
                f"{expected[name]}; give the settings that it was made with, or "
                "another folder"
            )
    return True


def write_meta(folder: Path, meta: Mapping[str, Any]) -> None:
    """Declares the folder complete."""
    partial = folder / f".{META}.partial"
    with partial.open("w") as file:
        json.dump(meta, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, folder / META)
    descriptor = os.open(folder, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


@final
class MappedFile:
    """A file of fixed size, mapped for reading and writing."""

    def __init__(self, path: Path, size: int, *, fresh: bool) -> None:
        """Opens it; `fresh` empties it first, else its size must be right."""
        self.path = path
        self.size = size
        flags = os.O_RDWR | os.O_CREAT | (os.O_TRUNC if fresh else 0)
        try:
            self.descriptor = os.open(path, flags, 0o644)
            found = os.fstat(self.descriptor).st_size
            if found == 0:  # new, or a column that was not kept before
                os.ftruncate(self.descriptor, size)
            elif found != size:
                raise FolderError(
                    f"{path}: {found} bytes and not {size}; the file is damaged: "
                    "restore it, or choose another folder"
                )
            self.map = mmap.mmap(self.descriptor, size)
        except OSError as error:
            raise FolderError(f"{path}: cannot be mapped: {error.strerror}") from None

    def allocate(self, start: int, stop: int) -> None:
        """Takes disk space for a range; `OSError` if there is none."""
        os.posix_fallocate(self.descriptor, start, stop - start)

    def sync(self) -> None:
        """Writes what has changed to the disk; lets other threads run meanwhile."""
        os.fdatasync(self.descriptor)

    def close(self) -> None:
        """Closes the descriptor; the mapping ends with the last array on it."""
        os.close(self.descriptor)


def open_files(
    folder: Path, sizes: Mapping[str, int], *, fresh: bool, preallocate: bool
) -> dict[str, MappedFile]:
    """Opens all files and takes their space, the rows' only with `preallocate`."""
    files = {
        name: MappedFile(folder / name, size, fresh=fresh)
        for name, size in sizes.items()
    }
    for name, file in files.items():
        if name == ROWS and not preallocate:
            continue
        try:
            file.allocate(0, file.size)
        except OSError as error:
            status = os.statvfs(folder)
            free = status.f_bavail * status.f_frsize
            raise FolderError(
                f"{folder}: the replay needs {sum(sizes.values()) / 1e6:.1f} MB on the "
                f"disk, {free / 1e6:.1f} MB more are free ({error.strerror}); free "
                "space, lower --replay.capacity, or choose another folder"
            ) from None
    return files


@final
class RowSpace:
    """Disk space for the rows, taken in steps as the table fills."""

    def __init__(self, file: MappedFile, *, whole: bool) -> None:
        """`whole`: all of it is there already."""
        self._file = file
        self._taken = file.size if whole else 0
        self._step = min(64 << 20, max(1 << 18, file.size // 16))
        self._retry_at = 0.0
        self.fault = ""
        """Why there is no room; empty if there is."""

    def reach(self, stop: int) -> bool:
        """Whether the first `stop` bytes have space; on a full disk it tries again."""
        if stop <= self._taken:
            return True
        if self.fault and time.monotonic() < self._retry_at:
            return False
        # A step ahead if it can be had, else what is needed now.
        for wanted in (min(stop + self._step, self._file.size), stop):
            try:
                self._file.allocate(self._taken, wanted)
            except OSError as error:
                if error.errno not in _NO_ROOM:
                    raise
                self.fault = (
                    f"{self._file.path}: no room for more rows ({error.strerror}); "
                    "inserts go on when there is"
                )
                self._retry_at = time.monotonic() + _RETRY_S
            else:
                self._taken, self.fault = wanted, ""
                return True
        return False
