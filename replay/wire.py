"""The messages: one frozen struct each, decoded whole or refused.

Bulk messages (rows, priorities, weights) are a fixed little-endian header followed by
arrays; small ones that nothing counts on for speed are msgpack (see
`replay.control`). No pickle, and no length is used before it has been checked.

Every header begins with the same 16 bytes:

    magic "SLST" | version u16 | kind u16 | hash of the row's schema, 8 bytes

and is padded to 64 bytes, so that rows behind it stay aligned.

    Insert        writer u32, rows u32, epoch u64, sequence u64, base u64,
                  hold ms u32, life u64, placed u32; then rows, or, if placed,
                  where they lie (`replay.places`)
    InsertReply   status u16, writer u32, epoch u64, next sequence u64,
                  incarnation u64; then the reason as UTF-8
    SampleRequest batch size u32, batches u32, updates u32, hold ms u32, and where
                  the reply's body may lie (`replay.places`); then ids u64[updates],
                  priorities f64[updates]
    FetchRequest  limit u32, first id u64
    SampleReply   status u16, placed u16, rows u32, size u64, inserts u64,
                  mass f64; then ids u64[rows], probabilities f64[rows], rows (where
                  the request said, if placed); or the reason.
                  It also answers FetchRequest (size and inserts bound the ids)
    Weights       values u32, version i64, layout hash ASCII[24]; then f32[values]
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
import zenoh
from jaxtyping import Float, UInt8, UInt64

from replay.header import (
    COMMON,
    HEADER_BYTES,
    MAX_HOLD_MS,
    MAX_NUMBER,
    MAX_REPLY_BYTES,
    MAX_ROWS,
    MAX_UPDATES,
    NO_SCHEMA,
    WIRE_VERSION,
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
from replay.places import (
    Place,
    decode_place,
    encode_place,
)
from replay.spec import RowSpec, Sample

__all__ = [
    "HEADER_BYTES",
    "MAX_NUMBER",
    "MAX_REPLY_BYTES",
    "WIRE_VERSION",
    "FetchRequest",
    "SampleReply",
    "SampleReplyBuffer",
    "SampleRequest",
    "Status",
    "Weights",
    "WireError",
    "body_bytes",
    "encode_sample_refusal",
    "is_placed",
]

_SAMPLE_REQUEST = struct.Struct("<IIII")  # and a place
_SAMPLE_REPLY = struct.Struct("<HHIQQd")
_FETCH_REQUEST = struct.Struct("<IxxxxQ")
_WEIGHTS = struct.Struct("<Ixxxxq24s")


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class SampleRequest:
    """Learner to service: new priorities first, then draw `batches` batches."""

    batch_size: int
    batches: int
    hold_ms: int
    ids: UInt64[np.ndarray, " updates"]
    priorities: Float[np.ndarray, " updates"]  # float64, >= 0: |TD error|
    place: Place | None = None  # of the reply's body, if the service can write there

    def encode(self, spec: RowSpec) -> bytes:
        """Header, ids, priorities."""
        head = _SAMPLE_REQUEST.pack(
            self.batch_size, self.batches, len(self.ids), self.hold_ms
        )
        head += encode_place(self.place)
        return (
            header(Kind.SAMPLE_REQUEST, spec.schema_hash, head)
            + self.ids.astype("<u8").tobytes()
            + self.priorities.astype("<f8").tobytes()
        )

    @staticmethod
    def decode(payload: bytes, spec: RowSpec) -> "SampleRequest":
        """Parses and checks."""
        kind = Kind.SAMPLE_REQUEST
        open_header(payload, kind, spec.schema_hash)
        batch_size, batches, updates, hold_ms = _SAMPLE_REQUEST.unpack_from(
            payload, COMMON.size
        )
        check_count(kind, "updates", updates, MAX_UPDATES)
        check_count(kind, "rows asked for", batch_size * batches, MAX_ROWS)
        check_length(payload, kind, 16 * updates)
        if batch_size * batches == 0:
            raise WireError(f"{kind.name}: {batches} batches of {batch_size} rows")
        size = batch_size * batches * (16 + spec.row_bytes)
        check_count(kind, "bytes asked for", size, MAX_REPLY_BYTES)
        return SampleRequest(
            batch_size=batch_size,
            batches=batches,
            hold_ms=min(hold_ms, MAX_HOLD_MS),
            ids=np.frombuffer(payload, "<u8", updates, HEADER_BYTES),
            priorities=np.frombuffer(
                payload, "<f8", updates, HEADER_BYTES + 8 * updates
            ),
            place=decode_place(payload, COMMON.size + _SAMPLE_REQUEST.size),
        )


@final
@dataclass(frozen=True, kw_only=True)
class FetchRequest:
    """Anyone to service: some of the rows from `first_id`, in order, if there are."""

    first_id: int
    limit: int

    def encode(self, spec: RowSpec) -> bytes:
        """A header only."""
        head = _FETCH_REQUEST.pack(self.limit, self.first_id)
        return header(Kind.FETCH_REQUEST, spec.schema_hash, head)

    @staticmethod
    def decode(payload: bytes, spec: RowSpec) -> "FetchRequest":
        """Parses and checks."""
        open_header(payload, Kind.FETCH_REQUEST, spec.schema_hash)
        limit, first_id = _FETCH_REQUEST.unpack_from(payload, COMMON.size)
        check_count(Kind.FETCH_REQUEST, "rows asked for", limit, MAX_ROWS)
        check_length(payload, Kind.FETCH_REQUEST, 0)
        return FetchRequest(first_id=first_id, limit=limit)


def is_placed(payload: zenoh.ZBytes) -> bool:
    """Whether a sample reply's body lies or comes elsewhere; reads the header only."""
    if len(payload) != HEADER_BYTES:
        return False
    status, placed, *_ = _SAMPLE_REPLY.unpack_from(payload.to_bytes(), COMMON.size)
    return bool(status == Status.OK and placed)


