"""Rows in mapped files: what was acknowledged survives kill -9 at any instruction.

Every change goes through `state.bin`, whose layout is in `replay.records`.

The argument. A process that is killed leaves in the mapped files a prefix of its stores
in program order: the kernel keeps the pages, and one thread makes all stores. An insert
of n rows stores, in this order,

    1. `oldest`, if rows have to go: one aligned 8-byte store, so old or new;
    2. the rows, and their priorities and draw counts, into slots that hold no row that
       is counted: ids below `oldest`, or not below `inserts`;
    3. commit record g + 1 into the place of record g - 1;
    4. the writer's entry, a copy of what the record says.

A stop before the end of 3 leaves record g whole and g + 1 with a wrong checksum (or not
begun): the rows of 2 have ids that are not below `inserts`, so nothing of the batch is
visible, and the writer's sequence is that of g. A stop after it leaves g + 1 whole:
rows, `inserts` and sequence are all visible. There is no state between, because rows
and sequence are visible by the same record. A stop within 4 leaves a torn entry, which
is written again from the record on recovery; all other entries are untouched since
their own commit's step 4. The acknowledgement follows 4. So an acknowledged batch is
there, once; one that was not acknowledged is there whole with its sequence, and then
the writer's repetition is a duplicate, or absent, and then it is the next. A stop
between 1 and 3 costs the rows that were being pushed out, and no others.

Draws: counts per row, then `samples` (one 8-byte store), then the reply leaves: no row
that a learner received is uncounted. Priorities are single 4-byte stores.

After a power loss (the machine's boot id is another one and the folder was not closed
in order) pages are on the disk in any order, and the last snapshot is recovered instead
(`replay.syncing`): what was acknowledged in the last one to two `sync_s` is lost, and
up to `reserve` of the oldest rows of a full ring.
"""

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import UInt8

from replay.folder import (
    PRIORITIES,
    ROWS,
    STATE,
    SYNC,
    TIMES,
    FolderError,
    MappedFile,
    RowSpace,
    is_made,
    lock_folder,
    meta_of,
    open_files,
    write_meta,
)
from replay.records import (
    BOOT,
    BOOT_BYTES,
    CLEAN,
    COMMIT_BYTES,
    COMMITS,
    EMPTY,
    ENTRIES,
    ENTRY_BYTES,
    MAX_WRITERS,
    NO_PLACE,
    OLDEST,
    SAMPLES,
    AbstractStores,
    FileStores,
    boot_id,
    decode_commit,
    decode_entry,
    encode_commit,
    encode_entry,
)
from replay.spec import RowSpec
from replay.storage import AbstractStorage, StorageState, WriterMark
from replay.syncing import (
    HEAD_BYTES,
    Snapshot,
    Syncer,
    newest_snapshot,
    write_snapshot,
)


