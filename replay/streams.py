"""The service's side of `replay.stream_frames`: listens where asked to, and sends.

The service listens only once somebody asks, only on addresses at which Zenoh links
came in, and only where those are plain TCP: whoever encrypts Zenoh's links gets no
stream beside them. The token is as secret as the run's other traffic. What else the
service checks: a greeting within seconds, the number of connections, and how much it
holds for one that does not read.
"""

import secrets
import socket
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, Final, final

import zenoh

from replay.control import StreamOffer
from replay.mirror import SentRows
from replay.places import NAME_BYTES, StreamPlace
from replay.stream_frames import (
    FRAME,
    GREETING_BYTES,
    KEEPS,
    MAGIC,
    WELCOME,
    end,
    hosts,
    receive,
    tuned,
)

_GREETING_S: Final = 5.0
_MAX_CONNECTIONS: Final = 64
_MAX_HELD: Final = 8  # bodies that wait to be sent on a connection
_MAX_HELD_BYTES: Final = 256 << 20


@final
class _Outgoing:
    """One sampler's connection: bodies wait for a thread that sends them in order."""

    def __init__(
        self,
        connection: socket.socket,
        on_end: Callable[[], None],
        sent: SentRows | None,
    ) -> None:
        self.sent = sent  # None: the sampler keeps nothing
        self._connection = connection
        self._on_end = on_end
        self._waiting: SimpleQueue[tuple[int, memoryview] | None] = SimpleQueue()
        # Sent and free again: fresh memory would cost a fault for every page.
        self._free: deque[memoryview] = deque(maxlen=_MAX_HELD)
        threading.Thread(target=self._run, name="stream", daemon=True).start()

    def room(self, length: int) -> memoryview | None:
        """Memory for a body; None if too much waits to be sent."""
        held = self._waiting.qsize()
        if held >= _MAX_HELD or (held and (held + 1) * length > _MAX_HELD_BYTES):
            return None
        while self._free:
            room = self._free.pop()  # the last one: it is in the cache
            if len(room) == length:
                return room
        return memoryview(bytearray(length))

    def put(self, number: int, body: memoryview) -> None:
        """Sends a body, later, which begins a room; nobody may write to that now."""
        self._waiting.put((number, body))

    def end(self) -> None:
        """Closes; what waits is not sent."""
        end(self._connection)
        self._waiting.put(None)

    def _run(self) -> None:
        try:
            while (item := self._waiting.get()) is not None:
                number, body = item
                head = FRAME.pack(number, len(body))
                more = getattr(socket, "MSG_MORE", 0)  # no packet of its own
                self._connection.sendall(head, more)
                self._connection.sendall(body)
                self._free.append(memoryview(body.obj))
        except OSError:
            pass  # the sampler notices too, and asks again
        finally:
            self._on_end()
            end(self._connection)


@final
class ReplyStreams:
    """The service's side: listens where it is asked to, and sends bodies."""

    def __init__(self, *, capacity: int) -> None:
        """Listens nowhere yet. `capacity`: of the table."""
        self._capacity = capacity
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
        for host in hosts(str(link.src) for link in links):
            if host not in self._listeners:
                self._listen(host)
        ports = {}
        for host, listener in list(self._listeners.items()):
            with suppress(OSError):  # it has just been closed
                ports[host] = listener.getsockname()[1]
        return StreamOffer(ports=ports, token=self._token, capacity=self._capacity)

    def room(self, place: StreamPlace, length: int) -> memoryview | None:
        """Memory for the body of an answer; None if it has to go by Zenoh."""
        connection = self._connections.get(place.name)
        return connection.room(length) if connection is not None else None

    def sent(self, place: StreamPlace) -> SentRows | None:
        """What was sent to the sampler; None if it keeps nothing."""
        connection = self._connections.get(place.name)
        return connection.sent if connection is not None else None

    def put(self, place: StreamPlace, body: memoryview) -> None:
        """Sends what `room` gave, or the beginning of it."""
        connection = self._connections.get(place.name)
        if connection is not None:  # else its sampler knows that it has ended
            connection.put(place.number, body)

    def close(self) -> None:
        """Ends all connections."""
        self._ended = True
        for listener in list(self._listeners.values()):
            end(listener)
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
        greeting = bytearray(GREETING_BYTES)
        try:
            connection.settimeout(_GREETING_S)
            receive(connection, memoryview(greeting))
            magic, rest = greeting[: len(MAGIC)], greeting[len(MAGIC) :]
            token, name = bytes(rest[:NAME_BYTES]), bytes(rest[NAME_BYTES:-1])
            known = secrets.compare_digest(token, self._token)
            keeps = rest[-1:] == KEEPS
            if magic != MAGIC or not known or name in self._connections:
                raise ConnectionRefusedError("not a sampler of this run")
            connection.settimeout(None)
            tuned(connection)
            connection.sendall(WELCOME)
        except OSError:
            connection.close()
            self._greeting.release()
            return

        def on_end() -> None:
            self._connections.pop(name, None)
            self._greeting.release()

        sent = SentRows(self._capacity) if keeps else None
        outgoing = _Outgoing(connection, on_end, sent)
        self._connections[name] = outgoing
        with suppress(OSError):
            if not self._ended:
                connection.recv(1)  # nothing more is said: this waits for the end
        outgoing.end()
