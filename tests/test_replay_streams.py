"""Large batches beside Zenoh: rows drawn by a stream, rows inserted by their place."""

import contextlib
import socket
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from replay import streams
from replay.arena import Arena
from replay.client import Sampler, Writer, fetch_rows, fetch_stats
from replay.control import StreamOffer, decode
from replay.local import ReplayConfig
from replay.places import MemoryPlace, StreamPlace
from replay.session import ask, open_session
from replay.spec import Field, ReplayTimeout, RowSpec
from replay.stream_frames import hosts
from replay.streams import ReplyStreams
from replay.wire import Status
from replay.wire_inserts import Insert, InsertReply
from tests.replay_parts import KEYS, Service, eventually, service

ROWS, BATCH = 256, 64
LARGE = RowSpec((Field("number", "i8"), Field("noise", "u8", (1023,))))
FREE = ReplayConfig(
    capacity=1024,
    min_size=ROWS,
    samples_per_insert=1e6,
    tolerance=1.0,
    priority_exponent=0.6,
)


def large_rows(start: int, count: int) -> np.ndarray:
    """Rows of 8 KB whose bytes follow from their number."""
    rows = np.zeros(count, LARGE.dtype)
    rows["number"] = np.arange(start, start + count)
    spread = np.arange(1, 1024, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    rows["noise"] = rows["number"].astype(np.uint64)[:, None] * spread
    return rows


def are_whole(rows: np.ndarray) -> bool:
    """Whether every byte is as it was written."""
    return all((row == large_rows(int(row["number"]), 1)[0]).all() for row in rows)


def fill(running: Service, session: zenoh.Session) -> Writer:
    """Writes `ROWS` rows; the writer, closed."""
    writer = Writer(session=session, keys=KEYS, spec=LARGE, writer=0, epoch=1)
    writer.append(large_rows(0, ROWS))
    assert writer.close(20.0)
    assert fetch_stats(running.client, KEYS)["inserts"] == ROWS
    return writer


@contextlib.contextmanager
def apart(
    config: ReplayConfig = FREE,
) -> Iterator[tuple[Service, zenoh.Session]]:
    """A full service, and a session that shares no memory with it."""
    with service(config, spec=LARGE) as running:
        fill(running, running.client)
        session = open_session(connect=[running.endpoint], shared_memory=False)
        try:
            yield running, session
        finally:
            session.close()


def sampler_of(session: zenoh.Session, batch_size: int = BATCH) -> Sampler:
    """Asks for a batch at a time, two ahead."""
    return Sampler(session=session, keys=KEYS, spec=LARGE, batch_size=batch_size)


def draw_until_streamed(sampler: Sampler, streamed: int) -> None:
    """Draws whole rows until so many answers have come by a stream."""

    def enough() -> bool:
        batch = sampler.sample(20.0)
        assert are_whole(batch.rows) and (batch.ids == batch.rows["number"]).all()
        return sampler.streamed >= streamed

    assert eventually(enough)


# Drawing


def test_large_answers_come_by_a_stream_and_small_ones_by_zenoh() -> None:
    with apart() as (running, session):
        large, small = sampler_of(session), sampler_of(session, 4)
        draw_until_streamed(large, 20)
        kept = [large.sample(20.0) for _ in range(12)]  # more than there are parts
        assert all(are_whole(batch.rows) for batch in kept)
        for _ in range(20):
            assert are_whole(small.sample(20.0).rows)
        assert (small.streamed, large.placed, small.placed) == (0, 0, 0)
        assert len(running.server._streams) == 1


def test_priorities_ride_with_streamed_answers_too() -> None:
    """Only row 7 keeps a priority: soon nothing else is drawn."""
    with apart() as (_, session):
        sampler = sampler_of(session)
        draw_until_streamed(sampler, 1)
        ids = np.arange(ROWS, dtype=np.uint64)
        sampler.update_priorities(ids, (ids == 7).astype(float))
        assert eventually(lambda: (sampler.sample(20.0).ids == 7).all())


def test_an_answer_waits_for_its_body() -> None:
    """Its header comes first, by another way."""
    with apart() as (running, session):
        sampler, streams_ = sampler_of(session), running.server._streams
        draw_until_streamed(sampler, 1)
        put, held = streams_.put, []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(streams_, "put", lambda *sent: held.append(sent))
            with pytest.raises(ReplayTimeout):
                for _ in range(10):  # more than were on their way
                    assert are_whole(sampler.sample(1.0).rows)
        assert len(held) == 2
        before = sampler.streamed
        for sent in held:
            put(*sent)
        draw_until_streamed(sampler, before + 2)


def test_memory_that_an_answer_did_not_need_is_used_again() -> None:
    with apart() as (running, session):
        sampler, streams_ = sampler_of(session), running.server._streams
        draw_until_streamed(sampler, 1)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(streams_, "room", lambda *_: None)
            for _ in range(20):  # more than there are parts
                assert are_whole(sampler.sample(20.0).rows)
        draw_until_streamed(sampler, sampler.streamed + 5)


def test_a_stream_brings_each_row_once_and_those_that_replace_it() -> None:
    with apart(replace(FREE, capacity=ROWS)) as (running, session):
        sampler = sampler_of(session)
        draw_until_streamed(sampler, 40)
        assert sampler._stream is not None
        assert ROWS * 0.9 < sampler._stream.kept <= ROWS
        later = Writer(session=running.client, keys=KEYS, spec=LARGE, writer=0, epoch=2)
        later.append(large_rows(ROWS, ROWS))  # all that were there are gone
        assert later.close(20.0)
        draw_until_streamed(sampler, sampler.streamed + 40)
        assert ROWS * 1.9 < sampler._stream.kept <= 2 * ROWS


def test_a_table_too_large_to_be_kept_is_sent_as_drawn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("replay.mirror.MAX_MIRROR_BYTES", 1 << 20)
    with apart() as (_, session):
        sampler = sampler_of(session)
        draw_until_streamed(sampler, 20)
        assert sampler._stream is not None and sampler._stream.kept == 0


def test_a_broken_stream_costs_no_batch_and_is_made_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("replay.sampler._STREAM_RETRY_S", 0.2)
    with apart() as (running, session):
        sampler = sampler_of(session)
        for times in range(1, 5):
            draw_until_streamed(sampler, 5 * times)
            for connection in list(running.server._streams._connections.values()):
                connection.end()


def test_without_a_stream_whole_answers_come_by_zenoh(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The service's port cannot be reached: a firewall, another address."""

    def refuse(*_: object) -> socket.socket:
        raise ConnectionRefusedError

    with apart() as (_, session):
        monkeypatch.setattr("replay.body_stream.socket.create_connection", refuse)
        sampler = sampler_of(session)
        for _ in range(30):
            assert are_whole(sampler.sample(20.0).rows)
        assert sampler.streamed == 0 and sampler._stream is not None
        assert eventually(lambda: sampler._stream.is_closed)


def test_a_dropped_sampler_ends_its_connection() -> None:
    with apart() as (running, session):
        sampler = sampler_of(session)
        draw_until_streamed(sampler, 3)
        del sampler
        assert eventually(lambda: len(running.server._streams) == 0)


# What the service's listener believes


@pytest.fixture
def offered() -> Iterator[tuple[Service, tuple[str, int], bytes]]:
    """A service, the address that it offers, and its token."""
    with service(FREE, spec=LARGE) as running:
        payload = ask(running.client, KEYS.stream, timeout_s=20.0)
        assert payload is not None
        offer = decode(payload, StreamOffer)
        ((host, port),) = offer.ports.items()
        yield running, (host, port), offer.token


@pytest.mark.parametrize("wrong", ["magic", "token", "short"])
def test_a_wrong_greeting_is_turned_away(
    wrong: str, offered: tuple[Service, tuple[str, int], bytes]
) -> None:
    running, address, token = offered
    greeting = {
        "magic": b"GET / HT" + token + bytes(17),
        "token": b"SLSTREAM" + bytes(33),
        "short": b"SLSTREAM",
    }[wrong]
    with socket.create_connection(address, 10.0) as connection:
        connection.sendall(greeting)
        connection.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionResetError):
            assert connection.recv(1) == b""
    assert len(running.server._streams) == 0


def test_whoever_says_nothing_is_turned_away(
    offered: tuple[Service, tuple[str, int], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("replay.streams._GREETING_S", 0.1)
    _, address, token = offered
    with (
        socket.create_connection(address, 10.0) as silent,
        socket.create_connection(address, 10.0) as prompt,
    ):
        prompt.sendall(b"SLSTREAM" + token + bytes(17))
        assert prompt.recv(1) == b"\x01"  # the silent one keeps nobody waiting
        assert silent.recv(1) == b""


def test_connections_are_limited(
    offered: tuple[Service, tuple[str, int], bytes],
) -> None:
    running, address, token = offered
    with contextlib.ExitStack() as stack:
        for number in range(streams._MAX_CONNECTIONS):
            connection = stack.enter_context(socket.create_connection(address, 10.0))
            connection.sendall(b"SLSTREAM" + token + number.to_bytes(16, "big") + b"\0")
            assert connection.recv(1) == b"\x01"
        late = stack.enter_context(socket.create_connection(address, 10.0))
        with contextlib.suppress(ConnectionResetError):
            assert late.recv(1) == b""
    assert eventually(lambda: len(running.server._streams) == 0)
    with socket.create_connection(address, 10.0) as again:
        again.sendall(b"SLSTREAM" + token + bytes(17))
        assert again.recv(1) == b"\x01"


def test_a_listener_that_failed_is_replaced(
    offered: tuple[Service, tuple[str, int], bytes],
) -> None:
    running, (host, port), token = offered
    running.server._streams._listeners[host].shutdown(socket.SHUT_RDWR)

    def offer() -> StreamOffer:
        payload = ask(running.client, KEYS.stream, timeout_s=20.0)
        assert payload is not None
        return decode(payload, StreamOffer)

    assert eventually(lambda: offer().ports.get(host, port) != port)
    with socket.create_connection((host, offer().ports[host]), 10.0) as again:
        again.sendall(b"SLSTREAM" + token + bytes(17))
        assert again.recv(1) == b"\x01"


@pytest.mark.parametrize("most", [streams._MAX_HELD, 3])
def test_who_does_not_read_is_answered_by_zenoh(
    most: int,
    offered: tuple[Service, tuple[str, int], bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No more is held for a connection than it may have, in number and in bytes."""
    size = 8 << 20
    if most < streams._MAX_HELD:
        monkeypatch.setattr("replay.streams._MAX_HELD_BYTES", most * size)
    running, address, token = offered
    outgoing: ReplyStreams = running.server._streams
    place = StreamPlace(name=bytes(16), number=0)
    with socket.create_connection(address, 10.0) as connection:
        connection.sendall(b"SLSTREAM" + token + bytes(17))
        assert connection.recv(1) == b"\x01"
        assert eventually(lambda: len(outgoing) == 1)
        held = 0
        while (room := outgoing.room(place, size)) is not None and held < 100:
            outgoing.put(place, room)
            held += 1
        # One is on its way besides, and the kernel may have taken another.
        assert most <= held <= most + 2
    assert eventually(lambda: len(outgoing) == 0)
    assert outgoing.room(place, size) is None


def test_there_is_no_stream_beside_encrypted_links() -> None:
    links = ["tls/10.0.0.1:7447", "quic/10.0.0.2:7447", "tcp/10.0.0.3:7447"]
    assert hosts([*links, "tcp/[fe80::1]:7447"]) == {"10.0.0.3", "fe80::1"}


# Inserting


def test_rows_are_read_from_the_writers_memory_where_they_can_be() -> None:
    """By the path that is told in the batches: with and without a place."""
    for shared in (True, False):
        with service(FREE, spec=LARGE) as running:
            session = open_session(connect=[running.endpoint], shared_memory=shared)
            writer = fill(running, session)
            assert (writer._arena is not None) == shared and writer.resent == 0
            pages = fetch_rows(session=session, keys=KEYS, spec=LARGE, page_rows=100)
            numbers = [int(n) for page in pages for n in page.rows["number"]]
            assert numbers == list(range(ROWS))
            assert are_whole(running.server._replay.sample(BATCH).rows)
            session.close()


def test_a_service_elsewhere_asks_for_the_rows_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("replay.arena._open_sealed", lambda _: None)
    with service(FREE, spec=LARGE) as running:
        writer = fill(running, running.client)
        assert 1 <= writer.resent <= 4  # those of the window
        assert not writer._may_place
        pages = fetch_rows(session=running.client, keys=KEYS, spec=LARGE)
        assert all(are_whole(page.rows) for page in pages)


@pytest.mark.parametrize("wrong", ["pid", "token", "offset", "stream"])
def test_rows_at_a_place_that_is_not_there_are_asked_for(wrong: str) -> None:
    arena = Arena(parts=1, part_bytes=4 * LARGE.row_bytes)
    place = arena.take()
    assert place is not None
    places: dict[str, MemoryPlace | StreamPlace] = {
        "pid": replace(place, pid=2**32 - 1),
        "token": replace(place, token=bytes(16)),
        "offset": replace(place, offset=place.offset + 64),
        "stream": StreamPlace(name=bytes(16), number=3),
    }
    message = Insert(
        writer=5,
        epoch=1,
        sequence=0,
        base=0,
        hold_ms=100,
        rows=LARGE.as_bytes(large_rows(0, 4)),
        place=places[wrong],
    )
    with service(FREE, spec=LARGE) as running:
        for sent, status in (
            (message, Status.ABSENT),
            (replace(message, place=place), Status.OK),
        ):
            payload = ask(
                running.client, KEYS.insert, sent.encode(LARGE), timeout_s=20.0
            )
            assert payload is not None
            reply = InsertReply.decode(payload, LARGE)
            assert (reply.status, reply.writer, reply.epoch) == (status, 5, 1)
            assert reply.next_sequence == (status is Status.OK)
