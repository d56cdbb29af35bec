"""The small messages, in msgpack: counters, status, the call to stop, files.

Each is a tagged frozen struct with the wire's version; unknown fields, wrong types and
truncated payloads are refused. Speed does not matter here: a handful a second.
"""

from typing import Annotated, TypeVar, final

import msgspec

from replay.wire import WIRE_VERSION, WireError

Count = Annotated[int, msgspec.Meta(ge=0)]
Value = float | int | str


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What all of them carry."""

    version: int = WIRE_VERSION


MessageT = TypeVar("MessageT", bound=Message)


PERCENTILES = (0, 5, 25, 50, 75, 95, 100)


@final
class WriterStats(Message, frozen=True, kw_only=True):
    """What the service knows of one writer."""

    writer: Count
    epoch: Count  # of its current process
    next_sequence: Count  # the one that will be accepted next
    rows: Count  # stored from all its epochs
    pending: Count  # batches waiting for the limiter
    lag_s: float  # since its last batch was stored, or since the service started


@final
class StatsReply(Message, frozen=True, kw_only=True, tag=True):
    """The service's counters since it started."""

    incarnation: Count  # of the service's process
    schema_hash: str  # hexadecimal
    capacity: Count  # rows
    size: Count  # rows in the table now
    inserts: Count  # rows
    samples: Count  # rows
    deletes: Count  # rows pushed out by newer ones
    samples_per_insert: float  # samples / inserts; 0 before there are any
    configured_samples_per_insert: float
    min_size: Count
    insert_wait_s: float  # total time that batches were held by the limiter
    sample_wait_s: float
    busy_inserts: Count  # requests answered "busy"
    busy_samples: Count
    duplicates: Count  # batches acknowledged again
    gaps: Count  # batches refused because an earlier one is missing
    refused: Count  # requests that can never be accepted
    stale_updates: Count  # priorities for rows that were gone
    pending_samples: Count
    mean_priority_mass: float  # of the rows in the table
    durable: bool  # rows outlive the service's process
    fault: str  # why nothing can be stored at present; empty if it can
    sampler: str
    max_times_sampled: Count
    tolerance: float  # samples
    debt: float  # samples that the inserted rows still allow; 0 at the exact ratio
    uptime_s: float
    insert_rate: float  # rows/s, over the last ten seconds
    sample_rate: float
    ages: list[float]  # rows inserted since; at `PERCENTILES`, of 4096 rows at most
    priorities: list[float]
    row_bytes: Count  # of a transition, in memory and in a message
    table_bytes: Count  # rows, columns and tree at full capacity
    resident_bytes: Count  # of the service's process
    disk_bytes: Count  # of a durable replay's files
    recovered: Count  # rows found when the service started
    writers: list[WriterStats]


@final
class StreamOffer(Message, frozen=True, kw_only=True, tag=True):
    """Where large answers may be had by a connection of their own."""

    ports: dict[str, Annotated[int, msgspec.Meta(ge=1, le=65535)]]  # by numeric host
    token: Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
    capacity: Count  # of the table: a sampler may keep as many rows (`replay.mirror`)


@final
class StatusMessage(Message, frozen=True, kw_only=True, tag=True):
    """A role's own counters, for the console."""

    role: str
    values: dict[str, Value]


@final
class Stop(Message, frozen=True, kw_only=True, tag=True):
    """Every role is to end cleanly."""

    reason: str


@final
class FileRequest(Message, frozen=True, kw_only=True, tag=True):
    """The part of a file that is wanted; `length` 0 asks for its size and hash."""

    offset: Count
    length: Count


@final
class FileReply(Message, frozen=True, kw_only=True, tag=True):
    """A part of a file, and what the whole of it is."""

    size: Count  # bytes of the whole file
    sha256: str  # of the whole file, hexadecimal
    data: bytes


def encode(message: Message) -> bytes:
    """The message as msgpack."""
    return msgspec.msgpack.encode(message)


def decode(payload: bytes, kind: type[MessageT]) -> MessageT:
    """Parses and validates; raises `WireError`, never a half-read message."""
    try:
        message = msgspec.msgpack.decode(payload, type=kind)
    # msgspec decodes the names of fields as text before it looks at them.
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise WireError(f"{kind.__name__}: {error}") from error
    if message.version != WIRE_VERSION:
        raise WireError(
            f"{kind.__name__}: wire version {message.version}, this process speaks "
            f"{WIRE_VERSION}; run the same release everywhere"
        )
    return message
