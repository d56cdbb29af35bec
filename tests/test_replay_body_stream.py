"""What a sampler's stream makes of what it is sent; the test is the service."""

import contextlib
import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from replay.body_stream import BodyStream
from replay.control import StreamOffer, encode
from replay.local import ReplayConfig
from replay.session import direct, open_session
from replay.spec import Field, RowSpec
from tests.replay_parts import KEYS, eventually, service

SMALL = RowSpec((Field("number", "i8"),))


@dataclass
class Fake:
    """A service of which the test is the other end."""

    stream: BodyStream
    connection: socket.socket


@contextlib.contextmanager
def fake(capacity: int = 0) -> Iterator[Fake]:
    """A stream to a listener of the test, of bodies of two rows."""
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        service(ReplayConfig(), spec=SMALL) as running,
        open_session(connect=[running.endpoint]) as session,
    ):
        ports = {"127.0.0.1": listener.getsockname()[1]}
        offer = encode(StreamOffer(ports=ports, token=bytes(16), capacity=capacity))
        keys = replace(KEYS, run_id="fake")

        def answer(query: Any) -> None:
            with query:
                query.reply(query.key_expr, offer)

        queryable = session.declare_queryable(keys.stream, direct(answer))
        stream = BodyStream(session=session, keys=keys, spec=SMALL, count=2)
        connection, _ = listener.accept()
        with connection:
            greeting = connection.recv(41, socket.MSG_WAITALL)
            assert greeting[:8] == b"SLSTREAM" and greeting[40] == (capacity > 0)
            connection.sendall(b"\x01")
            assert eventually(lambda: stream.is_open)
            yield Fake(stream, connection)
        stream.close()
        queryable.undeclare()


def test_bodies_are_received_where_they_belong_and_others_dropped() -> None:
    with fake() as peer:
        rooms = [bytearray(5) for _ in range(2)]
        ends: list[tuple[int, bool]] = []
        ended = threading.Event()
        for number, room in enumerate(rooms):

            def on_end(is_whole: bool, number: int = number) -> None:
                ends.append((number, is_whole))
                ended.set()

            assert peer.stream.expect(number, memoryview(room), on_end) is not None
        peer.stream.forget(0)
        for number, body in ((0, b"early"), (9, bytes(700_000)), (1, b"right")):
            peer.connection.sendall(struct.pack("<QQ", number, len(body)) + body)
        assert ended.wait(20.0) and ends == [(1, True)]
        assert rooms == [bytearray(5), bytearray(b"right")]


def body(ids: list[int], numbers: list[int]) -> bytes:
    """Ids, probabilities and rows of `fake`'s bodies."""
    rows = np.zeros(len(numbers), SMALL.dtype)
    rows["number"] = numbers
    return struct.pack("<2Q2d", *ids, 0.5, 0.5) + rows.tobytes()


def test_lacking_rows_are_kept_also_from_bodies_that_nobody_expects() -> None:
    with fake(capacity=4) as peer:
        room, ends = bytearray(len(body([0, 1], [10, 11]))), []
        assert peer.stream.expect(7, memoryview(room), ends.append) is not None
        for number, sent in ((3, body([0, 1], [10, 11])), (7, body([2, 1], [12]))):
            peer.connection.sendall(struct.pack("<QQ", number, len(sent)) + sent)
        assert eventually(lambda: ends == [True]) and peer.stream.kept == 3
        assert bytes(room) == body([2, 1], [12, 11])
        peer.connection.shutdown(socket.SHUT_RDWR)
        assert eventually(lambda: peer.stream.is_closed and peer.stream.kept == 0)


@pytest.mark.parametrize("wrong", ["missing", "odd", "short", "long"])
def test_a_body_of_other_rows_than_are_lacking_ends_the_stream(wrong: str) -> None:
    sent = {
        "missing": body([0, 1], [10]),
        "odd": body([0, 1], [10, 11])[:-1],
        "short": bytes(31),
        "long": body([0, 1], [10, 11, 12]),
    }[wrong]
    with fake(capacity=4) as peer:
        ends: list[bool] = []
        room = memoryview(bytearray(len(body([0, 1], [10, 11]))))
        assert peer.stream.expect(7, room, ends.append) is not None
        peer.connection.sendall(struct.pack("<QQ", 7, len(sent)) + sent)
        assert eventually(lambda: peer.stream.is_closed and ends == [False])


@pytest.mark.parametrize("fault", ["length", "cut", "gone"])
def test_a_body_that_does_not_come_whole_ends_the_stream(fault: str) -> None:
    with fake() as peer:
        ends: list[bool] = []
        place = peer.stream.expect(3, memoryview(bytearray(8)), ends.append)
        assert place is not None and place.number == 3
        if fault == "length":
            peer.connection.sendall(struct.pack("<QQ", 3, 2**62) + bytes(8))
        elif fault == "cut":
            peer.connection.sendall(struct.pack("<QQ", 3, 8) + bytes(3))
        if fault != "length":
            peer.connection.shutdown(socket.SHUT_RDWR)
        assert eventually(lambda: peer.stream.is_closed and ends == [False])
        assert peer.stream.expect(4, memoryview(bytearray(8)), ends.append) is None
        assert ends == [False]