def body_bytes(spec: RowSpec, count: int) -> int:
    """Bytes of the ids, probabilities and rows of a sample reply."""
    return count * (16 + spec.row_bytes)


@final
class SampleReplyBuffer:
    """A sample reply under construction: the table gathers straight into it."""

    def __init__(
        self,
        *,
        spec: RowSpec,
        count: int,
        payload: bytearray | None = None,
        place: memoryview | None = None,
    ) -> None:
        """Room for `count` rows: in `place`, or in the message behind the header.

        `payload`: a former message, used again if it has the right length.
        """
        size = HEADER_BYTES + (0 if place else body_bytes(spec, count))
        if payload is None or len(payload) != size:
            payload = bytearray(size)
        self._spec = spec
        self._placed = place is not None
        self.payload = payload
        body = place if place else memoryview(payload)[HEADER_BYTES:]
        self.ids = np.frombuffer(body, "<u8", count)
        self.probabilities = np.frombuffer(body, "<f8", count, 8 * count)
        rows = np.frombuffer(body, np.uint8, count * spec.row_bytes, 16 * count)
        self.rows = rows.reshape(count, spec.row_bytes)

    def leave_out(self, rows: int) -> None:
        """The last rows' bytes do not go with it: whoever asked has them."""
        self.rows = self.rows[: len(self.rows) - rows]

    @property
    def body_bytes(self) -> int:
        """Bytes of ids, probabilities and the rows that go with them."""
        return self.ids.nbytes + self.probabilities.nbytes + self.rows.nbytes

    def seal(self, *, size: int, inserts: int, mass: float) -> bytearray:
        """Writes the header and returns the whole message."""
        head = _SAMPLE_REPLY.pack(
            Status.OK, self._placed, len(self.ids), size, inserts, mass
        )
        self.payload[:HEADER_BYTES] = header(
            Kind.SAMPLE_REPLY, self._spec.schema_hash, head
        )
        return self.payload


