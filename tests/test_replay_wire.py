"""Every message survives the wire whole, and nothing else is taken for one."""

import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from replay import control
from replay.places import MemoryPlace
from replay.spec import Field, ReplayError, RowSpec
from replay.wire import (
    HEADER_BYTES,
    FetchRequest,
    SampleReply,
    SampleReplyBuffer,
    SampleRequest,
    Status,
    Weights,
    WireError,
    encode_sample_refusal,
)
from replay.wire_inserts import Insert, InsertReply
from tests.replay_parts import SPEC, make_rows

OTHER = RowSpec(
    (Field("writer", "i4"), Field("number", "i8"), Field("state", "f4", (4,)))
)


def insert() -> Insert:
    return Insert(
        writer=7,
        epoch=2**60,
        sequence=2**40,
        base=2**40 - 3,
        hold_ms=1500,
        rows=SPEC.as_bytes(make_rows(5, 9)),
    )


def placed_insert() -> Insert:
    place = MemoryPlace(pid=9, fd=7, offset=2**40, token=bytes(range(16)))
    return replace(insert(), place=place)


def insert_reply() -> InsertReply:
    return InsertReply(
        status=Status.GAP,
        writer=7,
        epoch=3,
        next_sequence=2**50,
        incarnation=2**62,
        reason="größer",
    )


def sample_request() -> SampleRequest:
    return SampleRequest(
        batch_size=64,
        batches=2,
        hold_ms=10,
        ids=np.array([1, 2**63], np.uint64),
        priorities=np.array([0.5, 3.0]),
    )


def sample_reply() -> bytes:
    buffer = SampleReplyBuffer(spec=SPEC, count=3)
    buffer.ids[:] = [4, 2**40, 6]
    buffer.probabilities[:] = [0.1, 0.2, 0.3]
    buffer.rows[:] = SPEC.as_bytes(make_rows(10, 3))
    return bytes(buffer.seal(size=100, inserts=2**40, mass=2.5))


def weights() -> Weights:
    return Weights(
        version=-1,
        layout_hash="0123456789abcdef",
        vector=np.arange(5, dtype=np.float32),
    )


Decoder = Callable[[bytes], object]
PAYLOADS: dict[str, tuple[bytes, Decoder, bool]] = {
    "Insert": (insert().encode(SPEC), lambda p: Insert.decode(p, SPEC), True),
    "Insert of rows elsewhere": (
        placed_insert().encode(SPEC),
        lambda p: Insert.decode(p, SPEC),
        True,
    ),
    "InsertReply": (
        insert_reply().encode(SPEC),
        lambda p: InsertReply.decode(p, SPEC),
        False,  # ends in free text: a truncated one is a shorter text
    ),
    "SampleRequest": (
        sample_request().encode(SPEC),
        lambda p: SampleRequest.decode(p, SPEC),
        True,
    ),
    "FetchRequest": (
        FetchRequest(first_id=2**40, limit=9).encode(SPEC),
        lambda p: FetchRequest.decode(p, SPEC),
        True,
    ),
    "SampleReply": (sample_reply(), lambda p: SampleReply.decode(p, SPEC), True),
    "Weights": (weights().encode(), Weights.decode, True),
}
SMALL_MESSAGES: list[control.Message] = [
    control.StreamOffer(ports={"127.0.0.1": 65535}, token=bytes(16), capacity=9),
    control.StatusMessage(role="actor-1", values={"steps": 3, "rate": 0.5, "x": "y"}),
    control.Stop(reason="learnt"),
    control.FileRequest(offset=5, length=7),
    control.FileReply(size=9, sha256="ab", data=b"\0\1"),
    control.StatsReply(
        incarnation=1,
        schema_hash="00",
        capacity=1,
        size=1,
        inserts=1,
        samples=1,
        deletes=0,
        samples_per_insert=1.0,
        configured_samples_per_insert=1.0,
        min_size=1,
        insert_wait_s=0.0,
        sample_wait_s=0.0,
        busy_inserts=0,
        busy_samples=0,
        duplicates=0,
        gaps=0,
        refused=0,
        stale_updates=0,
        pending_samples=0,
        mean_priority_mass=1.0,
        durable=True,
        fault="",
        sampler="uniform",
        max_times_sampled=0,
        tolerance=1.0,
        debt=-0.5,
        uptime_s=1.0,
        insert_rate=1.0,
        sample_rate=1.0,
        ages=[0.0],
        priorities=[1.0],
        row_bytes=64,
        table_bytes=64,
        resident_bytes=1,
        disk_bytes=0,
        recovered=0,
        writers=[
            control.WriterStats(
                writer=1, epoch=2, next_sequence=3, rows=4, pending=5, lag_s=0.5
            )
        ],
    ),
]
every_bulk = pytest.mark.parametrize("name", PAYLOADS)
every_small = pytest.mark.parametrize(
    "message", SMALL_MESSAGES, ids=lambda message: type(message).__name__
)


