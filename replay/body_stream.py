"""The sampler's side of `replay.stream_frames`: connects, and receives bodies."""

import secrets
import socket
import threading
from collections.abc import Callable
from typing import Any, final

import numpy as np
import zenoh

from replay.control import StreamOffer, decode
from replay.keys import RunKeys
from replay.mirror import Mirror, may_mirror
from replay.places import NAME_BYTES, StreamPlace
from replay.session import ask
from replay.spec import ReplayError, RowSpec
from replay.stream_frames import (
    FRAME,
    KEEPS,
    KEEPS_NOT,
    LEAST_BYTES,
    MAGIC,
    WELCOME,
    end,
    hosts,
    receive,
    tuned,
)


@final
class BodyStream:
    """Receives bodies into memory that was named for them. Connects by itself.

    Keeps the rows that come, if the table is not too large (`replay.mirror`).
    """

    def __init__(
        self,
        *,
        session: zenoh.Session,
        keys: RunKeys,
        spec: RowSpec,
        count: int,
        timeout_s: float = 5.0,
    ) -> None:
        """`count`: rows of a body; `timeout_s`: for each step of connecting."""
        self._row_bytes = spec.row_bytes
        self._count = count
        self._mirror: Mirror | None = None
        self._name = secrets.token_bytes(NAME_BYTES)
        self._session = session
        self._keys = keys
        self._timeout_s = timeout_s
        self._expected: dict[int, tuple[memoryview, Callable[[bool], object]]] = {}
        self._connection: socket.socket | None = None
        self._closed = False
        threading.Thread(target=self._run, name="stream", daemon=True).start()

    @property
    def is_open(self) -> bool:
        """Whether bodies can come now."""
        return self._connection is not None and not self._closed

    @property
    def is_closed(self) -> bool:
        """Whether none can come any more."""
        return self._closed

    @property
    def kept(self) -> int:
        """Rows that came to be kept; 0 where every body brings all of its own."""
        return self._mirror.kept if self._mirror else 0

    def expect(
        self, number: int, room: memoryview, on_end: Callable[[bool], object]
    ) -> StreamPlace | None:
        """Where to ask for this body; None if the stream has ended.

        `on_end` is told, by the stream's thread, whether the body is in `room` now, or
        never will be.
        """
        self._expected[number] = room, on_end
        if not self.is_open and self._expected.pop(number, None) is not None:
            return None
        return StreamPlace(name=self._name, number=number)

    def forget(self, number: int) -> None:
        """The body does not come, or is of no use."""
        self._expected.pop(number, None)

    def close(self) -> None:
        """Ends the connection, and with it the thread."""
        self._closed = True
        if self._connection is not None:
            end(self._connection)

    def _run(self) -> None:
        try:
            with self._connect() as connection:
                take = self._take_lacking if self._mirror else self._take
                self._connection = connection
                while not self._closed:
                    head = bytearray(FRAME.size)
                    receive(connection, memoryview(head))
                    take(connection, *FRAME.unpack(head))
        except (OSError, ReplayError, zenoh.ZError):
            pass  # answers come by Zenoh then
        finally:
            self._closed = True
            self._mirror = None  # the next connection begins with nothing
            while self._expected:
                _, (_, on_end) = self._expected.popitem()
                on_end(False)

    def _connect(self) -> socket.socket:
        """By the address at which this session reaches the service."""
        payload = ask(self._session, self._keys.stream, timeout_s=self._timeout_s)
        if payload is None:
            raise ConnectionRefusedError("no offer")
        offer = decode(payload, StreamOffer)
        keeps = may_mirror(offer.capacity, self._row_bytes)
        if keeps:
            self._mirror = Mirror(capacity=offer.capacity, row_bytes=self._row_bytes)
            self._body = np.zeros(self._count * (16 + self._row_bytes), np.uint8)
        links: list[Any] = self._session.info.links()
        for host in hosts(str(link.dst) for link in links) & offer.ports.keys():
            address = host, offer.ports[host]
            connection = socket.create_connection(address, self._timeout_s)
            try:
                greeting = MAGIC + offer.token + self._name
                connection.sendall(greeting + (KEEPS if keeps else KEEPS_NOT))
                receive(connection, memoryview(bytearray(len(WELCOME))))
                connection.settimeout(None)
                return tuned(connection)
            except OSError:
                connection.close()
        raise ConnectionRefusedError("none of the addresses offered is the service's")

    def _take_lacking(
        self, connection: socket.socket, number: int, length: int
    ) -> None:
        """One body of which rows are kept, also where nobody expects it any more."""
        assert self._mirror is not None
        head = 16 * self._count
        if not head <= length <= len(self._body) or (length - head) % self._row_bytes:
            raise ConnectionAbortedError("a body of another length than asked for")
        receive(connection, self._body.data[:length])
        ids = self._body[: head // 2].view("<u8")
        rows = self._body[head:length].reshape(-1, self._row_bytes)
        if not self._mirror.keep(ids, rows):
            raise ConnectionAbortedError("other rows than the sampler lacks")
        room, on_end = self._expected.pop(number, (None, None))
        if room is None or on_end is None:
            return
        room[:head] = self._body.data[:head]
        out = np.frombuffer(room, np.uint8, offset=head)
        self._mirror.gather(ids, out.reshape(self._count, self._row_bytes))
        on_end(True)

    def _take(self, connection: socket.socket, number: int, length: int) -> None:
        """One whole body; what nobody expects any more is read and dropped."""
        room, on_end = self._expected.pop(number, (None, None))
        if room is None or on_end is None:
            drain = memoryview(bytearray(min(length, LEAST_BYTES)))
            while length:
                part = drain[:length]
                receive(connection, part)
                length -= len(part)
            return
        whole = False
        try:
            if len(room) != length:
                raise ConnectionAbortedError("a body of another length than asked for")
            receive(connection, room)
            whole = True
        finally:
            on_end(whole)
