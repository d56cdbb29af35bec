"""The replay service: one thread owns the table, Zenoh's callbacks only enqueue.

Inserts are answered once they are in the table, in each writer's order; samples once
the rate limiter admits them. A request that the limiter does not admit within the
time that its sender allows is answered "busy". When a batch is answered so, its
writer's later ones are too: without it they could not be stored. Batch sizes with
which the limiter would deadlock are refused when they first appear.

Rows live in memory only: a service that is killed comes back empty and takes the
writers up where they are (see `replay.ledger`).
"""

import queue
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import zenoh

from replay.control import StatsReply, WriterStats, encode
from replay.keys import RunKeys
from replay.ledger import Ledger, Verdict
from replay.limiter import LimiterError
from replay.local import LocalReplay, ReplayConfig
from replay.requests import HeldInsert, HeldSample, answer, end, payload_of
from replay.session import undeclare
from replay.spec import ReplayError, RowSpec
from replay.table import PriorityError
from replay.wire import (
    FetchRequest,
    Insert,
    InsertReply,
    SampleReplyBuffer,
    SampleRequest,
    Status,
    WireError,
    encode_sample_refusal,
)

__all__ = ["ReplayConfig", "ReplayServer"]

_LONGEST_WAIT_S = 0.1  # between looks at the stop event