def encode_sample_refusal(status: Status, reason: str, spec: RowSpec) -> bytes:
    """A sample reply without rows: busy, or refused with a reason."""
    head = _SAMPLE_REPLY.pack(status, 0, 0, 0, 0, 0.0)
    return header(Kind.SAMPLE_REPLY, spec.schema_hash, head) + reason.encode()


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class SampleReply:
    """Service to learner: rows, or why there are none."""

    status: Status
    reason: str
    sample: Sample | None  # None if and only if status is not OK

    @staticmethod
    def decode(
        payload: bytes,
        spec: RowSpec,
        view: Callable[[int], UInt8[np.ndarray, " length"]] | None = None,
    ) -> "SampleReply":
        """Parses and checks; the arrays are views of the payload.

        Or of `view(length)`, the bytes at the place that the request named, if the
        service put the rows there.
        """
        kind = Kind.SAMPLE_REPLY
        open_header(payload, kind, spec.schema_hash)
        code, placed, count, *told = _SAMPLE_REPLY.unpack_from(payload, COMMON.size)
        status, (size, inserts, mass) = status_of(code, kind), told
        if status is not Status.OK:
            reason = reason_of(payload, kind)
            return SampleReply(status=status, reason=reason, sample=None)
        check_count(kind, "rows", count, MAX_ROWS)
        length = body_bytes(spec, count)
        check_length(payload, kind, 0 if placed else length)
        if placed and view is None:
            raise WireError(f"{kind.name}: placed, but no place was named")
        body = view(length) if placed and view else payload
        start = 0 if placed else HEADER_BYTES
        sample = Sample(
            ids=np.frombuffer(body, "<u8", count, start),
            probabilities=np.frombuffer(body, "<f8", count, start + 8 * count),
            rows=np.frombuffer(body, spec.dtype, count, start + 16 * count),
            size=size,
            inserts=inserts,
            mass=mass,
        )
        if not 0 <= mass < float("inf"):  # NaN is neither
            raise WireError(f"{kind.name}: a mass of {mass}")
        if not (abs(sample.probabilities - 0.5) <= 0.5 + 1e-9).all():
            raise WireError(f"{kind.name}: probabilities outside of [0, 1]")
        return SampleReply(status=status, reason="", sample=sample)


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Weights:
    """Learner to actors: all parameters in the layout's order."""

    version: int  # updates made; -1 before there are any
    layout_hash: str  # of names and shapes, at most 24 ASCII characters
    vector: Float[np.ndarray, " parameters"]  # float32

    def encode(self) -> bytes:
        """Header, then the vector."""
        name = self.layout_hash.encode("ascii", "replace")
        if not 0 < len(name) <= 24:
            raise WireError(
                f"layout hash {self.layout_hash!r}: needs 1 to 24 ASCII characters"
            )
        head = _WEIGHTS.pack(len(self.vector), self.version, name)
        return (
            header(Kind.WEIGHTS, NO_SCHEMA, head) + self.vector.astype("<f4").tobytes()
        )

    @staticmethod
    def decode(payload: bytes) -> "Weights":
        """Parses and checks; the vector is its own copy."""
        open_header(payload, Kind.WEIGHTS, NO_SCHEMA)
        count, version, name = _WEIGHTS.unpack_from(payload, COMMON.size)
        check_length(payload, Kind.WEIGHTS, 4 * count)
        try:
            layout_hash = name.rstrip(b"\0").decode("ascii")
        except UnicodeDecodeError as error:
            raise WireError("WEIGHTS: the layout hash is not ASCII") from error
        # A copy: jax.device_put may alias memory, and the payload is Zenoh's.
        vector = np.frombuffer(payload, "<f4", count, HEADER_BYTES).copy()
        return Weights(version=version, layout_hash=layout_hash, vector=vector)
