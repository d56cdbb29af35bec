"""The clients' side: the writer, the sampler, and the questions to a service.

Nothing here imports torch: an actor or a viewer does without it.
"""

from collections.abc import Iterator
from typing import Any

import msgspec
import zenoh

from replay.control import StatsReply, decode
from replay.keys import RunKeys
from replay.sampler import Sampler
from replay.session import ask
from replay.spec import ReplayTimeout, RowSpec, Sample
from replay.wire import (
    FetchRequest,
    SampleReply,
    WireError,
)
from replay.writer import Writer

__all__ = [
    "ReplayTimeout",
    "Sampler",
    "Writer",
    "fetch_rows",
    "fetch_stats",
    "sync_replay",
]


def fetch_stats(
    session: zenoh.Session, keys: RunKeys, *, timeout: float = 5.0
) -> dict[str, Any]:
    """The service's counters, by the names of `replay.control.StatsReply`."""
    payload = ask(session, keys.stats, timeout_s=timeout)
    if payload is None:
        raise ReplayTimeout(
            f"no answer from {keys.stats} within {timeout:g} s; is the replay service "
            "up?"
        )
    stats: dict[str, Any] = msgspec.to_builtins(decode(payload, StatsReply))
    return stats


def sync_replay(
    session: zenoh.Session, keys: RunKeys, *, timeout: float = 30.0
) -> dict[str, Any]:
    """The service's counters, once every row that they count is on the disk.

    A service that keeps its rows in memory answers at once.
    """
    payload = ask(session, keys.sync, timeout_s=timeout)
    if payload is None:
        raise ReplayTimeout(f"no answer from {keys.sync} within {timeout:g} s")
    stats: dict[str, Any] = msgspec.to_builtins(decode(payload, StatsReply))
    return stats


def fetch_rows(
    *,
    session: zenoh.Session,
    keys: RunKeys,
    spec: RowSpec,
    first_id: int = 0,
    page_rows: int = 4096,
    timeout: float = 10.0,
) -> Iterator[Sample]:
    """Every row still in the table, in pages, by ascending id from `first_id`."""
    while True:
        request = FetchRequest(first_id=first_id, limit=page_rows).encode(spec)
        payload = ask(session, keys.fetch, request, timeout_s=timeout)
        if payload is None:
            raise ReplayTimeout(f"no answer from {keys.fetch} within {timeout:g} s")
        reply = SampleReply.decode(payload, spec)
        if reply.sample is None:
            raise WireError(f"replay refused to hand out rows: {reply.reason}")
        ids = reply.sample.ids
        if len(ids) == 0:
            return
        if int(ids[0]) < first_id or (ids[1:] <= ids[:-1]).any():
            raise WireError(f"replay handed out ids out of order, from {ids[0]} on")
        yield reply.sample
        first_id = int(reply.sample.ids[-1]) + 1
