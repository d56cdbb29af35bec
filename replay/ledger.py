"""Which batch of a writer comes next: the service's half of go-back-N.

Pure bookkeeping: no network, no clock. Per writer it keeps the epoch, the sequence
that will be stored next and the batches that wait for the rate limiter, in order.

A batch (epoch, sequence, base) of a writer of which `waiting` batches wait is

    of an older epoch             STALE: a newer process writes under this number
    of this epoch, another life   FOREIGN: a second process claims the number
    of a newer or first epoch     taken up at `base`; what waited is dropped
    based above next + waiting    the same: a former life of the service, whose rows
                                  are gone, acknowledged what is below
    below `next_sequence`         DUPLICATE: stored, so acknowledged again
    waiting already               REPLACES: the writer no longer listens for the
                                  answer to the earlier copy
    next_sequence + waiting       NEXT: waits for the limiter behind the others
    above that                    GAP

and of a writer that is not known, when there are as many as there may be, FULL.
"""

import enum
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar, final

T = TypeVar("T")


class Verdict(enum.Enum):
    """What a batch is."""

    NEXT = enum.auto()
    REPLACES = enum.auto()
    DUPLICATE = enum.auto()
    GAP = enum.auto()
    STALE = enum.auto()
    FOREIGN = enum.auto()
    FULL = enum.auto()


@final
@dataclass(kw_only=True)
class WriterState(Generic[T]):
    """One writer, as the service sees it."""

    writer: int
    epoch: int
    next_sequence: int
    life: int  # of the process that writes
    rows: int = 0  # stored, of all epochs
    stored_at: float = 0.0  # when its last batch was, by the caller's clock
    waiting: deque[T] = field(default_factory=deque)  # from next_sequence on

    @property
    def expected(self) -> int:
        """The sequence that would be taken in next."""
        return self.next_sequence + len(self.waiting)


@final
class Ledger(Generic[T]):
    """All writers. T is what waits: a batch with its query."""

    def __init__(self, most: int = 1 << 32) -> None:
        """Knows nobody yet; takes up at most `most` writers."""
        self._most = most
        self._writers: dict[int, WriterState[T]] = {}
        self.dropped: deque[T] = deque()
        """What waited and will not be stored; the caller lets go of the queries."""

    def restore(self, state: WriterState[T]) -> None:
        """Takes up a writer where a former life of the service left it."""
        self._writers[state.writer] = state

    def __iter__(self) -> Iterator[WriterState[T]]:
        """All writers, in the order of their numbers."""
        return iter(sorted(self._writers.values(), key=lambda state: state.writer))

    def judge(
        self, *, writer: int, epoch: int, sequence: int, base: int, life: int = 0
    ) -> tuple[Verdict, WriterState[T]]:
        """What the batch is; takes up new writers, epochs and bases."""
        state = self._writers.get(writer)
        if state is None:
            state = WriterState(
                writer=writer, epoch=epoch, next_sequence=base, life=life
            )
            if len(self._writers) >= self._most:
                return Verdict.FULL, state
            self._writers[writer] = state
        if epoch < state.epoch:
            return Verdict.STALE, state
        if epoch == state.epoch and life != state.life:
            return Verdict.FOREIGN, state
        if epoch > state.epoch or base > state.expected:
            self.dropped.extend(state.waiting)
            state.waiting.clear()
            state.epoch, state.next_sequence, state.life = epoch, base, life
        if sequence < state.next_sequence:
            return Verdict.DUPLICATE, state
        if sequence < state.expected:
            return Verdict.REPLACES, state
        return (Verdict.NEXT if sequence == state.expected else Verdict.GAP), state

    def stored(self, state: WriterState[T], rows: int, now: float = 0.0) -> None:
        """The first waiting batch is in the table."""
        state.stored_at = now
        state.waiting.popleft()
        state.next_sequence += 1
        state.rows += rows
