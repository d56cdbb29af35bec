"""Rows that a sampler keeps, so that a stream brings each of them once.

A row is drawn several times before it is pushed out (eight, as the paper has it), and a
sampler on another machine would be sent it each time. Instead it keeps what it was sent
in a ring like the service's, at the same slots: a row's id modulo the capacity. The
service notes for each connection which slots it has sent since they were last written,
and a body then has the ids and probabilities of all rows drawn and the bytes of those
that the sampler lacks, each once, in the order in which they appear.

Nothing is negotiated row by row. A connection brings what was put into it, in order,
or ends: so what the service has put into it the sampler has, or will have before it
reads a body that counts on it. What is drawn is in the table, so the slot of a row
drawn holds no later row on either side. A new connection begins with nothing. The
sampler looks at the id in every slot all the same, and at the number of rows that came;
if one is not as it should be the stream ends, and with it whatever was wrong.
"""

import mmap
import sys
from contextlib import suppress
from typing import Final, final

import numpy as np
from jaxtyping import Int64, UInt8, UInt64

MAX_MIRROR_BYTES: Final = 1 << 30  # a sampler that would need more is sent every row


def may_mirror(capacity: int, row_bytes: int) -> bool:
    """Whether a sampler of so large a table keeps rows."""
    return 0 < capacity * row_bytes <= MAX_MIRROR_BYTES


def _zeros(size: int) -> UInt8[np.ndarray, " size"]:
    """Bytes in pages of their own, which the system has back when they are let go of.

    malloc would keep them: once a block was freed, later ones of its size, up to 32 MB,
    are cut from the heap of the thread that asks, and each connection is another one.
    The soak found 17 MB more in a reader for each time that its service was killed.
    """
    if sys.platform != "linux":
        return np.zeros(size, np.uint8)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # not every kernel has them; numpy asks for them as well
        memory.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(memory, np.uint8)


def _first_of_each(
    slots: Int64[np.ndarray, " rows"], lacking: Int64[np.ndarray, " lacking"]
) -> Int64[np.ndarray, " new"]:
    """Of the positions `lacking`, the first one of every slot, in order."""
    _, first = np.unique(slots[lacking], return_index=True)
    return lacking[np.sort(first)]


@final
class SentRows:
    """The service's side: which rows a connection has been given. One byte a slot."""

    def __init__(self, capacity: int) -> None:
        """None yet."""
        self._sent = np.zeros(capacity, bool)
        self._inserts = 0

    def unsent(
        self, ids: UInt64[np.ndarray, " rows"], inserts: int
    ) -> Int64[np.ndarray, " new"]:
        """Where in `ids` a row is that was not sent; from now on it counts as sent.

        `ids` are in the table now; `inserts`: rows ever inserted.
        """
        capacity = len(self._sent)
        # Slots written since the last look hold other rows now.
        first = max(self._inserts, inserts - capacity)
        start, count = first % capacity, inserts - first
        self._sent[start : start + count] = False
        self._sent[: max(0, start + count - capacity)] = False
        self._inserts = inserts
        slots = (ids % np.uint64(capacity)).astype(np.int64)
        new = _first_of_each(slots, np.flatnonzero(~self._sent[slots]))
        self._sent[slots[new]] = True
        return new


@final
class Mirror:
    """The sampler's side: a ring of the rows that came; takes memory as they do."""

    def __init__(self, *, capacity: int, row_bytes: int) -> None:
        """Empty."""
        self._rows = _zeros(capacity * row_bytes).reshape(capacity, row_bytes)
        self._held = _zeros(8 * capacity).view(np.uint64)  # id + 1; 0: nothing
        self.kept = 0
        """Rows that ever came."""

    def keep(
        self,
        ids: UInt64[np.ndarray, " rows"],
        rows: UInt8[np.ndarray, "new row_bytes"],
    ) -> bool:
        """Takes the rows that were lacking; False if they are not as many."""
        slots = self._slots(ids)
        lacking = np.flatnonzero(self._held[slots] != ids + np.uint64(1))
        new = _first_of_each(slots, lacking)
        if len(new) != len(rows):
            return False
        self._rows[slots[new]] = rows
        self._held[slots[new]] = ids[new] + np.uint64(1)
        self.kept += len(new)
        # Two ids of one slot cannot both be there.
        return bool((self._held[slots] == ids + np.uint64(1)).all())

    def gather(
        self,
        ids: UInt64[np.ndarray, " rows"],
        out: UInt8[np.ndarray, "rows row_bytes"],
    ) -> None:
        """Copies the rows of these ids, all of which have been kept."""
        np.take(self._rows, self._slots(ids), axis=0, out=out, mode="clip")

    def _slots(self, ids: UInt64[np.ndarray, " rows"]) -> Int64[np.ndarray, " rows"]:
        return (ids % np.uint64(len(self._rows))).astype(np.int64)