def test_insert_round_trip() -> None:
    sent, got = insert(), Insert.decode(insert().encode(SPEC), SPEC)
    assert (got.writer, got.epoch, got.hold_ms) == (7, 2**60, 1500)
    assert (got.sequence, got.base) == (2**40, 2**40 - 3)
    np.testing.assert_array_equal(got.rows, sent.rows)


def test_rows_elsewhere_are_read_there_or_not_at_all() -> None:
    sent = placed_insert()
    data = sent.rows.tobytes()

    def part(place: MemoryPlace, length: int) -> memoryview | None:
        return memoryview(data)[:length] if place == sent.place else None

    got = Insert.decode(sent.encode(SPEC), SPEC, part)
    np.testing.assert_array_equal(got.rows, sent.rows)
    assert len(Insert.decode(sent.encode(SPEC), SPEC).rows) == 0


def test_insert_reply_round_trip() -> None:
    assert InsertReply.decode(insert_reply().encode(SPEC), SPEC) == insert_reply()


def test_sample_request_round_trip() -> None:
    sent = sample_request()
    got = SampleRequest.decode(sent.encode(SPEC), SPEC)
    assert (got.batch_size, got.batches, got.hold_ms) == (64, 2, 10)
    np.testing.assert_array_equal(got.ids, sent.ids)
    np.testing.assert_array_equal(got.priorities, sent.priorities)


def test_fetch_request_round_trip() -> None:
    sent = FetchRequest(first_id=2**40, limit=9)
    assert FetchRequest.decode(sent.encode(SPEC), SPEC) == sent


def test_sample_reply_round_trip() -> None:
    sample = SampleReply.decode(sample_reply(), SPEC).sample
    assert sample is not None
    assert (sample.size, sample.inserts) == (100, 2**40)
    assert sample.ids.tolist() == [4, 2**40, 6]
    assert sample.probabilities.tolist() == [0.1, 0.2, 0.3]
    np.testing.assert_array_equal(sample.rows, make_rows(10, 3))


def test_sample_refusal_round_trip() -> None:
    payload = encode_sample_refusal(Status.REFUSED, "no: ünfit", SPEC)
    reply = SampleReply.decode(payload, SPEC)
    assert reply.status is Status.REFUSED
    assert reply.reason == "no: ünfit"
    assert reply.sample is None


def test_weights_round_trip_is_a_copy() -> None:
    payload = weights().encode()
    got = Weights.decode(payload)
    assert (got.version, got.layout_hash) == (-1, "0123456789abcdef")
    np.testing.assert_array_equal(got.vector, weights().vector)
    assert got.vector.flags.writeable
    with pytest.raises(WireError, match="layout hash"):
        Weights(version=0, layout_hash="", vector=got.vector).encode()


@every_small
def test_small_messages_round_trip(message: control.Message) -> None:
    assert control.decode(control.encode(message), type(message)) == message


@every_bulk
def test_truncated_or_longer_messages_are_refused(name: str) -> None:
    payload, decode, sized = PAYLOADS[name]
    lengths = range(len(payload)) if sized else range(HEADER_BYTES)
    for length in lengths:
        with pytest.raises(WireError, match="bytes"):
            decode(payload[:length])
    if sized:
        with pytest.raises(WireError, match="bytes after the header"):
            decode(payload + b"\0")


@every_small
def test_truncated_small_messages_are_refused(message: control.Message) -> None:
    payload = control.encode(message)
    for length in range(len(payload)):
        with pytest.raises(WireError):
            control.decode(payload[:length], type(message))


