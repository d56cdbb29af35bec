"""The learner's end: batches are asked for ahead, priorities ride in the queries."""

import queue
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator
from typing import final

import numpy as np
import zenoh
from jaxtyping import Float, Integer

from replay.arena import Arena, make_arena
from replay.body_stream import BodyStream
from replay.keys import RunKeys
from replay.places import Place
from replay.session import direct, shares_memory
from replay.spec import ReplayError, ReplayTimeout, RowSpec, Sample
from replay.stream_frames import LEAST_BYTES
from replay.wire import (
    SampleReply,
    SampleRequest,
    Status,
    WireError,
    body_bytes,
    is_placed,
)

_ANSWER_MARGIN_S = 5.0  # between the service's last moment to answer and giving up
_STREAM_RETRY_S = 10.0  # between two tries to have a stream
_RETRY_S = (0.02, 1.0)  # first and longest pause after an answer that did not come


@final
class _Request:
    """A sample query in flight: ends with exactly one event."""

    def __init__(
        self,
        *,
        number: int,
        updates: list[tuple[np.ndarray, np.ndarray]],
        events: "queue.SimpleQueue[tuple[_Request, zenoh.ZBytes | None]]",
        on_answer: Callable[[], object],
        arena: Arena | None,
    ) -> None:
        self.number = number
        self.updates = updates
        self.arena = arena
        self.part = arena.take() if arena else None
        self._events = events
        self._on_answer = on_answer
        self._lock = threading.Lock()  # replies and bodies come by different threads
        self._reply: zenoh.ZBytes | None = None
        self._lacks_body = False
        self._has_ended = False

    def by(self, stream: BodyStream | None, length: int) -> Place | None:
        """Where the body of the answer may be put."""
        if stream is None or self.part is None or self.arena is None:
            return self.part
        self._lacks_body = True
        room = self.arena.room(self.part, length)
        return stream.expect(self.number, room, self.on_body)

    def on_reply(self, reply: zenoh.Reply) -> None:
        """Hands the payload to the sampling thread, unless a body is to come."""
        if reply.ok is None:
            return
        payload = reply.ok.payload
        with self._lock:
            self._reply = payload
            waits = self._lacks_body and is_placed(payload)
        if not waits:
            self._end(payload)

    def on_body(self, is_whole: bool) -> None:
        """A stream brought the body, or never will."""
        with self._lock:
            self._lacks_body = not is_whole
            reply = self._reply
        if not is_whole:
            self._end(None)
        elif reply is not None:
            self._end(reply)

    def on_end(self) -> None:
        """An end without a reply is a failure, e.g. a service that was killed."""
        if self._reply is None:
            self._end(None)

    def _end(self, payload: zenoh.ZBytes | None) -> None:
        with self._lock:
            if self._has_ended:
                return
            self._has_ended = True
        self._events.put((self, payload))
        self._on_answer()


