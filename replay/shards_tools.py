"""Questions to all shards of a run, asked on the hub: counters, sync.

Each answer is a shard's own; `total` adds up what can be added up.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final

import zenoh

from replay.client import fetch_stats, sync_replay
from replay.keys import RunKeys
from replay.shards import live_shards

_ADDED: Final = (
    *("capacity", "size", "inserts", "samples", "deletes", "min_size"),
    *("insert_wait_s", "sample_wait_s", "busy_inserts", "busy_samples"),
    *("duplicates", "gaps", "refused", "stale_updates", "pending_samples"),
    *("debt", "tolerance", "insert_rate", "sample_rate", "recovered"),
    *("table_bytes", "resident_bytes", "disk_bytes"),
)

Stats = dict[str, Any]


def fetch_all_stats(
    session: zenoh.Session, keys: RunKeys, *, timeout: float = 5.0
) -> dict[int, Stats]:
    """The counters of every shard that the hub knows to be up."""
    return _ask_all(session, keys, fetch_stats, timeout)


def sync_all(
    session: zenoh.Session, keys: RunKeys, *, timeout: float = 30.0
) -> dict[int, Stats]:
    """The same, once every row that they count is on the disk."""
    return _ask_all(session, keys, sync_replay, timeout)


def _ask_all(
    session: zenoh.Session,
    keys: RunKeys,
    ask_one: Callable[..., Stats],
    timeout: float,
) -> dict[int, Stats]:
    return {
        shard: ask_one(session, RunKeys(keys.run_id, shard), timeout=timeout)
        for shard in shards_to_ask(session, keys)
    }


def shards_to_ask(session: zenoh.Session, keys: RunKeys) -> list[int]:
    """The shards that are up; the hub at least, so that its silence is an error."""
    return live_shards(session, keys) or [0]


def total(stats: Mapping[int, Stats]) -> Stats:
    """One replay's counters from its shards'; of what cannot be added, the first's.

    `writers` are all shards', those of one number one after the other.
    """
    shards = [stats[shard] for shard in sorted(stats)]
    whole = dict(shards[0])
    for name in _ADDED:
        whole[name] = sum(shard[name] for shard in shards)
    whole["samples_per_insert"] = whole["samples"] / max(1, whole["inserts"])
    whole["fault"] = next((shard["fault"] for shard in shards if shard["fault"]), "")
    if len(shards) > 1:  # the percentiles of all do not follow from each one's
        whole["ages"], whole["priorities"] = [], []
    whole["writers"] = [told for shard in shards for told in shard["writers"]]
    whole["shards"] = len(shards)
    return whole
