"""The replay itself, without a network: a table and its rate limiter.

The service owns one of these; serial mode uses it directly, so that a run in one
process has the same semantics and, under a seed, the same draws every time.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float, Integer, UInt8

from replay.limiter import LimiterError, RateLimiter
from replay.mapped import MappedStorage, open_storage
from replay.mirror import SentRows
from replay.selectors import SamplerName
from replay.spec import ReplayError, RowSpec, Sample
from replay.storage import AbstractStorage, MemoryStorage, WriterMark
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
    sampler: SamplerName = "prioritized"
    """How rows are drawn: by priority, uniform(ly), or always the oldest (fifo)."""
    max_times_sampled: int = 0
    """A row is removed once it was drawn so often; 0 is no limit."""
    durable: bool = False
    """Keep the rows in files of the run's folder: nothing stored is lost when the
    service is killed, and a resumed run goes on with them."""
    sync_s: float = 5.0
    """Seconds between two writes to the disk; a power loss costs up to twice that."""
    preallocate: bool = True
    """Take the disk space of the whole capacity at the start. Otherwise as the table
    fills: then a full disk stops inserts until there is room."""

    def __post_init__(self) -> None:
        """Refuses settings that can never be met."""
        if self.capacity < self.min_size:
            raise ReplayError(
                f"capacity={self.capacity} is below min_size={self.min_size}: the "
                "learner would wait for ever"
            )
        if self.sampler == "fifo" and not self.max_times_sampled:
            raise ReplayError(
                "sampler=fifo without max_times_sampled would draw the oldest row for "
                "ever; set how often a row is drawn before it is removed, e.g. 1"
            )
        if not 0 < self.sync_s < float("inf"):
            raise ReplayError(f"sync_s={self.sync_s} must be above 0 and finite")
        self.limiter()

    def limiter(self) -> RateLimiter:
        """The rate limiter of these settings."""
        return RateLimiter(
            samples_per_insert=self.samples_per_insert,
            min_size=self.min_size,
            tolerance=self.tolerance * self.samples_per_insert * self.min_size,
            max_times_sampled=self.max_times_sampled,
            capacity=self.capacity,
        )

    def part_of(self, shards: int, shard: int = 0) -> "ReplayConfig":
        """The settings of one of so many shards.

        Capacity and minimum are shared out; the first shards have room for what is
        left over. The limiter's tolerance, in samples, is not shared out: each shard
        has to let the same batches pass as one table would.
        """
        capacity, rest = divmod(self.capacity, shards)
        min_size = max(1, self.min_size // shards)
        return replace(
            self,
            capacity=max(1, capacity + (shard < rest)),
            min_size=min_size,
            tolerance=self.tolerance * self.min_size / min_size,
        )


@final
class LocalReplay:
    """Table, limiter and counters. Not thread-safe."""

    def __init__(
        self,
        *,
        spec: RowSpec,
        config: ReplayConfig,
        seed: int,
        folder: Path | None = None,
    ) -> None:
        """What `folder` holds if the configuration is durable, else an empty replay.

        The seed decides what is drawn.
        """
        self.spec = spec
        self.config = config
        self.limiter = config.limiter()
        self._storage = _storage_of(spec=spec, config=config, folder=folder)
        state = self._storage.state
        self.table = Table(
            capacity=config.capacity,
            spec=spec,
            priority_exponent=config.priority_exponent,
            # A life that goes on draws something else than the one before.
            seed=np.random.SeedSequence([seed, state.samples])
            if state.inserts
            else seed,
            sampler=config.sampler,
            max_times_sampled=config.max_times_sampled,
            storage=self._storage,
        )
        self.samples = state.samples
        """Rows ever sampled."""
        self.stale_updates = 0
        """Priority updates for rows that were gone."""

    @property
    def writers(self) -> tuple[WriterMark, ...]:
        """Where the writers stood when the storage was opened."""
        return self._storage.state.writers

    @property
    def durable(self) -> MappedStorage | None:
        """The storage that outlives the process, if it does."""
        return self._storage if isinstance(self._storage, MappedStorage) else None

    @property
    def fault(self) -> str:
        """Why nothing can be stored at present; empty if it can."""
        return self._storage.fault

    def close(self) -> None:
        """Writes everything to the disk and lets go of the folder."""
        if isinstance(self._storage, MappedStorage):
            self._storage.close()

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
        """Whether the limiter admits `n` more rows, and there is room for them."""
        admitted = self.limiter.may_insert(
            n,
            inserts=self.table.inserts,
            deletes=self.table.deletes,
            samples=self.samples,
        )
        return admitted and self._storage.admits(n, inserts=self.table.inserts)

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
        if self.durable and not self.may_insert(len(rows)):
            self.durable.wait()  # it may be the disk that does not admit them yet
        self.insert_bytes(self.spec.as_bytes(rows))

    def insert_bytes(
        self,
        rows: UInt8[np.ndarray, "rows row_bytes"],
        mark: WriterMark | None = None,
    ) -> None:
        """The same for rows as bytes, and where their writer stands with them."""
        if not self.may_insert(len(rows)):
            raise LimiterError(
                self.fault or f"{len(rows)} inserts before more is sampled"
            )
        self.table.insert(rows, mark)

    def sample(self, batch_size: int) -> Sample:
        """One batch; raises if the limiter does not admit it."""
        buffer = self.sample_into_buffer(batch_size=batch_size, batches=1)
        return Sample(
            ids=buffer.ids,
            probabilities=buffer.probabilities,
            rows=buffer.rows.reshape(-1).view(self.spec.dtype),
            size=self.size,
            inserts=self.inserts,
            mass=self.table.mass(),
        )

    def sample_into_buffer(
        self,
        *,
        batch_size: int,
        batches: int,
        payload: bytearray | None = None,
        place: memoryview | None = None,
        sent: SentRows | None = None,
    ) -> SampleReplyBuffer:
        """Several batches, gathered straight into a reply (see `SampleReplyBuffer`).

        Without the rows that have been `sent`.
        """
        count = batch_size * batches
        if not self.may_sample(count):
            raise LimiterError(f"{count} samples before more is inserted")
        buffer = SampleReplyBuffer(
            spec=self.spec, count=count, payload=payload, place=place
        )
        self.table.draw(
            batch_size=batch_size,
            ids=buffer.ids,
            probabilities=buffer.probabilities,
        )
        wanted = buffer.ids
        if sent is not None:
            wanted = wanted[sent.unsent(wanted, self.inserts)]
            buffer.leave_out(count - len(wanted))
        self.table.gather(wanted, buffer.rows)
        self.samples += count
        self._storage.count_samples(self.samples)
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


def _storage_of(
    *, spec: RowSpec, config: ReplayConfig, folder: Path | None
) -> AbstractStorage:
    """Mapped files if the configuration is durable, else memory."""
    if not config.durable:
        return MemoryStorage(
            capacity=config.capacity,
            row_bytes=spec.row_bytes,
            count_draws=config.max_times_sampled > 0,
        )
    if folder is None:
        raise ReplayError("a durable replay needs a folder")
    return open_storage(
        folder,
        spec=spec,
        capacity=config.capacity,
        count_draws=config.max_times_sampled > 0,
        sync_s=config.sync_s,
        preallocate=config.preallocate,
    )