@final
class Sampler:
    """The learner's end: keeps `in_flight` queries going. For one thread only."""

    def __init__(
        self,
        *,
        session: zenoh.Session,
        keys: RunKeys,
        spec: RowSpec,
        batch_size: int,
        batches_per_reply: int = 1,
        in_flight: int = 2,
        hold_s: float = 2.0,
        on_answer: Callable[[], object] = lambda: None,
    ) -> None:
        """`hold_s`: how long the service may wait for its limiter per query.

        `on_answer` is called on Zenoh's thread when a query has ended.
        A service on this machine puts the rows into this process's memory
        (`replay.arena`) if the session was opened with shared memory; from elsewhere,
        large answers come by a stream (`replay.stream_frames`).
        """
        if min(batch_size, batches_per_reply, in_flight) < 1:
            raise ReplayError(
                f"batch_size={batch_size}, batches_per_reply={batches_per_reply} and "
                f"in_flight={in_flight} must all be at least 1"
            )
        self._session = session
        self._keys = keys
        self._key = keys.sample
        self._spec = spec
        self._batch_size = batch_size
        self._batches = batches_per_reply
        self._in_flight = in_flight
        self._hold_s = hold_s
        self.stream_bytes = LEAST_BYTES
        """Of an answer's rows, from which on they come by a stream, not by Zenoh."""
        self._on_answer = on_answer
        self._shared_memory = shares_memory(session)
        self._arena: Arena | None = None
        self._placed = self._streamed = self._asked = 0
        self._stream: BodyStream | None = None
        self._stream_due = 0.0  # time.monotonic
        self._let_go: Callable[[], object] = lambda: None  # of the last stream
        self._body_bytes = body_bytes(spec, batch_size * batches_per_reply)
        self._events: queue.SimpleQueue[tuple[_Request, zenoh.ZBytes | None]]
        self._events = queue.SimpleQueue()
        self._outstanding = 0
        self._ready: deque[Sample] = deque()
        self._updates: list[tuple[np.ndarray, np.ndarray]] = []
        self._failures = 0
        self._retry_at = 0.0
        self._waited_s = 0.0

    @property
    def waited_s(self) -> float:
        """Total time that `sample` has spent waiting for an answer."""
        return self._waited_s

    @property
    def placed(self) -> int:
        """Answers whose rows the service put into this process's memory."""
        return self._placed

    @property
    def streamed(self) -> int:
        """Answers whose rows came by a stream."""
        return self._streamed

    def sample(self, timeout: float) -> Sample:
        """The next batch; raises `ReplayTimeout` after `timeout` seconds."""
        deadline = time.monotonic() + timeout
        while not self._ready:
            self._collect()
            self._send()
            if self._ready:
                break
            left = deadline - time.monotonic()
            if left <= 0:
                raise ReplayTimeout(
                    f"no sample from {self._key} within {timeout:g} s; is the replay "
                    "service up, and do actors insert?"
                )
            self._wait(left)
        batch = self._ready.popleft()
        self._collect()
        self._send()  # replaces what was used while the caller computes
        return batch

    def update_priorities(
        self,
        ids: Integer[np.ndarray, " updates"],
        priorities: Float[np.ndarray, " priorities"],
    ) -> None:
        """New priorities, |TD error|; they ride in the next sample query."""
        new = np.asarray(priorities, np.float64)
        if len(ids) != len(new):
            raise ReplayError(f"{len(ids)} ids but {len(new)} priorities")
        if not (np.isfinite(new).all() and (new >= 0).all()):
            raise ReplayError(
                "priorities must be finite and >= 0; NaN or infinity here means that "
                "the loss has diverged"
            )
        self._updates.append((np.asarray(ids, np.uint64), new))

    def _send(self) -> None:
        """Tops up the queries in flight, unless it is too early to try again."""
        if time.monotonic() < self._retry_at:
            return
        # What has come and was not taken counts too: a learner slower than the service
        # would otherwise work through an ever longer queue of old draws.
        kept = -(-len(self._ready) // self._batches)
        while self._outstanding + kept < self._in_flight:
            updates, self._updates = self._updates, []
            stream = self._open_stream()
            request = _Request(
                number=self._asked,
                updates=updates,
                events=self._events,
                on_answer=self._on_answer,
                arena=self._open_arena(),
            )
            self._asked += 1
            message = SampleRequest(
                batch_size=self._batch_size,
                batches=self._batches,
                hold_ms=int(self._hold_s * 1e3),
                ids=np.concatenate([np.zeros(0, np.uint64)] + [u[0] for u in updates]),
                priorities=np.concatenate([np.zeros(0)] + [u[1] for u in updates]),
                place=request.by(stream, self._body_bytes),
            )
            self._outstanding += 1
            self._session.get(
                self._key,
                direct(request.on_reply, request.on_end),
                payload=message.encode(self._spec),
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.BLOCK,
                timeout=self._hold_s + _ANSWER_MARGIN_S,
            )

    def _open_stream(self) -> BodyStream | None:
        """The way for bodies from elsewhere; None while there is none."""
        if self._shared_memory or self._body_bytes < self.stream_bytes:
            return None
        if self._stream is not None and self._stream.is_open:
            return self._stream
        now = time.monotonic()
        if (self._stream is None or self._stream.is_closed) and now >= self._stream_due:
            self._stream_due = now + _STREAM_RETRY_S
            self._stream = BodyStream(
                session=self._session,
                keys=self._keys,
                spec=self._spec,
                count=self._batch_size * self._batches,
            )
            self._let_go()
            self._let_go = weakref.finalize(self, self._stream.close)
        return None

    def _open_arena(self) -> Arena | None:
        """Memory for bodies that do not come in their answers, if any may."""
        by_stream = self._stream is not None and self._stream.is_open
        if self._arena is None and (self._shared_memory or by_stream):
            # One part for each query in flight and as many that the caller looks at,
            # and one for each that it has just taken.
            self._arena = make_arena(
                parts=2 * self._in_flight + 2, part_bytes=self._body_bytes
            )
            self._shared_memory &= self._arena is not None
        return self._arena

    def _give_up_arena(self) -> None:
        """What is lent stays valid; the next query that names a place has a new one."""
        if self._arena is not None:
            self._arena.close()
            self._arena = None

    def _decode(self, request: _Request, payload: bytes) -> SampleReply:
        """The answer; its part of the arena is lent to its rows, or free again."""
        arena, part = request.arena, request.part
        if arena is None or part is None:
            return SampleReply.decode(payload, self._spec)
        used = False

        def view(length: int) -> np.ndarray:
            nonlocal used
            used = True
            return arena.view(part, length)

        reply = SampleReply.decode(payload, self._spec, view)
        if used and self._shared_memory:
            self._placed += 1
        elif used:
            self._streamed += 1
        else:
            arena.give_back(part)
            self._forget(request)
            if self._shared_memory and reply.sample is not None:
                self._shared_memory = False  # the service is somewhere else
                self._give_up_arena()
        return reply

    def _forget(self, request: _Request) -> None:
        """No body is to be expected any more."""
        if self._stream is not None:
            self._stream.forget(request.number)

    def _wait(self, longest_s: float) -> None:
        """Until an answer comes, or it is time to try again."""
        started = time.monotonic()
        if self._retry_at > started:
            longest_s = min(longest_s, self._retry_at - started)
        try:
            self._handle(*self._events.get(timeout=longest_s))
        except queue.Empty:
            pass
        finally:
            self._waited_s += time.monotonic() - started

    def _collect(self) -> None:
        """Takes the answers that have come."""
        while not self._events.empty():
            self._handle(*self._events.get())

    def _handle(self, request: _Request, payload: zenoh.ZBytes | None) -> None:
        """Keeps the rows of an answer; a failed query's updates are sent again."""
        self._outstanding -= 1
        if payload is None:
            self._forget(request)
            self._give_up_arena()  # it may still be answered, into its place
            first, longest = _RETRY_S
            self._updates = request.updates + self._updates
            self._retry_at = time.monotonic() + min(longest, first * 2**self._failures)
            self._failures = min(self._failures + 1, 10)
            return
        self._failures, self._retry_at = 0, 0.0
        reply = self._decode(request, payload.to_bytes())
        if reply.status is Status.REFUSED:
            raise ReplayError(f"replay refused to sample: {reply.reason}")
        if reply.sample is not None:
            if len(reply.sample.ids) != self._batch_size * self._batches:
                raise WireError(
                    f"replay answered with {len(reply.sample.ids)} rows to "
                    f"{self._batches} batches of {self._batch_size}"
                )
            self._ready.extend(_batches_of(reply.sample, self._batch_size))


def _batches_of(sample: Sample, batch_size: int) -> Iterator[Sample]:
    """Splits a reply of several batches; views, no copies."""
    for start in range(0, len(sample.ids), batch_size):
        part = slice(start, start + batch_size)
        yield Sample(
            ids=sample.ids[part],
            probabilities=sample.probabilities[part],
            rows=sample.rows[part],
            size=sample.size,
            inserts=sample.inserts,
            mass=sample.mass,
        )
