"""The clients' side: the sampler and the questions; the writer is `replay.writer`.

Nothing here imports torch: an actor or a viewer does without it.
"""

import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, final

import msgspec
import numpy as np
import zenoh
from jaxtyping import Float, Integer

from replay.arena import Arena, make_arena
from replay.control import StatsReply, decode
from replay.keys import RunKeys
from replay.session import ask, direct, shares_memory
from replay.spec import ReplayError, RowSpec, Sample
from replay.wire import (
    FetchRequest,
    SampleReply,
    SampleRequest,
    Status,
    WireError,
    body_bytes,
)
from replay.writer import Writer

__all__ = [
    "ReplayTimeout",
    "Sampler",
    "Writer",
    "fetch_rows",
    "fetch_stats",
    "sync_replay",
]

_ANSWER_MARGIN_S = 5.0  # between the service's last moment to answer and giving up
_RETRY_S = (0.02, 1.0)  # first and longest pause after an answer that did not come


class ReplayTimeout(ReplayError):
    """Nothing could be sampled in the time given; asking again is fine."""


@final
class _Request:
    """A sample query in flight: ends with exactly one event."""

    def __init__(
        self,
        updates: list[tuple[np.ndarray, np.ndarray]],
        events: "queue.SimpleQueue[tuple[_Request, zenoh.ZBytes | None]]",
        on_answer: Callable[[], object],
        arena: Arena | None,
    ) -> None:
        self.updates = updates
        self.arena = arena
        self.place = arena.take() if arena else None
        self._events = events
        self._on_answer = on_answer
        self._answered = False

    def on_reply(self, reply: zenoh.Reply) -> None:
        """Hands the payload to the sampling thread."""
        if reply.ok is not None and not self._answered:
            self._answered = True
            self._events.put((self, reply.ok.payload))
            self._on_answer()

    def on_end(self) -> None:
        """An end without a reply is a failure, e.g. a service that was killed."""
        if not self._answered:
            self._answered = True
            self._events.put((self, None))
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
        (`replay.arena`) if the session was opened with shared memory.
        """
        if min(batch_size, batches_per_reply, in_flight) < 1:
            raise ReplayError(
                f"batch_size={batch_size}, batches_per_reply={batches_per_reply} and "
                f"in_flight={in_flight} must all be at least 1"
            )
        self._session = session
        self._key = keys.sample
        self._spec = spec
        self._batch_size = batch_size
        self._batches = batches_per_reply
        self._in_flight = in_flight
        self._hold_s = hold_s
        self._on_answer = on_answer
        self._shared_memory = shares_memory(session)
        self._arena: Arena | None = None
        self._placed = 0
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
            arena = self._open_arena()
            request = _Request(updates, self._events, self._on_answer, arena)
            message = SampleRequest(
                batch_size=self._batch_size,
                batches=self._batches,
                hold_ms=int(self._hold_s * 1e3),
                ids=np.concatenate([np.zeros(0, np.uint64)] + [u[0] for u in updates]),
                priorities=np.concatenate([np.zeros(0)] + [u[1] for u in updates]),
                place=request.place,
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

    def _open_arena(self) -> Arena | None:
        """Where answers may lie, if anywhere."""
        if self._shared_memory and self._arena is None:
            # One part for each query in flight and as many that the caller looks at,
            # and one for each that it has just taken.
            self._arena = make_arena(
                parts=2 * self._in_flight + 2,
                part_bytes=body_bytes(self._spec, self._batch_size * self._batches),
            )
            self._shared_memory = self._arena is not None
        return self._arena

    def _give_up_arena(self) -> None:
        """What is lent stays valid; the next query that names a place has a new one."""
        if self._arena is not None:
            self._arena.close()
            self._arena = None

    def _decode(self, request: _Request, payload: bytes) -> SampleReply:
        """The answer; its place is lent to its rows, or free again."""
        arena, place = request.arena, request.place
        if arena is None or place is None:
            return SampleReply.decode(payload, self._spec)
        used = False

        def view(length: int) -> np.ndarray:
            nonlocal used
            used = True
            return arena.view(place, length)

        reply = SampleReply.decode(payload, self._spec, view)
        self._placed += used
        if not used:
            arena.give_back(place)
            if reply.sample is not None:  # the service is somewhere else
                self._shared_memory = False
                self._give_up_arena()
        return reply

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


def fetch_stats(
    session: zenoh.Session, keys: RunKeys, *, timeout: float = 5.0
) -> dict[str, Any]:
    """The service's counters, by the names of `replay.control.StatsReply`."""
    payload = ask(session, keys.stats, timeout_s=timeout)
    if payload is None:
        raise ReplayTimeout(
            f"no answer from {keys.stats} within {timeout:g} s; is the replay service "
            "up?"
        )
    stats: dict[str, Any] = msgspec.to_builtins(decode(payload, StatsReply))
    return stats


def sync_replay(
    session: zenoh.Session, keys: RunKeys, *, timeout: float = 30.0
) -> dict[str, Any]:
    """The service's counters, once every row that they count is on the disk.

    A service that keeps its rows in memory answers at once.
    """
    payload = ask(session, keys.sync, timeout_s=timeout)
    if payload is None:
        raise ReplayTimeout(f"no answer from {keys.sync} within {timeout:g} s")
    stats: dict[str, Any] = msgspec.to_builtins(decode(payload, StatsReply))
    return stats


def fetch_rows(
    *,
    session: zenoh.Session,
    keys: RunKeys,
    spec: RowSpec,
    first_id: int = 0,
    page_rows: int = 4096,
    timeout: float = 10.0,
) -> Iterator[Sample]:
    """Every row still in the table, in pages, by ascending id from `first_id`."""
    while True:
        request = FetchRequest(first_id=first_id, limit=page_rows).encode(spec)
        payload = ask(session, keys.fetch, request, timeout_s=timeout)
        if payload is None:
            raise ReplayTimeout(f"no answer from {keys.fetch} within {timeout:g} s")
        reply = SampleReply.decode(payload, spec)
        if reply.sample is None:
            raise WireError(f"replay refused to hand out rows: {reply.reason}")
        ids = reply.sample.ids
        if len(ids) == 0:
            return
        if int(ids[0]) < first_id or (ids[1:] <= ids[:-1]).any():
            raise WireError(f"replay handed out ids out of order, from {ids[0]} on")
        yield reply.sample
        first_id = int(reply.sample.ids[-1]) + 1
