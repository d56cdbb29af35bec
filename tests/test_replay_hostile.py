"""Hostile input: the service answers with an error and stays up, clients too."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from replay.channels import FrameSubscriber, StatusSubscriber
from replay.client import Sampler, Writer, fetch_rows, fetch_stats
from replay.control import FileReply, FileRequest, StatusMessage, decode, encode
from replay.files import FileServer
from replay.ledger import Ledger, Verdict
from replay.local import ReplayConfig
from replay.places import StreamPlace
from replay.session import ask
from replay.spec import ReplayError
from replay.wire import (
    MAX_NUMBER,
    FetchRequest,
    SampleReply,
    SampleReplyBuffer,
    SampleRequest,
    Status,
    WireError,
)
from replay.wire_inserts import Insert, InsertReply
from tests.replay_parts import KEYS, SPEC, Service, eventually, make_rows, service

CONFIG = ReplayConfig(
    capacity=4096,
    min_size=10,
    samples_per_insert=2.0,
    tolerance=50.0,
    sampler="uniform",
)
QUICK = settings(deadline=None, max_examples=120, phases=(Phase.reuse, Phase.generate))


@pytest.fixture(scope="module")
def running() -> Iterator[Service]:
    """One service for all: what one test does to it must not harm the others."""
    with service(CONFIG) as started:
        yield started


def insert(**changes: int) -> Insert:
    fields = {"writer": 1, "epoch": 1, "sequence": 0, "base": 0, "hold_ms": 0}
    rows = SPEC.as_bytes(make_rows(0, 2))
    return Insert(**(fields | changes), rows=rows)


def works(running: Service, numbers: Iterator[int]) -> bool:
    """Whether an ordinary writer and sampler get through, with a new number."""
    writer = Writer(
        session=running.client,
        keys=KEYS,
        spec=SPEC,
        writer=next(numbers),
        epoch=1,
        batch_rows=4,
    )
    writer.append(make_rows(0, 12))
    stored = writer.close(20.0)
    sampler = Sampler(
        session=running.client, keys=KEYS, spec=SPEC, batch_size=4, in_flight=1
    )
    return stored and len(sampler.sample(20.0).ids) == 4


NUMBERS = iter(range(100, 1000))
VALID = [
    insert().encode(SPEC),
    replace(insert(), place=StreamPlace(name=bytes(16), number=2)).encode(SPEC),
    SampleRequest(
        batch_size=2,
        batches=2,
        hold_ms=0,
        ids=np.array([1, 2], np.uint64),
        priorities=np.array([1.0, 2.0]),
    ).encode(SPEC),
    FetchRequest(first_id=0, limit=10).encode(SPEC),
]


@st.composite
def payloads(draw: st.DrawFn) -> bytes:
    """Noise, or a valid message with bytes changed, cut off or appended."""
    if draw(st.booleans()):
        return draw(st.binary(max_size=300))
    data = bytearray(draw(st.sampled_from(VALID)))
    for _ in range(draw(st.integers(1, 4))):
        # Headers decide: most changes go there, past the magic and the schema.
        place = draw(st.one_of(st.integers(16, 63), st.integers(0, len(data) - 1)))
        data[place] = draw(st.sampled_from([0, 1, 127, 128, 255]))
    cut = draw(st.integers(0, len(data)))
    return bytes(data[:cut] if draw(st.booleans()) and cut % 3 == 0 else data)


@QUICK
@given(
    key=st.sampled_from(["insert", "sample", "fetch", "stats", "stream", "sync"]),
    payload=payloads(),
)
def test_any_bytes_are_answered_and_the_service_stays_up(
    running: Service, key: str, payload: bytes
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        # Some ask to be held as long as may be, and the limiter does hold them.
        patch.setattr("replay.wire.MAX_HOLD_MS", 100)
        patch.setattr("replay.wire_inserts.MAX_HOLD_MS", 100)
        answered = ask(running.client, getattr(KEYS, key), payload, timeout_s=20.0)
    assert answered is not None


def test_afterwards_it_works_as_before(running: Service) -> None:
    assert works(running, NUMBERS)


def test_wildcards_and_empty_payloads_do_no_harm(running: Service) -> None:
    for key in (KEYS.everything, "slipstream/*/replay/*/insert"):
        ask(running.client, key, b"", timeout_s=5.0)
    assert works(running, NUMBERS)


def answer_to(running: Service, message: Insert) -> InsertReply:
    payload = ask(running.client, KEYS.insert, message.encode(SPEC), timeout_s=20.0)
    assert payload is not None
    return InsertReply.decode(payload, SPEC)


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({"sequence": 2**64 - 1}, Status.REFUSED),
        ({"epoch": 2**64 - 1}, Status.REFUSED),
        ({"sequence": MAX_NUMBER + 1, "base": MAX_NUMBER + 1}, Status.REFUSED),
        ({"sequence": 3, "base": 4}, Status.REFUSED),
        ({"sequence": 5}, Status.GAP),
        ({"writer": 2**32 - 1}, Status.OK),
        ({"hold_ms": 2**32 - 1}, Status.OK),
    ],
)
def test_numbers_at_the_border(
    running: Service, changes: dict[str, int], status: Status
) -> None:
    changes = {"writer": next(NUMBERS)} | changes
    assert answer_to(running, insert(**changes)).status is status


def test_the_last_number_there_is_can_be_used(running: Service) -> None:
    writer = next(NUMBERS)
    message = insert(
        writer=writer, epoch=MAX_NUMBER, sequence=MAX_NUMBER, base=MAX_NUMBER
    )
    reply = answer_to(running, message)
    assert (reply.status, reply.next_sequence) == (Status.OK, MAX_NUMBER + 1)
    assert fetch_stats(running.client, KEYS)["writers"][-1]["epoch"] >= 1


def test_a_second_process_of_one_number_is_told_so(running: Service) -> None:
    writer = next(NUMBERS)
    assert answer_to(running, insert(writer=writer, life=5)).status is Status.OK
    reply = answer_to(running, insert(writer=writer, life=6, sequence=1))
    assert reply.status is Status.STALE
    assert "is another process; give every actor its own number" in reply.reason
    replayed = answer_to(running, insert(writer=writer, life=5))
    assert (replayed.status, replayed.next_sequence) == (Status.OK, 1)
    mine = Writer(session=running.client, keys=KEYS, spec=SPEC, writer=writer, epoch=1)
    mine.append(make_rows(0, 64))
    with pytest.raises(ReplayError, match="is another process"):
        mine.close(10.0)


def test_more_writers_than_there_may_be_are_refused() -> None:
    ledger: Ledger[str] = Ledger(2)
    for writer, verdict in ((1, "NEXT"), (2, "NEXT"), (3, "FULL"), (1, "NEXT")):
        got, _ = ledger.judge(writer=writer, epoch=0, sequence=0, base=0)
        assert got is Verdict[verdict]


def sample_of(running: Service, request: SampleRequest) -> SampleReply:
    payload = ask(running.client, KEYS.sample, request.encode(SPEC), timeout_s=20.0)
    assert payload is not None
    return SampleReply.decode(payload, SPEC)


def request(**changes: object) -> SampleRequest:
    fields: dict[str, object] = {
        "batch_size": 1,
        "batches": 1,
        "hold_ms": 0,
        "ids": np.zeros(0, np.uint64),
        "priorities": np.zeros(0),
    }
    return SampleRequest(**(fields | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"batch_size": 2**32 - 1, "batches": 2**32 - 1}, "rows asked for"),
        ({"batch_size": 1 << 20, "batches": 8}, "rows asked for"),
        ({"batch_size": 0}, "1 batches of 0 rows"),
        ({"batch_size": 1 << 12}, "would deadlock"),
        *(
            (
                {"ids": np.array([1], np.uint64), "priorities": np.array([bad])},
                "diverged",
            )
            for bad in (float("nan"), float("inf"), -float("inf"), -1.0, 1e300)
        ),
    ],
)
def test_samples_that_can_never_be_are_refused(
    running: Service, changes: dict[str, object], why: str
) -> None:
    reply = sample_of(running, request(**changes))
    assert reply.status is Status.REFUSED
    assert why in reply.reason


def test_ids_from_the_future_are_skipped_and_counted(running: Service) -> None:
    assert works(running, NUMBERS)
    before = fetch_stats(running.client, KEYS)["stale_updates"]
    ids = np.array([0, 2**62, 2**63, 2**64 - 1], np.uint64)
    reply = sample_of(running, request(ids=ids, priorities=np.ones(4)))
    assert reply.status is not Status.REFUSED
    assert fetch_stats(running.client, KEYS)["stale_updates"] == before + 3


@pytest.mark.parametrize("first_id", [2**62, 2**63, 2**64 - 1])
def test_rows_from_the_future_are_none(running: Service, first_id: int) -> None:
    assert not list(
        fetch_rows(session=running.client, keys=KEYS, spec=SPEC, first_id=first_id)
    )


def test_a_stranger_cannot_decide_the_runs_batch_sizes() -> None:
    with service(CONFIG, largest=(16, 32)) as running:
        reply = sample_of(running, request(batch_size=33))
        assert "are at most 16 (insert) and 32 (sample)" in reply.reason
        message = insert()
        rows = SPEC.as_bytes(make_rows(0, 17))
        message = Insert(writer=1, epoch=1, sequence=0, base=0, hold_ms=0, rows=rows)
        assert answer_to(running, message).status is Status.REFUSED
        assert works(running, iter([1]))


def test_writers_that_send_too_much_at_once_are_sent_back() -> None:
    small = ReplayConfig(
        capacity=64,
        min_size=1,
        samples_per_insert=1.0,
        tolerance=9.0,
        sampler="uniform",
    )
    with service(small) as running:
        answers: list[InsertReply] = []
        for sequence in range(80):
            running.client.get(
                KEYS.insert,
                lambda reply: answers.append(
                    InsertReply.decode(reply.ok.payload.to_bytes(), SPEC)
                ),
                payload=insert(sequence=sequence, hold_ms=60_000).encode(SPEC),
                timeout=60.0,
            )
        # Five fit the limiter, 64 wait, the others are told to come again.
        assert eventually(lambda: len(answers) >= 5 + 80 - 5 - 64)
        (told,) = fetch_stats(running.client, KEYS)["writers"]
        assert told["pending"] == 64


def test_replies_of_a_hostile_service_are_refused() -> None:
    buffer = SampleReplyBuffer(spec=SPEC, count=3)
    for bad in (float("nan"), -0.1, 2.0, float("inf")):
        buffer.probabilities[:] = [0.5, bad, 0.5]
        payload = bytes(buffer.seal(size=3, inserts=3, mass=3.0))
        with pytest.raises(WireError, match=r"outside of \[0, 1\]"):
            SampleReply.decode(payload, SPEC)
    buffer.probabilities[:] = 0.5
    for bad in (float("nan"), -0.1, float("inf")):
        payload = bytes(buffer.seal(size=3, inserts=3, mass=bad))
        with pytest.raises(WireError, match="a mass of"):
            SampleReply.decode(payload, SPEC)


def hostile(
    running: Service, key: str, reply: Callable[[bytes], bytes]
) -> Callable[[], None]:
    """Answers in the service's place, under another run's keys."""

    def answer(query: object) -> None:
        with query:  # type: ignore[attr-defined]
            asked = query.payload.to_bytes()  # type: ignore[attr-defined]
            query.reply(query.key_expr, reply(asked))  # type: ignore[attr-defined]

    return running.client.declare_queryable(key, answer).undeclare


def test_an_acknowledgement_of_what_was_never_sent_is_an_error(
    running: Service,
) -> None:
    keys = type(KEYS)("hostile-run")

    def lie(_: bytes) -> bytes:
        return InsertReply(
            status=Status.OK, writer=1, epoch=1, next_sequence=99, incarnation=0
        ).encode(SPEC)

    end = hostile(running, keys.insert, lie)
    writer = Writer(
        session=running.client, keys=keys, spec=SPEC, writer=1, epoch=1, batch_rows=4
    )
    writer.append(make_rows(0, 4))
    with pytest.raises(ReplayError, match="which was never sent"):
        writer.close(10.0)
    assert writer.acknowledged == 0
    end()


def test_status_and_frames_of_strangers_are_dropped(running: Service) -> None:
    statuses = StatusSubscriber(running.client, KEYS)
    frames = FrameSubscriber(running.client, KEYS)
    told = encode(StatusMessage(role="learner", values={"updates": 1}))
    for payload in (b"", b"\xc1" * 9, bytes(1 << 17), told):
        running.client.put(KEYS.status("actor-1"), payload)
    running.client.put(f"{KEYS.frames(0)}x", b"?")
    running.client.put(KEYS.frames(0), bytes((16 << 20) + 1))
    running.client.put(KEYS.frames(0), b"good")
    assert eventually(lambda: statuses.refused == 4)
    assert statuses.latest() == {}
    assert frames.get(20.0) == (0, b"good")
    frames.close()
    statuses.close()


def test_parts_beyond_a_files_end_are_empty(running: Service, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"content")
    offered = FileServer(session=running.client, keys=KEYS, files={"file": path})
    for offset in (7, 2**63 - 1, 2**64 - 1):
        wanted = encode(FileRequest(offset=offset, length=2**64 - 1))
        payload = ask(running.client, KEYS.file("file"), wanted, timeout_s=10.0)
        assert payload is not None
        assert decode(payload, FileReply).data == b""
    for junk in (b"", struct.pack("<q", -1)):
        assert ask(running.client, KEYS.file("file"), junk, timeout_s=10.0) is None
    offered.close()