@final
@dataclass(kw_only=True)
class _Counters:
    """What `StatsReply` tells beyond the table's own counters."""

    insert_wait_s: float = 0.0
    sample_wait_s: float = 0.0
    busy_inserts: int = 0
    busy_samples: int = 0
    duplicates: int = 0
    gaps: int = 0
    refused: int = 0


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
    ) -> None:
        """Makes the empty table; requests are taken from `run` on."""
        self._session = session
        self._keys = keys
        self._spec = spec
        self._replay = LocalReplay(spec=spec, config=config, seed=seed)
        self._incarnation = secrets.randbits(63)
        self._events: queue.SimpleQueue[tuple[str, zenoh.Query, float]]
        self._events = queue.SimpleQueue()
        self._ledger: Ledger[HeldInsert] = Ledger()
        self._inserts: deque[HeldInsert] = deque()
        self._samples: deque[HeldSample] = deque()
        self._counters = _Counters()
        self._insert_rows = 1  # the largest batches seen
        self._sample_rows = 1
        self._ready = threading.Event()

    def wait_ready(self, timeout: float) -> bool:
        """Whether requests are being taken, waiting up to `timeout` seconds."""
        return self._ready.wait(timeout)

    def run(self, stop: threading.Event) -> None:
        """Serves until `stop` is set."""
        handlers = {
            "insert": (self._keys.insert, self._on_insert),
            "sample": (self._keys.sample, self._on_sample),
            "fetch": (self._keys.fetch, self._on_fetch),
            "stats": (self._keys.stats, self._on_stats),
        }
        queryables = [
            self._session.declare_queryable(key, self._enqueue(name))
            for name, (key, _) in handlers.items()
        ]
        self._ready.set()
        try:
            while not stop.is_set():
                try:
                    event = self._events.get(timeout=self._next_deadline())
                except queue.Empty:
                    self._expire()
                    continue
                while True:
                    name, query, arrived = event
                    handlers[name][1](query, arrived)
                    if self._events.empty():
                        break
                    event = self._events.get()
                self._admit()
                self._expire()
        finally:
            undeclare(*queryables)
            self._let_go()

    def _enqueue(self, name: str) -> Callable[[zenoh.Query], None]:
        """The callback of a queryable: runs on Zenoh's thread, so it only enqueues."""
        events = self._events

        def on_query(query: zenoh.Query) -> None:
            events.put((name, query, time.monotonic()))

        return on_query

    # Inserts

    def _on_insert(self, query: zenoh.Query, arrived: float) -> None:
        try:
            message = Insert.decode(payload_of(query), self._spec)
            self._check_batches(insert_rows=len(message.rows))
        except ReplayError as error:
            self._counters.refused += 1
            reply = InsertReply(
                status=Status.REFUSED,
                writer=0,
                epoch=0,
                next_sequence=0,
                incarnation=self._incarnation,
                reason=str(error),
            )
            answer(query, reply.encode(self._spec))
            return
        verdict, state = self._ledger.judge(
            writer=message.writer,
            epoch=message.epoch,
            sequence=message.sequence,
            base=message.base,
        )
        self._drop_superseded()
        held = HeldInsert(message=message, query=query, arrived=arrived, state=state)
        if verdict is Verdict.NEXT:
            state.waiting.append(held)
            self._inserts.append(held)
        elif verdict is Verdict.REPLACES:
            earlier = state.waiting[message.sequence - state.next_sequence]
            end(earlier.query)
            earlier.query, earlier.arrived = query, arrived
        else:
            self._answer_unstored(held, verdict)

    def _answer_unstored(self, held: HeldInsert, verdict: Verdict) -> None:
        """Duplicates, gaps and stale batches are answered at once."""
        if verdict is Verdict.DUPLICATE:
            self._counters.duplicates += 1
            self._acknowledge(held, Status.OK)
        elif verdict is Verdict.GAP:
            self._counters.gaps += 1
            self._acknowledge(held, Status.GAP)
        else:
            self._counters.refused += 1
            reason = (
                f"writer {held.message.writer} of epoch {held.message.epoch} was "
                f"replaced by a process of epoch {held.state.epoch}; give every actor "
                "its own number"
            )
            self._acknowledge(held, Status.STALE, reason)

    def _drop_superseded(self) -> None:
        """Lets go of what waited for a writer that has moved on."""
        while self._ledger.dropped:
            held = self._ledger.dropped.popleft()
            end(held.query)
            held.query = None

    def _acknowledge(self, held: HeldInsert, status: Status, reason: str = "") -> None:
        """Answers with the writer's next sequence."""
        if held.query is None:
            return
        reply = InsertReply(
            status=status,
            writer=held.message.writer,
            epoch=held.message.epoch,
            next_sequence=held.state.next_sequence,
            incarnation=self._incarnation,
            reason=reason,
        )
        answer(held.query, reply.encode(self._spec))
        held.query = None

    def _admit_insert(self) -> bool:
        """Stores the first waiting batch if the limiter lets it."""
        while self._inserts and self._inserts[0].query is None:
            self._inserts.popleft()
        if not self._inserts:
            return False
        held = self._inserts[0]
        if not self._replay.may_insert(len(held.message.rows)):
            return False
        self._inserts.popleft()
        self._replay.insert_bytes(held.message.rows)
        self._ledger.stored(held.state, len(held.message.rows))
        self._counters.insert_wait_s += time.monotonic() - held.arrived
        self._acknowledge(held, Status.OK)
        return True

    # Samples

    def _on_sample(self, query: zenoh.Query, arrived: float) -> None:
        try:
            message = SampleRequest.decode(payload_of(query), self._spec)
            self._check_batches(sample_rows=message.batch_size * message.batches)
            self._replay.update_priorities(message.ids, message.priorities)
        except (WireError, LimiterError, PriorityError) as error:
            self._refuse(query, str(error))
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
        buffer = self._replay.sample_into_buffer(
            batch_size=held.message.batch_size, batches=held.message.batches
        )
        self._counters.sample_wait_s += time.monotonic() - held.arrived
        payload = buffer.seal(size=self._replay.size, inserts=self._replay.inserts)
        answer(held.query, payload)
        return True

    # Both

    def _check_batches(self, *, insert_rows: int = 1, sample_rows: int = 1) -> None:
        """Refuses a batch size with which both sides could wait for ever."""
        if insert_rows > self._replay.config.capacity:
            raise ReplayError(
                f"a batch of {insert_rows} rows exceeds the table's capacity of "
                f"{self._replay.config.capacity}"
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
        while self._admit_insert() | self._admit_sample():
            pass

    def _next_deadline(self) -> float:
        """Seconds until a held request must be answered, 0.1 at most."""
        deadlines = [held.deadline for held in self._inserts]
        deadlines += [held.deadline for held in self._samples]
        if not deadlines:
            return _LONGEST_WAIT_S
        return min(_LONGEST_WAIT_S, max(0.0, min(deadlines) - time.monotonic()))

    def _expire(self) -> None:
        """Answers "busy" to what has waited as long as it may."""
        now = time.monotonic()
        for held in [h for h in self._inserts if h.deadline <= now]:
            for late in held.state.waiting:
                if late.query is not None:
                    self._counters.insert_wait_s += now - late.arrived
                    self._counters.busy_inserts += 1
                    self._acknowledge(late, Status.BUSY)
            held.state.waiting.clear()
        if any(h.query is None for h in self._inserts):
            self._inserts = deque(h for h in self._inserts if h.query is not None)
        for sample in [h for h in self._samples if h.deadline <= now]:
            self._samples.remove(sample)
            self._counters.sample_wait_s += now - sample.arrived
            self._counters.busy_samples += 1
            busy = encode_sample_refusal(Status.BUSY, "", self._spec)
            answer(sample.query, busy)

    def _let_go(self) -> None:
        """Ends all held queries without an answer: their senders try again."""
        for query in [h.query for h in self._inserts] + [
            h.query for h in self._samples
        ]:
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
        ids, probabilities, rows = self._replay.table.read(
            message.first_id, message.limit
        )
        buffer = SampleReplyBuffer(spec=self._spec, count=len(ids))
        buffer.ids[:] = ids
        buffer.probabilities[:] = probabilities
        buffer.rows[:] = rows
        size, inserts = self._replay.size, self._replay.inserts
        answer(query, buffer.seal(size=size, inserts=inserts))

    def _on_stats(self, query: zenoh.Query, _: float) -> None:
        answer(query, encode(self.stats()))

    def stats(self) -> StatsReply:
        """All counters; for the owning thread, or after `run` has returned."""
        replay, counters = self._replay, self._counters
        writers = [
            WriterStats(
                writer=state.writer,
                epoch=state.epoch,
                next_sequence=state.next_sequence,
                rows=state.rows,
                pending=len(state.waiting),
            )
            for state in self._ledger
        ]
        return StatsReply(
            incarnation=self._incarnation,
            schema_hash=self._spec.schema_hash.hex(),
            capacity=replay.config.capacity,
            size=replay.size,
            inserts=replay.inserts,
            samples=replay.samples,
            deletes=replay.table.deletes,
            samples_per_insert=replay.samples_per_insert,
            configured_samples_per_insert=replay.config.samples_per_insert,
            min_size=replay.config.min_size,
            insert_wait_s=counters.insert_wait_s,
            sample_wait_s=counters.sample_wait_s,
            busy_inserts=counters.busy_inserts,
            busy_samples=counters.busy_samples,
            duplicates=counters.duplicates,
            gaps=counters.gaps,
            refused=counters.refused,
            stale_updates=replay.stale_updates,
            pending_samples=len(self._samples),
            mean_priority_mass=replay.table.mean_mass(),
            writers=writers,
        )
