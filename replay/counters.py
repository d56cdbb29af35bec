"""What the service counts, and the answer to who asks."""

from dataclasses import dataclass
from typing import final

from replay.control import StatsReply, WriterStats
from replay.ledger import Ledger
from replay.local import LocalReplay
from replay.requests import HeldInsert


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


def stats_reply(
    *,
    replay: LocalReplay,
    counters: Counters,
    ledger: Ledger[HeldInsert],
    incarnation: int,
    pending_samples: int,
) -> StatsReply:
    """All counters as they are now."""
    writers = [
        WriterStats(
            writer=state.writer,
            epoch=state.epoch,
            next_sequence=state.next_sequence,
            rows=state.rows,
            pending=len(state.waiting),
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
        writers=writers,
    )
