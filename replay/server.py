"""The replay service: one thread owns the table, Zenoh's callbacks only enqueue.

Inserts are answered once they are in the table, in each writer's order; samples once
the rate limiter admits them. A request that the limiter does not admit within the
time that its sender allows is answered "busy". When a batch is answered so, its
writer's later ones are too: without it they could not be stored. Batch sizes with
which the limiter would deadlock are refused when they first appear.

Unless the configuration is durable (`replay.mapped`), rows live in memory only: a
service that is killed comes back empty and takes the writers up where they are (see
`replay.ledger`).
"""

import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import final

import zenoh

from replay.arena import Arenas
from replay.control import StatsReply, encode
from replay.counters import Counters, stats_reply
from replay.inserts import InsertDesk
from replay.keys import RunKeys
from replay.limiter import LimiterError
from replay.local import LocalReplay, ReplayConfig
from replay.places import Place, StreamPlace
from replay.requests import HeldSample, answer, end, payload_of
from replay.session import direct, undeclare
from replay.spec import ReplayError, RowSpec
from replay.streams import ReplyStreams
from replay.table import PriorityError
from replay.wire import (
    MAX_REPLY_BYTES,
    FetchRequest,
    SampleReplyBuffer,
    SampleRequest,
    Status,
    WireError,
    body_bytes,
    encode_sample_refusal,
)

__all__ = ["ReplayConfig", "ReplayServer"]

_QUESTIONS = ("fetch", "stats", "sync")
_LONGEST_WAIT_S = 0.1  # between looks at the stop event
_MAX_EVENTS = 4096  # unread
_MAX_SAMPLES = 1024  # requests that wait for the limiter, or for the disk


