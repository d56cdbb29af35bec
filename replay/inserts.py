"""The service's insert side: batches in each writer's order, held for the limiter.

Owned by the service's thread. A batch is answered once it is stored; one that is not
admitted within the time that its sender allows is answered "busy", and so are that
writer's later ones: without it they could not be stored.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import final

import zenoh

from replay.counters import Counters
from replay.ledger import Ledger, Verdict, WriterState
from replay.local import LocalReplay
from replay.places import MemoryPlace
from replay.records import MAX_WRITERS
from replay.requests import HeldInsert, answer, end, payload_of
from replay.spec import ReplayError, RowSpec
from replay.storage import WriterMark
from replay.wire import Status
from replay.wire_inserts import Insert, InsertReply

MAX_WAITING = 64  # batches of one writer
MAX_WAITING_BYTES = 256 << 20  # of all


def _refusal(held: HeldInsert, verdict: Verdict) -> tuple[Status, str]:
    """How a batch that can never be accepted is answered."""
    writer, epoch = held.message.writer, held.message.epoch
    if verdict is Verdict.FULL:
        return Status.REFUSED, (
            f"writer {writer}: the service has {MAX_WRITERS} writers, as many as it "
            "may; number the actors from 0"
        )
    if verdict is Verdict.FOREIGN:
        return Status.STALE, (
            f"writer {writer} of epoch {epoch} is another process; give every actor "
            "its own number"
        )
    return Status.STALE, (
        f"writer {writer} of epoch {epoch} was replaced by a process of epoch "
        f"{held.state.epoch}; give every actor its own number"
    )


@final
class InsertDesk:
    """Takes batches in, stores them when it may, answers all."""

    def __init__(
        self,
        *,
        spec: RowSpec,
        replay: LocalReplay,
        counters: Counters,
        incarnation: int,
        check_rows: Callable[[int], None],
        part: Callable[[MemoryPlace, int], memoryview | None],
    ) -> None:
        """Takes up the writers that the replay knows; `check_rows` refuses sizes.

        `part`: the memory in which a writer of this machine has put rows.
        """
        self._spec = spec
        self._replay = replay
        self._counters = counters
        self._incarnation = incarnation
        self._check_rows = check_rows
        self._part = part
        self._held: deque[HeldInsert] = deque()
        self._due = math.inf  # none has to be answered earlier
        self._told = ""  # the fault that was said
        self.ledger: Ledger[HeldInsert] = Ledger(MAX_WRITERS)
        for mark in replay.writers:
            self.ledger.restore(
                WriterState(
                    writer=mark.writer,
                    epoch=mark.epoch,
                    next_sequence=mark.next_sequence,
                    life=mark.life,
                    rows=mark.rows,
                )
            )

    def take(self, query: zenoh.Query, arrived: float) -> None:
        """Judges a batch: it waits, or is answered at once."""
        try:
            message = Insert.decode(payload_of(query), self._spec, self._part)
            self._check_rows(len(message.rows))
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
        if not len(message.rows):
            self._ask_for_rows(message, query)
            return
        verdict, state = self.ledger.judge(
            writer=message.writer,
            epoch=message.epoch,
            sequence=message.sequence,
            base=message.base,
            life=message.life,
        )
        self._drop_superseded()
        held = HeldInsert(message=message, query=query, arrived=arrived, state=state)
        if verdict is Verdict.NEXT and self._is_full(state):
            self._counters.gaps += 1
            self._acknowledge(held, Status.GAP)
        elif verdict is Verdict.NEXT:
            state.waiting.append(held)
            self._held.append(held)
            self._due = min(self._due, held.deadline)
        elif verdict is Verdict.REPLACES:
            earlier = state.waiting[message.sequence - state.next_sequence]
            end(earlier.query)
            earlier.query, earlier.arrived = query, arrived
            earlier.message = message
        else:
            self._answer_unstored(held, verdict)

    def _ask_for_rows(self, message: Insert, query: zenoh.Query) -> None:
        """Its rows lie where this process cannot read; nothing is judged by that."""
        reply = InsertReply(
            status=Status.ABSENT,
            writer=message.writer,
            epoch=message.epoch,
            next_sequence=message.base,
            incarnation=self._incarnation,
        )
        answer(query, reply.encode(self._spec))

    def _is_full(self, state: WriterState[HeldInsert]) -> bool:
        """Whether as much waits as may: the writer sends it again soon."""
        waiting = sum(held.message.rows.nbytes for held in self._held)
        return len(state.waiting) >= MAX_WAITING or waiting > MAX_WAITING_BYTES

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
            status, reason = _refusal(held, verdict)
            self._acknowledge(held, status, reason)

    def _drop_superseded(self) -> None:
        """Lets go of what waited for a writer that has moved on."""
        while self.ledger.dropped:
            held = self.ledger.dropped.popleft()
            end(held.query)
            held.query = None

    def _acknowledge(self, held: HeldInsert, status: Status, reason: str = "") -> None:
        """Answers with the writer's next sequence.

        A stale one is told the epoch in force, which its writer may have to exceed.
        """
        if held.query is None:
            return
        told = held.state if status is Status.STALE else held.message
        reply = InsertReply(
            status=status,
            writer=held.message.writer,
            epoch=told.epoch,
            next_sequence=held.state.next_sequence,
            incarnation=self._incarnation,
            reason=reason,
        )
        answer(held.query, reply.encode(self._spec))
        held.query = None

    def admit(self) -> bool:
        """Stores the first waiting batch if it may be; whether it did."""
        while self._held and self._held[0].query is None:
            self._held.popleft()
        if not self._held:
            return False
        held = self._held[0]
        rows, state = held.message.rows, held.state
        if not self._replay.may_insert(len(rows)):
            return False
        self._held.popleft()
        mark = WriterMark(
            writer=state.writer,
            epoch=state.epoch,
            next_sequence=state.next_sequence + 1,
            rows=state.rows + len(rows),
            life=state.life,
        )
        self._replay.insert_bytes(rows, mark)
        now = time.monotonic()
        self.ledger.stored(state, len(rows), now)
        self._counters.insert_wait_s += now - held.arrived
        self._acknowledge(held, Status.OK)
        return True

    @property
    def due(self) -> float:
        """No held batch must be answered before, `time.monotonic`."""
        return self._due

    def expire(self, now: float) -> None:
        """Answers "busy" to what has waited as long as it may."""
        self._tell_fault()
        if now < self._due:
            return
        for held in [h for h in self._held if h.deadline <= now]:
            for late in held.state.waiting:
                if late.query is not None:
                    self._counters.insert_wait_s += now - late.arrived
                    self._counters.busy_inserts += 1
                    self._acknowledge(late, Status.BUSY, self._replay.fault)
            held.state.waiting.clear()
        self._held = deque(h for h in self._held if h.query is not None)
        self._due = min((h.deadline for h in self._held), default=math.inf)

    def _tell_fault(self) -> None:
        """Says once that inserts stop and why, and once that they go on."""
        fault = self._replay.fault
        if fault != self._told:
            self._told = fault
            print(f"inserts stop: {fault}" if fault else "inserts go on", flush=True)

    def let_go(self) -> None:
        """Ends all held queries without an answer: their senders try again."""
        for held in self._held:
            end(held.query)
