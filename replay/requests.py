"""Requests that the service holds, and how queries are read, answered and ended."""

from dataclasses import dataclass
from typing import final

import zenoh

from replay.ledger import WriterState
from replay.wire import SampleRequest
from replay.wire_inserts import Insert


@final
@dataclass(kw_only=True, eq=False)
class HeldInsert:
    """A batch that waits for the limiter."""

    message: Insert
    query: zenoh.Query | None  # None once answered or dropped
    arrived: float
    state: WriterState["HeldInsert"]

    @property
    def deadline(self) -> float:
        """When it must be answered, `time.monotonic`."""
        return self.arrived + self.message.hold_ms / 1e3


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class HeldSample:
    """A sample request that waits for the limiter."""

    message: SampleRequest
    query: zenoh.Query
    arrived: float

    @property
    def count(self) -> int:
        """Rows asked for."""
        return self.message.batch_size * self.message.batches

    @property
    def deadline(self) -> float:
        """When it must be answered, `time.monotonic`."""
        return self.arrived + self.message.hold_ms / 1e3


def payload_of(query: zenoh.Query) -> bytes:
    """The query's payload; empty if it has none."""
    return query.payload.to_bytes() if query.payload is not None else b""


def answer(query: zenoh.Query, payload: bytes | bytearray) -> None:
    """Replies and ends the query; a sender that is gone is not an error."""
    with query:
        try:
            query.reply(query.key_expr, payload)
        except zenoh.ZError:
            pass  # it will ask again, or it was killed and its epoch is over


def end(query: zenoh.Query | None) -> None:
    """Ends a query without an answer: its sender will ask again."""
    if query is not None:
        with query:
            pass
