"""Sampled rows by a TCP connection of their own, beside Zenoh.

Zenoh's TCP cuts an answer into fragments, copies each several times and hands it from
thread to thread: 8 to 9 us of CPU time for 8 KB, both ends together. A plain socket
takes 3. So a sampler that cannot share memory with its service (`replay.arena`)
connects to it once more, and large answers are divided: the header comes by Zenoh as
ever, the body (ids, probabilities, rows) by the stream. Where there is no stream, the
whole answer comes by Zenoh; nothing has to be configured, and losing a stream costs
only the answers that were in it, as losing a Zenoh link would.

    sampler    asks by Zenoh for an offer: addresses and a secret token
               connects, sends MAGIC, the token, and a name for the connection
    service    one byte: welcome
    sampler    names the connection and a number in each sample request
    service    number u64, length u64, body; and the header by Zenoh

The service listens only once somebody asks, only on addresses at which Zenoh links
came in, and only where those are plain TCP: whoever encrypts Zenoh's links gets no
stream beside them. The token is as secret as the run's other traffic. What else the
service checks: a greeting within seconds, the number of connections, and how much it
holds for one that does not read.
"""

import secrets
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, Final, final

import zenoh

from replay.control import StreamOffer, decode
from replay.keys import RunKeys
from replay.places import NAME_BYTES, StreamPlace
from replay.session import ask
from replay.spec import ReplayError

LEAST_BYTES: Final = 256 << 10  # of a body: smaller ones cost less in the answer
_MAGIC: Final = b"SLSTREAM"
_WELCOME: Final = b"\x01"
_GREETING_BYTES: Final = len(_MAGIC) + 2 * NAME_BYTES
_FRAME: Final = struct.Struct("<QQ")
_GREETING_S: Final = 5.0
_DEAD_S: Final = 20  # of silence on a link that should not be silent
_MAX_CONNECTIONS: Final = 64
_MAX_HELD: Final = 8  # bodies that wait to be sent on a connection
_MAX_HELD_BYTES: Final = 256 << 20


def _tuned(connection: socket.socket) -> socket.socket:
    """Notices a peer that is gone without a word; does not wait to fill packets."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", _DEAD_S // 4),
        ("TCP_KEEPINTVL", _DEAD_S // 4),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", _DEAD_S * 1000),
    ):
        number = getattr(socket, option, None)  # not everywhere but on Linux
        if number is not None:
            connection.setsockopt(socket.IPPROTO_TCP, number, value)
    return connection


def _hosts(locators: Iterable[str]) -> set[str]:
    """The numeric hosts of plain TCP links, `tcp/HOST:PORT`."""
    addresses = [text.removeprefix("tcp/") for text in locators if text[:4] == "tcp/"]
    return {address.rpartition(":")[0].strip("[]") for address in addresses}


def _receive(connection: socket.socket, into: memoryview) -> None:
    """Fills the memory; raises `OSError` if the connection ends before."""
    while into:
        got = connection.recv_into(into, len(into), socket.MSG_WAITALL)
        if not got:
            raise ConnectionResetError("the stream has ended")
        into = into[got:]


def _end(connection: socket.socket) -> None:
    """Ends a connection that a thread may be waiting on."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()


# The service's side


@final
class _Outgoing:
    """One sampler's connection: bodies wait for a thread that sends them in order."""

    def __init__(self, connection: socket.socket, on_end: Callable[[], None]) -> None:
        self._connection = connection
        self._on_end = on_end
        self._waiting: SimpleQueue[tuple[int, memoryview] | None] = SimpleQueue()
        # Sent and free again: fresh memory would cost a fault for every page.
        self._free: deque[memoryview] = deque(maxlen=_MAX_HELD)
        self._held_bytes = 0
        threading.Thread(target=self._run, name="stream", daemon=True).start()

    def room(self, length: int) -> memoryview | None:
        """Memory for a body; None if too much waits to be sent."""
        held = self._waiting.qsize()
        if held >= _MAX_HELD or (held and (held + 1) * length > _MAX_HELD_BYTES):
            return None
        while self._free:
            room = self._free.popleft()
            if len(room) == length:
                return room
        return memoryview(bytearray(length))

    def put(self, number: int, body: memoryview) -> None:
        """Sends a body, later; it must not be written to any more."""
        self._waiting.put((number, body))

    def end(self) -> None:
        """Closes; what waits is not sent."""
        _end(self._connection)
        self._waiting.put(None)

    def _run(self) -> None:
        try:
            while (item := self._waiting.get()) is not None:
                number, body = item
                head = _FRAME.pack(number, len(body))
                more = getattr(socket, "MSG_MORE", 0)  # no packet of its own
                self._connection.sendall(head, more)
                self._connection.sendall(body)
                self._free.append(body)
        except OSError:
            pass  # the sampler notices too, and asks again
        finally:
            self._on_end()
            _end(self._connection)