@every_bulk
@pytest.mark.parametrize(
    ("offset", "value", "why"),
    [
        (0, b"X", "begins with"),
        (4, b"\x63", "wire version 99"),
        (6, b"\x63", "kind 99"),
    ],
)
def test_wrong_header_is_refused(
    name: str, offset: int, value: bytes, why: str
) -> None:
    payload, decode, _ = PAYLOADS[name]
    with pytest.raises(WireError, match=why):
        decode(payload[:offset] + value + payload[offset + 1 :])


@every_small
def test_wrong_version_is_refused(message: control.Message) -> None:
    import msgspec

    newer = msgspec.structs.replace(message, version=99)
    with pytest.raises(WireError, match="wire version 99"):
        control.decode(control.encode(newer), type(message))


def test_wrong_type_and_unknown_fields_are_refused() -> None:
    stop = control.encode(control.Stop(reason="x"))
    with pytest.raises(WireError, match="StatusMessage"):
        control.decode(stop, control.StatusMessage)
    with pytest.raises(WireError, match="FileRequest"):
        control.decode(
            control.encode(control.FileRequest(offset=-1, length=0)),
            control.FileRequest,
        )


@pytest.mark.parametrize("name", [name for name in PAYLOADS if name != "Weights"])
def test_another_row_layout_is_refused_with_both_hashes(name: str) -> None:
    payload, _, _ = PAYLOADS[name]
    kind = {"Insert": Insert, "InsertReply": InsertReply, "SampleReply": SampleReply}
    kind["Insert of rows elsewhere"] = Insert
    decoder = kind.get(name, SampleRequest if "Sample" in name else FetchRequest)
    hashes = f"{SPEC.schema_hash.hex()}, expected {OTHER.schema_hash.hex()}"
    with pytest.raises(WireError, match=hashes):
        decoder.decode(payload, OTHER)


@every_bulk
@given(data=st.data())
def test_fuzzed_messages_decode_or_raise(name: str, data: st.DataObject) -> None:
    """Whatever bytes arrive: a message or `WireError`, never another exception."""
    payload, decode, _ = PAYLOADS[name]
    at = data.draw(st.integers(0, len(payload) - 1))
    noise = data.draw(st.binary(min_size=1, max_size=24))
    for fuzzed in (payload[:at] + noise + payload[at + len(noise) :], noise):
        try:
            decode(fuzzed)
        except WireError:
            pass


@given(payload=st.binary(max_size=80))
@example(payload=b"\xde\x00\x01\xa1\x80")  # a field whose name is not UTF-8
def test_fuzzed_small_messages_decode_or_raise(payload: bytes) -> None:
    for message in SMALL_MESSAGES:
        try:
            control.decode(payload, type(message))
        except WireError:
            pass


def test_counts_are_checked_before_they_are_used() -> None:
    payload = bytearray(insert().encode(SPEC))
    struct.pack_into("<I", payload, 20, 2**31)
    with pytest.raises(WireError, match="2147483648 rows, at most"):
        Insert.decode(bytes(payload), SPEC)
    empty = insert().encode(SPEC)[:HEADER_BYTES]
    struct.pack_into("<I", none := bytearray(empty), 20, 0)
    with pytest.raises(WireError, match="a batch has rows"):
        Insert.decode(bytes(none), SPEC)


def test_rows_are_padded_little_endian_and_hashed() -> None:
    assert SPEC.row_bytes == 64
    assert SPEC.dtype["number"] == np.dtype("<i8")
    assert len(SPEC.schema_hash) == 8
    assert SPEC.schema_hash != OTHER.schema_hash
    swapped = RowSpec((SPEC.fields[1], SPEC.fields[0], SPEC.fields[2]))
    assert swapped.schema_hash != SPEC.schema_hash


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: Field("a", "O"), "not a number"),
        (lambda: Field("a", "f4", (0,)), "sizes >= 1"),
        (lambda: RowSpec(()), "at least one"),
        (lambda: RowSpec((Field("a", "i4"), Field("a", "i4"))), "unique"),
        (lambda: RowSpec((Field("a", "f8", (1 << 20,)),)), "ship states"),
        (lambda: SPEC.check(np.zeros(3)), "expected a vector"),
    ],
)
def test_bad_layouts_are_refused(make: Callable[[], object], why: str) -> None:
    with pytest.raises(ReplayError, match=why):
        make()
