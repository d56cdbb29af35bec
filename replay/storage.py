"""Where a table's rows lie: in memory, or in mapped files (`replay.mapped`).

A table changes its storage in a fixed order, which is what makes the mapped one
recoverable: `evict`, `write_rows` (and the columns beside the rows), `commit`.
"""

import abc
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, UInt8, UInt32


@final
@dataclass(frozen=True, kw_only=True)
class WriterMark:
    """Where a writer stands once a batch of it is stored."""

    writer: int
    epoch: int
    next_sequence: int
    rows: int  # stored from all its epochs, this batch included
    life: int  # tells two processes of one epoch apart


@final
@dataclass(frozen=True, kw_only=True)
class StorageState:
    """What a table begins with: all zero unless it was recovered."""

    inserts: int = 0
    oldest: int = 0  # id of the oldest row that is kept
    samples: int = 0
    writers: tuple[WriterMark, ...] = ()


class AbstractStorage(abc.ABC):
    """Rows and the columns beside them, by slot. Owned by one thread."""

    rows: UInt8[np.ndarray, "capacity row_bytes"]
    priorities: Float[np.ndarray, " capacity"] | None  # None: kept by the tree alone
    times: UInt32[np.ndarray, " capacity"] | None  # drawn so often; None: not counted
    state: StorageState  # at the start

    @abc.abstractmethod
    def admits(self, count: int, *, inserts: int) -> bool:
        """Whether `count` rows after `inserts` can be stored now."""

    @abc.abstractmethod
    def evict(self, oldest: int) -> None:
        """Rows below this id are gone; their slots may be overwritten."""

    @abc.abstractmethod
    def write_rows(self, slot: int, rows: UInt8[np.ndarray, "rows row_bytes"]) -> None:
        """Writes rows that are not in the table yet, from a slot on, no wrap."""

    @abc.abstractmethod
    def commit(self, inserts: int, mark: WriterMark | None) -> None:
        """The rows below id `inserts` are in the table, and their writer stands so."""

    @abc.abstractmethod
    def count_samples(self, samples: int) -> None:
        """So many rows have ever been drawn."""

    @property
    @abc.abstractmethod
    def fault(self) -> str:
        """Why nothing can be stored at present; empty if it can."""


@final
class MemoryStorage(AbstractStorage):
    """Nothing outlives the process."""

    def __init__(self, *, capacity: int, row_bytes: int, count_draws: bool) -> None:
        """Memory is taken page by page as the table fills."""
        self.rows = np.zeros((capacity, row_bytes), np.uint8)
        self.priorities = None
        self.times = np.zeros(capacity, np.uint32) if count_draws else None
        self.state = StorageState()

    def admits(self, count: int, *, inserts: int) -> bool:
        """Always."""
        return True

    def evict(self, oldest: int) -> None:
        """The table knows."""

    def write_rows(self, slot: int, rows: UInt8[np.ndarray, "rows row_bytes"]) -> None:
        """See the base class."""
        self.rows[slot : slot + len(rows)] = rows

    def commit(self, inserts: int, mark: WriterMark | None) -> None:
        """The table knows."""

    def count_samples(self, samples: int) -> None:
        """The table's owner knows."""

    @property
    def fault(self) -> str:
        """There is none."""
        return ""