@final
class ReplyStreams:
    """The service's side: listens where it is asked to, and sends bodies."""

    def __init__(self) -> None:
        """Listens nowhere yet."""
        self._token = secrets.token_bytes(NAME_BYTES)
        self._listeners: dict[str, socket.socket] = {}
        self._connections: dict[bytes, _Outgoing] = {}
        self._greeting = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        self._ended = False

    def __len__(self) -> int:
        """How many samplers are connected."""
        return len(self._connections)

    def offer(self, session: zenoh.Session) -> StreamOffer:
        """Where to connect: the addresses by which the session is reached now."""
        links: list[Any] = session.info.links()
        for host in _hosts(str(link.src) for link in links):
            if host not in self._listeners:
                self._listen(host)
        ports = {}
        for host, listener in list(self._listeners.items()):
            with suppress(OSError):  # it has just been closed
                ports[host] = listener.getsockname()[1]
        return StreamOffer(ports=ports, token=self._token)

    def room(self, place: StreamPlace, length: int) -> memoryview | None:
        """Memory for the body of an answer; None if it has to go by Zenoh."""
        connection = self._connections.get(place.name)
        return connection.room(length) if connection is not None else None

    def put(self, place: StreamPlace, body: memoryview) -> None:
        """Sends what `room` gave, filled."""
        connection = self._connections.get(place.name)
        if connection is not None:  # else its sampler knows that it has ended
            connection.put(place.number, body)

    def close(self) -> None:
        """Ends all connections."""
        self._ended = True
        for listener in list(self._listeners.values()):
            _end(listener)
        for connection in list(self._connections.values()):
            connection.end()

    def _listen(self, host: str) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.create_server((host, 0), family=family)
        except OSError:
            return  # then there is none, and answers go by Zenoh
        self._listeners[host] = listener
        threading.Thread(target=self._accept, args=(host,), daemon=True).start()

    def _accept(self, host: str) -> None:
        listener = self._listeners[host]
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:  # it was closed, or no more files may be opened
                self._listeners.pop(host, None)  # the next offer listens anew
                listener.close()
                return
            if not self._greeting.acquire(blocking=False):
                connection.close()
                continue
            # Not here: whoever says nothing must not keep others waiting.
            threading.Thread(
                target=self._greet, args=(connection,), daemon=True
            ).start()

    def _greet(self, connection: socket.socket) -> None:
        """Takes a connection in whose greeting is right."""
        greeting = bytearray(_GREETING_BYTES)
        try:
            connection.settimeout(_GREETING_S)
            _receive(connection, memoryview(greeting))
            magic, rest = greeting[: len(_MAGIC)], greeting[len(_MAGIC) :]
            token, name = bytes(rest[:NAME_BYTES]), bytes(rest[NAME_BYTES:])
            known = secrets.compare_digest(token, self._token)
            if magic != _MAGIC or not known or name in self._connections:
                raise ConnectionRefusedError("not a sampler of this run")
            connection.settimeout(None)
            _tuned(connection)
            connection.sendall(_WELCOME)
        except OSError:
            connection.close()
            self._greeting.release()
            return

        def on_end() -> None:
            self._connections.pop(name, None)
            self._greeting.release()

        outgoing = _Outgoing(connection, on_end)
        self._connections[name] = outgoing
        with suppress(OSError):
            if not self._ended:
                connection.recv(1)  # nothing more is said: this waits for the end
        outgoing.end()


# The sampler's side


@final
class BodyStream:
    """Receives bodies into memory that was named for them. Connects by itself."""

    def __init__(
        self,
        *,
        session: zenoh.Session,
        keys: RunKeys,
        timeout_s: float = 5.0,
    ) -> None:
        """`timeout_s`: for each step of connecting."""
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
            _end(self._connection)

    def _run(self) -> None:
        try:
            with self._connect() as connection:
                self._connection = connection
                while not self._closed:
                    self._take(connection)
        except (OSError, ReplayError, zenoh.ZError):
            pass  # answers come by Zenoh then
        finally:
            self._closed = True
            while self._expected:
                _, (_, on_end) = self._expected.popitem()
                on_end(False)

    def _connect(self) -> socket.socket:
        """By the address at which this session reaches the service."""
        payload = ask(self._session, self._keys.stream, timeout_s=self._timeout_s)
        if payload is None:
            raise ConnectionRefusedError("no offer")
        offer = decode(payload, StreamOffer)
        links: list[Any] = self._session.info.links()
        for host in _hosts(str(link.dst) for link in links) & offer.ports.keys():
            address = host, offer.ports[host]
            connection = socket.create_connection(address, self._timeout_s)
            try:
                connection.sendall(_MAGIC + offer.token + self._name)
                _receive(connection, memoryview(bytearray(len(_WELCOME))))
                connection.settimeout(None)
                return _tuned(connection)
            except OSError:
                connection.close()
        raise ConnectionRefusedError("none of the addresses offered is the service's")

    def _take(self, connection: socket.socket) -> None:
        """One body; what nobody expects any more is read and dropped."""
        head = bytearray(_FRAME.size)
        _receive(connection, memoryview(head))
        number, length = _FRAME.unpack(head)
        room, on_end = self._expected.pop(number, (None, None))
        if room is None or on_end is None:
            drain = memoryview(bytearray(min(length, LEAST_BYTES)))
            while length:
                part = drain[:length]
                _receive(connection, part)
                length -= len(part)
            return
        whole = False
        try:
            if len(room) != length:
                raise ConnectionAbortedError("a body of another length than asked for")
            _receive(connection, room)
            whole = True
        finally:
            on_end(whole)
