"""What the service counts, and the answer to who asks."""

import time
from collections import deque
from dataclasses import dataclass, field
from typing import final

import numpy as np
import psutil

from replay.control import PERCENTILES, StatsReply, WriterStats
from replay.ledger import Ledger
from replay.local import LocalReplay
from replay.requests import HeldInsert

_RATE_LOOKS = 11  # a second apart: the rates are over ten seconds


@final
@dataclass(kw_only=True)
class Counters:
    """What `StatsReply` tells beyond the table's own counters."""

    insert_wait_s: float = 0.0
    sample_wait_s: float = 0.0
    busy_inserts: int = 0
    busy_samples: int = 0
    duplicates: int = 0
    gaps: int = 0
    refused: int = 0
    began: float = field(default_factory=time.monotonic)
    recovered: int = 0  # rows found at the start
    history: deque[tuple[float, int, int]] = field(
        default_factory=lambda: deque(maxlen=_RATE_LOOKS)
    )
    """(time, inserts, samples), a look a second."""

    def look(self, replay: LocalReplay) -> None:
        """Notes the counters about once a second, for the rates."""
        now = time.monotonic()
        if not self.history or now - self.history[-1][0] >= 1.0:
            self.history.append((now, replay.inserts, replay.samples))

    def rates(self, replay: LocalReplay) -> tuple[float, float]:
        """Inserts and samples per second since the oldest look."""
        if not self.history:
            return 0.0, 0.0
        then, inserts, samples = self.history[0]
        passed = max(time.monotonic() - then, 1e-3)
        return (replay.inserts - inserts) / passed, (replay.samples - samples) / passed


def stats_reply(
    *,
    replay: LocalReplay,
    counters: Counters,
    ledger: Ledger[HeldInsert],
    incarnation: int,
    pending_samples: int,
) -> StatsReply:
    """All counters as they are now."""
    now = time.monotonic()
    insert_rate, sample_rate = counters.rates(replay)
    ages, priorities = replay.table.ages_and_priorities()
    writers = [
        WriterStats(
            writer=state.writer,
            epoch=state.epoch,
            next_sequence=state.next_sequence,
            rows=state.rows,
            pending=len(state.waiting),
            lag_s=now - max(state.stored_at, counters.began),
        )
        for state in ledger
    ]
    return StatsReply(
        incarnation=incarnation,
        schema_hash=replay.spec.schema_hash.hex(),
        capacity=replay.config.capacity,
        size=replay.size,
        inserts=replay.inserts,
        samples=replay.samples,
        deletes=replay.table.deletes,
        samples_per_insert=replay.samples_per_insert,
        configured_samples_per_insert=replay.config.samples_per_insert,
        min_size=replay.config.min_size,
        insert_wait_s=counters.insert_wait_s,
        sample_wait_s=counters.sample_wait_s,
        busy_inserts=counters.busy_inserts,
        busy_samples=counters.busy_samples,
        duplicates=counters.duplicates,
        gaps=counters.gaps,
        refused=counters.refused,
        stale_updates=replay.stale_updates,
        pending_samples=pending_samples,
        mean_priority_mass=replay.table.mean_mass(),
        durable=replay.durable is not None,
        fault=replay.fault,
        sampler=replay.config.sampler,
        max_times_sampled=replay.config.max_times_sampled,
        tolerance=replay.limiter.tolerance,
        debt=replay.limiter.debt(inserts=replay.inserts, samples=replay.samples),
        uptime_s=now - counters.began,
        insert_rate=insert_rate,
        sample_rate=sample_rate,
        ages=_percentiles(ages),
        priorities=_percentiles(priorities),
        row_bytes=replay.spec.row_bytes,
        table_bytes=replay.table.memory_bytes,
        resident_bytes=psutil.Process().memory_info().rss,
        disk_bytes=replay.durable.disk_bytes if replay.durable else 0,
        recovered=counters.recovered,
        writers=writers,
    )


def _percentiles(values: np.ndarray) -> list[float]:
    """At `PERCENTILES`; none of nothing."""
    if not len(values):
        return []
    return [float(value) for value in np.percentile(values, PERCENTILES)]
