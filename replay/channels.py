"""What may be lost: status, viewer frames, and the call to stop.

Status and frames have congestion control DROP: nobody waits for a slow console or
viewer. The call to stop is small, comes once and goes first (BLOCK, high priority);
the supervisor backs it with a signal.
"""

import re
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any, final

import zenoh

from replay.control import (
    MessageT,
    StatusMessage,
    Stop,
    Value,
    decode,
    encode,
)
from replay.keys import RunKeys, plain_chunk
from replay.session import undeclare
from replay.wire import WireError

_MAX_ROLES = 16_384
_MAX_STATUS_BYTES = 1 << 16
_MAX_FRAME_BYTES = 16 << 20


@final
class StatusPublisher:
    """A role tells its counters."""

    def __init__(self, session: zenoh.Session, keys: RunKeys, role: str) -> None:
        """`role` is one plain chunk, e.g. `actor-3`."""
        self._role = plain_chunk(role, what="role")
        self._publisher = session.declare_publisher(
            keys.status(role), congestion_control=zenoh.CongestionControl.DROP
        )

    def put(self, values: dict[str, Value]) -> None:
        """Sends the current values; they may be lost."""
        self._publisher.put(encode(StatusMessage(role=self._role, values=values)))

    def close(self) -> None:
        """Stops publishing."""
        undeclare(self._publisher)


@final
class StatusSubscriber:
    """The console's view of all roles."""

    def __init__(self, session: zenoh.Session, keys: RunKeys) -> None:
        """Starts to listen to every role of the run."""
        self._lock = threading.Lock()
        self._latest: dict[str, tuple[float, dict[str, Value]]] = {}
        self.refused = 0
        """Messages that could not be read."""
        self._subscriber = session.declare_subscriber(keys.all_status, self._on_sample)

    def latest(self) -> dict[str, tuple[float, dict[str, Value]]]:
        """Per role the time of reception (`time.monotonic`) and the values."""
        with self._lock:
            return dict(self._latest)

    def close(self) -> None:
        """Stops listening."""
        undeclare(self._subscriber)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        message = _read(sample, StatusMessage)
        said_by = str(sample.key_expr).rsplit("/", 1)[1]
        with self._lock:
            known = len(self._latest) < _MAX_ROLES or said_by in self._latest
            if message is None or message.role != said_by or not known:
                self.refused += 1
            else:
                self._latest[message.role] = (time.monotonic(), message.values)


@final
class FramePublisher:
    """An actor shows its rollout to whoever watches."""

    def __init__(self, session: zenoh.Session, keys: RunKeys, actor: int) -> None:
        """Costs nothing while `wanted` is False."""
        self._publisher = session.declare_publisher(
            keys.frames(actor),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )

    @property
    def wanted(self) -> bool:
        """Whether anyone watches; frames need not be made otherwise."""
        # Zenoh's stub says bool; at run time it is an object that is always true.
        status: Any = self._publisher.matching_status
        return bool(status.matching)

    def put(self, frame: bytes) -> None:
        """Sends a frame; it may be lost."""
        self._publisher.put(frame)

    def close(self) -> None:
        """Stops publishing."""
        undeclare(self._publisher)


@final
class FrameSubscriber:
    """The viewer's end: a queue of `depth` frames that drops the oldest."""

    def __init__(self, session: zenoh.Session, keys: RunKeys, depth: int = 64) -> None:
        """Starts to listen to every actor of the run."""
        self._changed = threading.Condition()
        self._frames: deque[tuple[int, bytes]] = deque(maxlen=depth)
        self._closed = False
        self.dropped = 0
        """Frames pushed out because they were not taken in time."""
        self._subscriber = session.declare_subscriber(keys.all_frames, self._on_sample)

    def get(self, timeout: float | None = None) -> tuple[int, bytes] | None:
        """The oldest frame kept, as (actor, bytes); None if there is none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._closed, timeout)
            return self._frames.popleft() if self._frames else None

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Frames as they come, until `close`."""
        while (frame := self.get()) is not None:
            yield frame

    def close(self) -> None:
        """Stops listening and ends the iteration."""
        undeclare(self._subscriber)
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        actor = str(sample.key_expr).rsplit("/", 1)[1]
        if not re.fullmatch(r"[0-9]{1,10}", actor):
            return
        if len(sample.payload) > _MAX_FRAME_BYTES:
            return
        with self._changed:
            self.dropped += len(self._frames) == self._frames.maxlen
            self._frames.append((int(actor), sample.payload.to_bytes()))
            self._changed.notify_all()


@final
class ControlSubscriber:
    """Sets `stop` when the run is called off."""

    def __init__(self, session: zenoh.Session, keys: RunKeys) -> None:
        """Starts to listen."""
        self.stop = threading.Event()
        self.reason = ""
        self._subscriber = session.declare_subscriber(keys.control, self._on_sample)

    def close(self) -> None:
        """Stops listening."""
        undeclare(self._subscriber)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        message = _read(sample, Stop)
        if message is not None:
            self.reason = message.reason
            self.stop.set()


def send_stop(session: zenoh.Session, keys: RunKeys, reason: str) -> None:
    """Tells every role of the run to end."""
    session.put(
        keys.control,
        encode(Stop(reason=reason)),
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.INTERACTIVE_HIGH,
    )


def _read(sample: zenoh.Sample, kind: type[MessageT]) -> MessageT | None:
    """The message, or None: what may be lost may also be unreadable."""
    if len(sample.payload) > _MAX_STATUS_BYTES:
        return None
    try:
        return decode(sample.payload.to_bytes(), kind)
    except WireError:
        return None
