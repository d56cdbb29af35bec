"""The messages between writers and service; `replay.wire` has their layout."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt8

from replay.header import (
    COMMON,
    HEADER_BYTES,
    MAX_HOLD_MS,
    MAX_NUMBER,
    MAX_ROWS,
    Kind,
    Status,
    WireError,
    check_count,
    check_length,
    header,
    open_header,
    reason_of,
    status_of,
)
from replay.places import NO_PLACE, MemoryPlace, Place, decode_place, encode_place
from replay.spec import RowSpec

_INSERT = struct.Struct("<IIQQQIQI")
_INSERT_REPLY = struct.Struct("<HxxIQQQ")


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Insert:
    """Writer to service: the batch `sequence` of a writer's life `epoch`."""

    writer: int
    epoch: int  # grows when the writer's process restarts
    sequence: int
    base: int  # the lowest sequence that the writer knows no acknowledgement of
    hold_ms: int  # the service may hold its answer so long
    rows: UInt8[np.ndarray, "rows row_bytes"]  # none if they cannot be read here
    life: int = 0  # random; tells two processes of one number and epoch apart
    place: Place | None = None  # where the rows lie, if they need not be sent

    def encode(self, spec: RowSpec) -> bytes:
        """Header, then the rows' bytes or their place."""
        head = _INSERT.pack(
            self.writer,
            len(self.rows),
            self.epoch,
            self.sequence,
            self.base,
            self.hold_ms,
            self.life,
            self.place is not None,
        )
        body = encode_place(self.place) if self.place else self.rows.data
        return b"".join([header(Kind.INSERT, spec.schema_hash, head), body])

    @staticmethod
    def decode(
        payload: bytes,
        spec: RowSpec,
        part: Callable[[MemoryPlace, int], memoryview | None] | None = None,
    ) -> "Insert":
        """Parses and checks; the rows are a view of the payload.

        Or of `part(place, length)`; without it, or if it gives None, there are none.
        """
        open_header(payload, Kind.INSERT, spec.schema_hash)
        writer, count, epoch, sequence, base, hold_ms, life, placed = (
            _INSERT.unpack_from(payload, COMMON.size)
        )
        check_count(Kind.INSERT, "rows", count, MAX_ROWS)
        length = count * spec.row_bytes
        check_length(payload, Kind.INSERT, len(NO_PLACE) if placed else length)
        check_count(Kind.INSERT, "as its number", max(epoch, sequence), MAX_NUMBER)
        if count == 0 or base > sequence:
            raise WireError(
                f"INSERT: {count} rows as sequence {sequence} after {base}; a batch "
                "has rows and follows what it builds on"
            )
        place = decode_place(payload, HEADER_BYTES) if placed else None
        if place is None:
            rows = np.frombuffer(payload, np.uint8, offset=HEADER_BYTES)
            check_length(payload, Kind.INSERT, length)
        else:
            memory = part and isinstance(place, MemoryPlace) and part(place, length)
            rows = np.frombuffer(memory or b"", np.uint8)
        return Insert(
            writer=writer,
            epoch=epoch,
            sequence=sequence,
            base=base,
            hold_ms=min(hold_ms, MAX_HOLD_MS),
            rows=rows.reshape(-1, spec.row_bytes),
            life=life,
            place=place,
        )


@final
@dataclass(frozen=True, kw_only=True)
class InsertReply:
    """Service to writer: all below `next_sequence` is stored."""

    status: Status
    writer: int
    epoch: int
    next_sequence: int
    incarnation: int  # of the service's process; changes when it restarts
    reason: str = ""

    def encode(self, spec: RowSpec) -> bytes:
        """Header, then the reason."""
        head = _INSERT_REPLY.pack(
            self.status, self.writer, self.epoch, self.next_sequence, self.incarnation
        )
        return header(Kind.INSERT_REPLY, spec.schema_hash, head) + self.reason.encode()

    @staticmethod
    def decode(payload: bytes, spec: RowSpec) -> "InsertReply":
        """Parses and checks."""
        open_header(payload, Kind.INSERT_REPLY, spec.schema_hash)
        status, writer, epoch, next_sequence, incarnation = _INSERT_REPLY.unpack_from(
            payload, COMMON.size
        )
        return InsertReply(
            status=status_of(status, Kind.INSERT_REPLY),
            writer=writer,
            epoch=epoch,
            next_sequence=next_sequence,
            incarnation=incarnation,
            reason=reason_of(payload, Kind.INSERT_REPLY),
        )