@final
class MappedStorage(AbstractStorage):
    """The order of the module's docstring; made by `open_storage`."""

    def __init__(
        self,
        *,
        files: Mapping[str, MappedFile],
        lock: int,
        stores: AbstractStores,
        row_bytes: int,
        sync_s: float,
        whole: bool,
    ) -> None:
        """Recovers the state of files that are complete; `whole`: with all space."""
        self._files = files
        self._lock = lock
        self._stores = stores
        self._row_bytes = row_bytes
        self._sync_s = sync_s
        self.rows = np.frombuffer(files[ROWS].map, np.uint8).reshape(-1, row_bytes)
        self.capacity = len(self.rows)
        self.priorities = np.frombuffer(files[PRIORITIES].map, "<f4")
        self.times = None
        if TIMES in files:
            self.times = np.frombuffer(files[TIMES].map, "<u4")
        self._space = RowSpace(files[ROWS], whole=whole)
        self._reserve = max(self.capacity // 4, 1)
        self.power_lost = self._came_by_power_loss()
        """Whether a snapshot had to be recovered."""
        snapshot = newest_snapshot(files[SYNC])
        if snapshot is None:
            raise FolderError(f"{files[SYNC].path}: damaged; choose another folder")
        if self.power_lost:
            self._restore(snapshot)
        self._places: dict[int, int] = {}
        self.state = self._recover()
        self._inserts, self._samples = self.state.inserts, self.state.samples
        self._oldest = self.state.oldest
        before = [file for name, file in files.items() if name != SYNC]
        self._open_for_changes()
        self._number = snapshot.number
        write_snapshot(self._snapshot(), files[SYNC], before)
        self._syncer = Syncer(files[SYNC], before, self._last)
        self._due = time.monotonic() + sync_s
        self._asked = False

    # Recovery

    def _state(self, start: int, size: int) -> bytes:
        return self._files[STATE].map[start : start + size]

    def _cell(self, offset: int) -> int:
        return int.from_bytes(self._state(offset, 8), "little")

    def _came_by_power_loss(self) -> bool:
        same = self._state(BOOT, BOOT_BYTES) == boot_id()
        return not same and self._cell(CLEAN) == 0

    def _restore(self, snapshot: Snapshot) -> None:
        """Makes the state that of the snapshot; can be repeated if it is stopped."""
        # Their slots may hold newer rows, or parts of them.
        given_up = snapshot.reserved - self.capacity
        oldest = max(snapshot.oldest, min(given_up, snapshot.inserts))
        for place in COMMITS:
            self._stores.put(STATE, place, bytes(COMMIT_BYTES))
        empty = bytes(MAX_WRITERS * ENTRY_BYTES - len(snapshot.entries))
        self._stores.put(STATE, ENTRIES, snapshot.entries + empty)
        self._stores.put64(STATE, SAMPLES, snapshot.samples)
        self._stores.put64(STATE, OLDEST, oldest)
        record = encode_commit(1, snapshot.inserts, NO_PLACE, EMPTY)
        self._stores.put(STATE, COMMITS[1], record)

    def _recover(self) -> StorageState:
        """The newest whole commit, and its writer's entry written again."""
        found = [decode_commit(self._state(p, COMMIT_BYTES)) for p in COMMITS]
        whole = [record for record in found if record is not None]
        if not whole:
            raise FolderError(
                f"{self._files[STATE].path}: damaged: no whole commit; restore the "
                "file, or choose another folder"
            )
        self._generation, inserts, place, entry = max(whole)
        if place != NO_PLACE:
            self._stores.put(STATE, ENTRIES + place * ENTRY_BYTES, entry)
        marks = []
        for place in range(MAX_WRITERS):
            entry = self._state(ENTRIES + place * ENTRY_BYTES, ENTRY_BYTES)
            if entry == EMPTY:
                break
            mark = decode_entry(entry)
            if mark is None:
                raise FolderError(
                    f"{self._files[STATE].path}: damaged: writer {place} is not whole; "
                    "restore the file, or choose another folder"
                )
            self._places[mark.writer] = place
            marks.append(mark)
        # A stop in the middle of an insert may have pushed rows out for nothing.
        oldest = max(self._cell(OLDEST), inserts - self.capacity)
        return StorageState(
            inserts=inserts,
            oldest=min(oldest, inserts),
            samples=self._cell(SAMPLES),
            writers=tuple(marks),
        )

    def _open_for_changes(self) -> None:
        """From here on the folder is not one that was closed in order."""
        self._stores.put(STATE, BOOT, boot_id())
        self._stores.put64(STATE, CLEAN, 0)
        # On the disk before any row is: or a power loss would take the rows that are
        # written next for those that were there at the orderly end.
        self._files[STATE].sync()

    # Changes

    def admits(self, count: int, *, inserts: int) -> bool:
        """Whether there is room, and the last snapshot allows to write so far."""
        self.tend()
        limit = self._syncer.durable.reserved
        if inserts + count > limit:
            self._reserve = max(self._reserve, count)
            self._asked = True
            self.tend()
            return False
        if self._syncer.error:
            return False
        last = min(inserts + count, self.capacity)
        return self._space.reach(last * self._row_bytes)

    def evict(self, oldest: int) -> None:
        """Step 1."""
        self._oldest = oldest
        self._stores.put64(STATE, OLDEST, oldest)

    def write_rows(self, slot: int, rows: UInt8[np.ndarray, "rows row_bytes"]) -> None:
        """Step 2."""
        data = np.ascontiguousarray(rows).reshape(-1).data
        self._stores.put(ROWS, slot * self._row_bytes, data)

    def commit(self, inserts: int, mark: WriterMark | None) -> None:
        """Steps 3 and 4."""
        place, entry = NO_PLACE, EMPTY
        if mark is not None:
            place = self._places.get(mark.writer, len(self._places))
            if place >= MAX_WRITERS:
                raise FolderError(
                    f"writer {mark.writer}: a replay service has at most {MAX_WRITERS}"
                )
            entry = encode_entry(mark)
        generation = self._generation + 1
        record = encode_commit(generation, inserts, place, entry)
        self._stores.put(STATE, COMMITS[generation % 2], record)
        self._generation, self._inserts = generation, inserts
        if mark is not None:
            self._stores.put(STATE, ENTRIES + place * ENTRY_BYTES, entry)
            self._places[mark.writer] = place

    def count_samples(self, samples: int) -> None:
        """See the base class."""
        self._samples = samples
        self._stores.put64(STATE, SAMPLES, samples)

    # Snapshots

    @property
    def fault(self) -> str:
        """Why nothing can be stored at present; empty if it can."""
        return self._syncer.error or self._space.fault

    @property
    def disk_bytes(self) -> int:
        """Of all files."""
        return sum(file.size for file in self._files.values())

    @property
    def synced(self) -> int:
        """The number of the newest snapshot on the disk."""
        return self._syncer.durable.number

    def ask_sync(self) -> int:
        """Wants a snapshot of now; the number that `synced` will then have reached."""
        self._asked = True
        self.tend()
        # One that was taken before and is still on its way is not enough.
        return self._number + 1 if self._asked else self._number

    def tend(self) -> None:
        """Starts the snapshot that is due; costs next to nothing otherwise."""
        now = time.monotonic()
        if self._syncer.busy or (self._syncer.error and now < self._due):
            return
        low = self._syncer.durable.reserved - self._inserts < self._reserve // 2
        if self._asked or low or now >= self._due:
            self._asked = False
            self._due = now + self._sync_s
            self._syncer.start(self._snapshot())

    def sync(self) -> None:
        """Has all of now on the disk, unless that has a fault."""
        self._syncer.wait()
        self._asked = True
        self.tend()
        self._syncer.wait()

    def wait(self) -> None:
        """Until what is on its way to the disk is there."""
        self._syncer.wait()

    def _snapshot(self) -> Snapshot:
        self._number += 1
        self._last = Snapshot(
            number=self._number,
            inserts=self._inserts,
            oldest=self._oldest,
            samples=self._samples,
            reserved=self._inserts + self._reserve,
            entries=self._state(ENTRIES, len(self._places) * ENTRY_BYTES),
        )
        return self._last

    def close(self) -> None:
        """Writes everything to the disk and lets the folder go."""
        self._syncer.wait()
        self._syncer.start(self._snapshot())
        self._syncer.wait()
        self._syncer.close()
        if not self._syncer.error:
            self._stores.put64(STATE, CLEAN, 1)
            self._files[STATE].sync()
        for file in self._files.values():
            file.close()
        os.close(self._lock)


def open_storage(
    folder: Path,
    *,
    spec: RowSpec,
    capacity: int,
    count_draws: bool,
    sync_s: float = 5.0,
    preallocate: bool = True,
    stores: Callable[[Mapping[str, MappedFile]], AbstractStores] = FileStores,
) -> MappedStorage:
    """Takes up the replay in the folder, or makes an empty one there."""
    lock = lock_folder(folder)
    try:
        meta = meta_of(spec, capacity)
        made = is_made(folder, meta)
        sizes = {
            ROWS: capacity * spec.row_bytes,
            PRIORITIES: capacity * 4,
            STATE: ENTRIES + MAX_WRITERS * ENTRY_BYTES,
            SYNC: 2 * (HEAD_BYTES + MAX_WRITERS * ENTRY_BYTES),
        }
        if count_draws:
            sizes[TIMES] = capacity * 4
        else:
            (folder / TIMES).unlink(missing_ok=True)  # it would not be kept up to date
        files = open_files(folder, sizes, fresh=not made, preallocate=preallocate)
        made_stores = stores(files)
        if not made:
            _begin(files, folder, meta, made_stores)
        return MappedStorage(
            files=files,
            lock=lock,
            stores=made_stores,
            row_bytes=spec.row_bytes,
            sync_s=sync_s,
            whole=preallocate,
        )
    except BaseException:
        os.close(lock)
        raise


def _begin(
    files: Mapping[str, MappedFile],
    folder: Path,
    meta: Mapping[str, object],
    stores: AbstractStores,
) -> None:
    """Commit 1 and snapshot 1 of an empty replay; then the folder is complete."""
    stores.put(STATE, COMMITS[1], encode_commit(1, 0, NO_PLACE, EMPTY))
    stores.put(STATE, BOOT, boot_id())
    first = Snapshot(number=1, inserts=0, oldest=0, samples=0, reserved=0, entries=b"")
    others = [file for name, file in files.items() if name != SYNC]
    write_snapshot(first, files[SYNC], others)
    write_meta(folder, meta)
