"""The replay itself, without a network: a table and its rate limiter.

The service owns one of these; serial mode uses it directly, so that a run in one
process has the same semantics and, under a seed, the same draws every time.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Integer, UInt8

from replay.limiter import LimiterError, RateLimiter
from replay.spec import ReplayError, RowSpec, Sample
from replay.table import Table
from replay.wire import SampleReplyBuffer


@final
@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """What is kept, and how it is drawn. Defaults are Acme's DQN."""

    capacity: int = 1_000_000
    """Rows kept; the oldest are pushed out."""
    min_size: int = 1_000
    """Rows before anything is sampled."""
    samples_per_insert: float = 8.0
    """How often a row is sampled on average."""
    tolerance: float = 0.1
    """Deviation from that ratio, as a fraction of samples_per_insert * min_size."""
    priority_exponent: float = 0.6
    """Rows are drawn by priority to this power; 0 draws uniformly."""

    def __post_init__(self) -> None:
        """Refuses settings that can never be met."""
        if self.capacity < self.min_size:
            raise ReplayError(
                f"capacity={self.capacity} is below min_size={self.min_size}: the "
                "learner would wait for ever"
            )
        self.limiter()

    def limiter(self) -> RateLimiter:
        """The rate limiter of these settings."""
        return RateLimiter(
            samples_per_insert=self.samples_per_insert,
            min_size=self.min_size,
            tolerance=self.tolerance * self.samples_per_insert * self.min_size,
        )


@final
class LocalReplay:
    """Table, limiter and counters. Not thread-safe."""

    def __init__(self, *, spec: RowSpec, config: ReplayConfig, seed: int) -> None:
        """An empty replay; the seed decides what is drawn."""
        self.spec = spec
        self.config = config
        self.limiter = config.limiter()
        self.table = Table(
            capacity=config.capacity,
            spec=spec,
            priority_exponent=config.priority_exponent,
            seed=seed,
        )
        self.samples = 0
        """Rows ever sampled."""
        self.stale_updates = 0
        """Priority updates for rows that were gone."""

    @property
    def size(self) -> int:
        """Rows in the table."""
        return self.table.size

    @property
    def inserts(self) -> int:
        """Rows ever inserted."""
        return self.table.inserts

    @property
    def samples_per_insert(self) -> float:
        """The ratio so far."""
        return self.samples / max(1, self.inserts)

    def may_insert(self, n: int) -> bool:
        """Whether the limiter admits `n` more rows."""
        return self.limiter.may_insert(
            n,
            inserts=self.table.inserts,
            deletes=self.table.deletes,
            samples=self.samples,
        )

    def may_sample(self, n: int) -> bool:
        """Whether the limiter admits `n` more samples."""
        return self.limiter.may_sample(
            n,
            inserts=self.table.inserts,
            deletes=self.table.deletes,
            samples=self.samples,
        )

    def insert(self, rows: np.ndarray) -> None:
        """Stores structured rows; raises if the limiter does not admit them."""
        self.insert_bytes(self.spec.as_bytes(rows))

    def insert_bytes(self, rows: UInt8[np.ndarray, "rows row_bytes"]) -> None:
        """The same for rows as bytes."""
        if not self.may_insert(len(rows)):
            raise LimiterError(f"{len(rows)} inserts before more is sampled")
        self.table.insert(rows)

    def sample(self, batch_size: int) -> Sample:
        """One batch; raises if the limiter does not admit it."""
        buffer = self.sample_into_buffer(batch_size=batch_size, batches=1)
        return Sample(
            ids=buffer.ids,
            probabilities=buffer.probabilities,
            rows=buffer.rows.reshape(-1).view(self.spec.dtype),
            size=self.size,
            inserts=self.inserts,
        )

    def sample_into_buffer(self, *, batch_size: int, batches: int) -> SampleReplyBuffer:
        """Several batches, gathered straight into a reply."""
        count = batch_size * batches
        if not self.may_sample(count):
            raise LimiterError(f"{count} samples before more is inserted")
        buffer = SampleReplyBuffer(spec=self.spec, count=count)
        self.table.draw(
            batch_size=batch_size,
            ids=buffer.ids,
            probabilities=buffer.probabilities,
            rows=buffer.rows,
        )
        self.samples += count
        return buffer

    def update_priorities(
        self,
        ids: Integer[np.ndarray, " updates"],
        priorities: Float[np.ndarray, " priorities"],
    ) -> None:
        """Sets priorities, |TD error|; rows that are gone are skipped and counted."""
        self.stale_updates += self.table.update_priorities(
            ids, np.asarray(priorities, np.float64)
        )