@final
class ReplayServer:
    """Serves one shard. `run` owns everything; nothing else may be called meanwhile."""

    def __init__(
        self,
        *,
        session: zenoh.Session,
        keys: RunKeys,
        spec: RowSpec,
        config: ReplayConfig,
        seed: int = 0,
        folder: Path | None = None,
        largest: tuple[int, int] | None = None,
        hub: zenoh.Session | None = None,
    ) -> None:
        """Makes the table, or takes up that of `folder` if the configuration says so.

        Requests are taken from `run` on. `largest`: rows of the run's largest batches,
        (insert, sample); larger ones are refused. Unless it is given, those that come
        first decide which others could deadlock with them. `hub`: a further session,
        on which questions are answered too, and no rows taken in or drawn.
        """
        self._session = session
        self._keys = keys
        self._spec = spec
        self._replay = LocalReplay(spec=spec, config=config, seed=seed, folder=folder)
        self._incarnation = secrets.randbits(63)
        self._events: queue.SimpleQueue[tuple[str, zenoh.Query, float]]
        self._events = queue.SimpleQueue()
        self._samples: deque[HeldSample] = deque()
        self._syncs: deque[tuple[int, zenoh.Query, StatsReply]] = deque()
        self._counters = Counters(recovered=self._replay.size)
        self._arenas = Arenas()
        self._inserts = InsertDesk(
            spec=spec,
            replay=self._replay,
            counters=self._counters,
            incarnation=self._incarnation,
            check_rows=lambda rows: self._check_batches(insert_rows=rows),
            part=self._arenas.part,
        )
        self._streams = ReplyStreams(capacity=config.capacity)
        # The last reply's: Zenoh has copied it, and fresh pages cost a fault each.
        self._payload = bytearray()
        self._hub = hub
        self._bounded = largest is not None
        # The largest batches seen, or that may come.
        self._insert_rows, self._sample_rows = largest or (1, 1)
        self._ready = threading.Event()

    def wait_ready(self, timeout: float) -> bool:
        """Whether requests are being taken, waiting up to `timeout` seconds."""
        return self._ready.wait(timeout)

    def run(self, stop: threading.Event) -> None:
        """Serves until `stop` is set."""
        handlers = {
            "insert": (self._keys.insert, self._inserts.take),
            "sample": (self._keys.sample, self._on_sample),
            "fetch": (self._keys.fetch, self._on_fetch),
            "stats": (self._keys.stats, self._on_stats),
            "stream": (self._keys.stream, self._on_stream),
            "sync": (self._keys.sync, self._on_sync),
        }
        queryables = [
            self._session.declare_queryable(key, direct(self._enqueue(name)))
            for name, (key, _) in handlers.items()
        ]
        if self._hub is not None:
            queryables += [
                self._hub.declare_queryable(key, direct(self._enqueue(name)))
                for name, (key, _) in handlers.items()
                if name in _QUESTIONS
            ]
        self._ready.set()
        try:
            while not stop.is_set():
                for name, query, arrived in self._next_events():
                    handlers[name][1](query, arrived)
                self._tend_disk()
                self._arenas.let_go(time.monotonic())
                self._admit()
                self._expire()
        finally:
            undeclare(*queryables)
            self._let_go()
            self._streams.close()
            self._replay.close()

    def _next_events(self) -> Iterator[tuple[str, zenoh.Query, float]]:
        """What has come; waits for the first until something is due."""
        try:
            yield self._events.get(timeout=self._next_deadline())
            while not self._events.empty():
                yield self._events.get()
        except queue.Empty:
            return

    def _enqueue(self, name: str) -> Callable[[zenoh.Query], None]:
        """The callback of a queryable: runs on Zenoh's thread, so it only enqueues."""
        events = self._events

        def on_query(query: zenoh.Query) -> None:
            # A flood is turned away unread: an empty answer means "ask again".
            if events.qsize() >= _MAX_EVENTS:
                end(query)
            else:
                events.put((name, query, time.monotonic()))

        return on_query

    # Samples

    def _on_sample(self, query: zenoh.Query, arrived: float) -> None:
        try:
            message = SampleRequest.decode(payload_of(query), self._spec)
            self._check_batches(sample_rows=message.batch_size * message.batches)
            self._replay.update_priorities(message.ids, message.priorities)
        except (WireError, LimiterError, PriorityError) as error:
            self._refuse(query, str(error))
            return
        if len(self._samples) >= _MAX_SAMPLES:
            self._counters.busy_samples += 1
            busy = encode_sample_refusal(Status.BUSY, "", self._spec)
            answer(query, busy)
            return
        self._samples.append(HeldSample(message=message, query=query, arrived=arrived))

    def _refuse(self, query: zenoh.Query, reason: str) -> None:
        self._counters.refused += 1
        answer(query, encode_sample_refusal(Status.REFUSED, reason, self._spec))

    def _admit_sample(self) -> bool:
        """Answers the first waiting request if the limiter lets it."""
        if not self._samples or not self._replay.may_sample(self._samples[0].count):
            return False
        held = self._samples.popleft()
        place = held.message.place
        body = self._body_at(place, body_bytes(self._spec, held.count))
        stream = place if body and isinstance(place, StreamPlace) else None
        buffer = self._replay.sample_into_buffer(
            batch_size=held.message.batch_size,
            batches=held.message.batches,
            payload=self._payload,
            place=body,
            sent=self._streams.sent(stream) if stream else None,
        )
        self._payload = buffer.payload
        self._counters.sample_wait_s += time.monotonic() - held.arrived
        answer(held.query, self._sealed(buffer))
        if stream and body:
            self._streams.put(stream, body[: buffer.body_bytes])
        return True

    def _body_at(self, place: Place | None, length: int) -> memoryview | None:
        """Where the reply's body is to be put; None: behind its header."""
        if place is None:
            return None
        if isinstance(place, StreamPlace):
            return self._streams.room(place, length)
        return self._arenas.part(place, length)

    # Both

    def _check_batches(self, *, insert_rows: int = 1, sample_rows: int = 1) -> None:
        """Refuses a batch size with which both sides could wait for ever."""
        if insert_rows > self._replay.config.capacity:
            raise ReplayError(
                f"a batch of {insert_rows} rows exceeds the table's capacity of "
                f"{self._replay.config.capacity}"
            )
        if self._bounded and (
            insert_rows > self._insert_rows or sample_rows > self._sample_rows
        ):
            raise LimiterError(
                f"a batch of {max(insert_rows, sample_rows)} rows: this run's are at "
                f"most {self._insert_rows} (insert) and {self._sample_rows} (sample); "
                "start all roles with one configuration"
            )
        insert_rows = max(insert_rows, self._insert_rows)
        sample_rows = max(sample_rows, self._sample_rows)
        if (insert_rows, sample_rows) != (self._insert_rows, self._sample_rows):
            self._replay.limiter.check_batches(
                insert_rows=insert_rows, sample_rows=sample_rows
            )
            self._insert_rows, self._sample_rows = insert_rows, sample_rows

    def _admit(self) -> None:
        """Goes on while either side can: each may be what the other waits for."""
        while self._inserts.admit() | self._admit_sample():
            pass

    def _next_deadline(self) -> float:
        """Seconds until a held request must be answered, 0.1 at most."""
        due = min([h.deadline for h in self._samples], default=self._inserts.due)
        left = min(due, self._inserts.due) - time.monotonic()
        return min(_LONGEST_WAIT_S, max(0.0, left))

    def _expire(self) -> None:
        """Answers "busy" to what has waited as long as it may."""
        now = time.monotonic()
        self._inserts.expire(now)
        for sample in [h for h in self._samples if h.deadline <= now]:
            self._samples.remove(sample)
            self._counters.sample_wait_s += now - sample.arrived
            self._counters.busy_samples += 1
            busy = encode_sample_refusal(Status.BUSY, "", self._spec)
            answer(sample.query, busy)

    def _let_go(self) -> None:
        """Ends all held queries without an answer: their senders try again."""
        self._inserts.let_go()
        for query in [h.query for h in self._samples] + [s[1] for s in self._syncs]:
            end(query)
        while not self._events.empty():
            end(self._events.get()[1])

    # Questions

    def _on_fetch(self, query: zenoh.Query, _: float) -> None:
        try:
            message = FetchRequest.decode(payload_of(query), self._spec)
        except WireError as error:
            self._refuse(query, str(error))
            return
        most = max(1, MAX_REPLY_BYTES // (16 + self._spec.row_bytes))
        ids, probabilities, rows = self._replay.table.read(
            message.first_id, min(message.limit, most)
        )
        buffer = SampleReplyBuffer(spec=self._spec, count=len(ids))
        buffer.ids[:] = ids
        buffer.probabilities[:] = probabilities
        buffer.rows[:] = rows
        answer(query, self._sealed(buffer))

    def _sealed(self, buffer: SampleReplyBuffer) -> bytearray:
        """The reply, with what the table is now."""
        replay = self._replay
        mass = replay.table.mass()
        return buffer.seal(size=replay.size, inserts=replay.inserts, mass=mass)

    def _on_stats(self, query: zenoh.Query, _: float) -> None:
        answer(query, encode(self.stats()))

    def stats(self) -> StatsReply:
        """All counters; for the owning thread, or after `run` has returned."""
        return stats_reply(
            replay=self._replay,
            counters=self._counters,
            ledger=self._inserts.ledger,
            incarnation=self._incarnation,
            pending_samples=len(self._samples),
        )

    def _on_stream(self, query: zenoh.Query, _: float) -> None:
        answer(query, encode(self._streams.offer(self._session)))

    def _on_sync(self, query: zenoh.Query, _: float) -> None:
        """The counters, once all that they count is on the disk."""
        durable = self._replay.durable
        if durable is None:
            answer(query, encode(self.stats()))
        elif len(self._syncs) >= _MAX_SAMPLES:
            end(query)
        else:
            self._syncs.append((durable.ask_sync(), query, self.stats()))

    def _tend_disk(self) -> None:
        """Starts the snapshot that is due, answers those who waited for one."""
        self._counters.look(self._replay)
        durable = self._replay.durable
        if durable is None:
            return
        durable.tend()
        while self._syncs and self._syncs[0][0] <= durable.synced:
            _, query, stats = self._syncs.popleft()
            answer(query, encode(stats))
