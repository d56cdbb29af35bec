"""The actors' end: rows go out in numbered batches until each is acknowledged.

A batch carries (writer, epoch, sequence). The service accepts a writer's batches in
order only, so a lost one is answered by a gap and everything from it on is sent again
(go-back-N): cheap, because the window is about four batches. `epoch` must grow from
one life of the writer's process to the next; then nothing that a killed process left
in the network can be taken for the new one's. Epochs come from a clock, and a clock
can be set back: a writer whose very first batch is told that a later epoch has been
goes on above that one, as nothing of it can be stored yet.

A batch also carries `base`, the lowest sequence that is not acknowledged. A service
that has lost its memory takes up the writer there: batches below it were acknowledged
(by its former self), batches from it on will be sent again.

What the writer does with an answer:

    ABSENT    the rows lie in memory that the service cannot read: send them along
    OK, and any answer's `next_sequence`   forget all batches below it
    BUSY      the limiter held it as long as allowed: send again at once
    GAP       send again from the first unacknowledged batch
    no answer (killed, unreachable, access denied, timed out): the same, with back-off
    STALE     to the first sending of the first batch: continue above that epoch
    STALE, REFUSED   raise in the caller's thread
"""

import secrets
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import final

import numpy as np
import zenoh

from replay.arena import Arena, make_arena
from replay.keys import RunKeys
from replay.places import MemoryPlace
from replay.session import direct, shares_memory
from replay.spec import ReplayError, RowSpec
from replay.wire import Status, WireError
from replay.wire_inserts import Insert, InsertReply

_ANSWER_MARGIN_S = 5.0  # between the service's last moment to answer and giving up
_BACK_OFF_S = (0.02, 1.0)  # first and longest
_GAP_PAUSE_S = 0.005
_LEAST_PLACED_BYTES = 64 << 10  # of a batch: smaller ones cost less in the message
_END_S = 1.0  # that is waited for the sending thread


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class _Batch:
    sequence: int
    rows: np.ndarray  # [rows, row_bytes] uint8
    place: MemoryPlace | None  # of the rows


@final
class Writer:
    """Sends rows exactly once. `append` and `flush` belong to one thread."""

    def __init__(
        self,
        *,
        session: zenoh.Session,
        keys: RunKeys,
        spec: RowSpec,
        writer: int,
        epoch: int,
        window: int = 4,
        batch_rows: int = 64,
        hold_s: float = 2.0,
    ) -> None:
        """`window`: batches in flight; `hold_s`: how long an answer may be held."""
        if min(window, batch_rows) < 1 or min(writer, epoch) < 0:
            raise ReplayError(
                f"window={window} and batch_rows={batch_rows} must be at least 1, "
                f"writer={writer} and epoch={epoch} at least 0"
            )
        self._session = session
        self._key = keys.insert
        self._spec = spec
        self._writer = writer
        self._epoch = epoch
        self._life = secrets.randbits(64)
        self._limit = window
        self._hold_s = hold_s
        self._batch_rows = batch_rows
        self._arena = self._make_arena(session)
        self._may_place = self._arena is not None
        self._part: MemoryPlace | None = None
        self._partial = self._empty_batch()
        self._filled = 0
        # Everything below is guarded by the condition.
        self._changed = threading.Condition()
        self._window: deque[_Batch] = deque()
        self._next_sequence = 0
        self._sent = 0  # of the window's batches, in this generation
        self._generation = 0  # answers to an earlier one tell no need to resend
        self._failures = 0
        self._retry_at = 0.0
        self._acknowledged = 0
        self._waited_s = 0.0
        self._resent = 0
        self._error: ReplayError | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    def _make_arena(self, session: zenoh.Session) -> Arena | None:
        """For the window and the batch under way, if that is worth it."""
        batch_bytes = self._batch_rows * self._spec.row_bytes
        if batch_bytes < _LEAST_PLACED_BYTES or not shares_memory(session):
            return None
        return make_arena(parts=self._limit + 2, part_bytes=batch_bytes)

    def _empty_batch(self) -> np.ndarray:
        """Memory for the next rows: where a service of this machine can read them."""
        self._part = self._arena.take() if self._arena and self._may_place else None
        if self._arena is None or self._part is None:
            return np.zeros(self._batch_rows, self._spec.dtype)
        room = self._arena.room(self._part, self._batch_rows * self._spec.row_bytes)
        return np.frombuffer(room, self._spec.dtype)

    @property
    def acknowledged(self) -> int:
        """Rows that the service has confirmed to hold."""
        return self._acknowledged

    @property
    def waited_s(self) -> float:
        """Total time that the caller was held up by a full window."""
        return self._waited_s

    @property
    def room(self) -> int:
        """Rows until the batch under way is full, and has to fit into the window."""
        return len(self._partial) - self._filled

    @property
    def resent(self) -> int:
        """How often the writer went back."""
        return self._resent

    def append(self, rows: np.ndarray, timeout: float | None = None) -> bool:
        """Takes all rows; blocks while the window is full.

        False if that took longer than `timeout` seconds: the rows may then be taken
        in part, so it is for callers that are about to give up.
        """
        rows = self._spec.check(rows)
        start = 0
        while start < len(rows):
            if self._filled == len(self._partial) and not self._enqueue(timeout):
                return False
            taken = min(len(rows) - start, len(self._partial) - self._filled)
            self._partial[self._filled : self._filled + taken] = rows[
                start : start + taken
            ]
            self._filled += taken
            start += taken
        return self._filled < len(self._partial) or self._enqueue(timeout)

    def flush(self, timeout: float) -> bool:
        """Sends what is left; whether all was acknowledged within `timeout` s."""
        deadline = time.monotonic() + timeout
        if self._filled and not self._enqueue(timeout):
            return False
        with self._changed:
            self._changed.wait_for(
                lambda: not self._window or self._error is not None,
                max(0.0, deadline - time.monotonic()),
            )
            self._raise_error()
            return not self._window

    def close(self, timeout: float = 10.0) -> bool:
        """Flushes and ends the sending thread; whether all was acknowledged."""
        try:
            return self.flush(timeout)
        finally:
            with self._changed:
                self._closed = True
                self._changed.notify_all()
            # A link whose other end stands still holds a sender for up to a minute.
            self._thread.join(_END_S)

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _enqueue(self, timeout: float | None) -> bool:
        """Moves the filled rows into the window; False if it stayed full."""
        with self._changed:
            started = time.monotonic()
            admitted = self._changed.wait_for(
                lambda: len(self._window) < self._limit or self._error is not None,
                timeout,
            )
            self._waited_s += time.monotonic() - started
            self._raise_error()
            if not admitted:
                return False
            self._window.append(self._batch())
            self._next_sequence += 1
            self._filled = 0
            self._changed.notify_all()
        self._partial = self._empty_batch()
        return True

    def _batch(self) -> _Batch:
        """The filled rows; their part of the arena is free when the batch is."""
        width = self._spec.row_bytes
        rows = self._spec.as_bytes(self._partial[: self._filled])
        if self._arena is not None and self._part is not None:
            rows = self._arena.view(self._part, self._filled * width).reshape(-1, width)
        return _Batch(sequence=self._next_sequence, rows=rows, place=self._part)

    def _run(self) -> None:
        """The sending thread: whatever of the window has not been sent."""
        while True:
            with self._changed:
                if not self._wait_for_work():
                    return
                batch = self._window[self._sent]
                self._sent += 1
                base = self._window[0].sequence
                generation = self._generation
            try:
                self._send(batch, base, generation)
            except zenoh.ZError as error:
                with self._changed:
                    self._error = ReplayError(f"cannot send to {self._key}: {error}")
                    self._changed.notify_all()
                return

    def _wait_for_work(self) -> bool:
        """True when a batch is to be sent, False when the writer is to end."""
        while True:
            if self._closed or self._error is not None:
                return False
            pause = self._retry_at - time.monotonic()
            if self._sent < len(self._window) and pause <= 0:
                return True
            self._changed.wait(pause if pause > 0 else None)

    def _send(self, batch: _Batch, base: int, generation: int) -> None:
        """One query; its end without an answer is a failure."""
        answered = False
        first = batch.sequence == 0 and generation == 0

        def on_reply(reply: zenoh.Reply) -> None:
            nonlocal answered
            if reply.ok is not None:
                answered = True
                self._on_answer(reply.ok.payload.to_bytes(), generation, first)

        def on_end() -> None:
            if not answered:
                self._on_failure(generation)

        message = Insert(
            writer=self._writer,
            epoch=self._epoch,
            sequence=batch.sequence,
            base=base,
            hold_ms=int(self._hold_s * 1e3),
            rows=batch.rows,
            life=self._life,
            place=batch.place if self._may_place else None,
        )
        self._session.get(
            self._key,
            direct(on_reply, on_end),
            payload=message.encode(self._spec),
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=self._hold_s + _ANSWER_MARGIN_S,
        )

    def _on_answer(self, payload: bytes, generation: int, first: bool) -> None:
        """Forgets what is stored; goes back if something is missing.

        `first`: it answers the first batch, which had been sent once.
        """
        with self._changed:
            try:
                reply = InsertReply.decode(payload, self._spec)
            except WireError as error:
                self._error = error
                self._changed.notify_all()
                return
            if reply.status is Status.STALE and self._rises(reply.epoch, first):
                pass
            elif reply.status in (Status.STALE, Status.REFUSED):
                self._error = ReplayError(f"replay refused the rows: {reply.reason}")
            elif reply.next_sequence > self._next_sequence:
                self._error = ReplayError(
                    f"replay acknowledges batch {reply.next_sequence - 1} of writer "
                    f"{self._writer}, which was never sent; does another process use "
                    "this number?"
                )
            elif (reply.writer, reply.epoch) == (self._writer, self._epoch):
                self._failures = 0
                self._may_place &= reply.status is not Status.ABSENT
                self._forget_below(reply.next_sequence)
                if reply.status is not Status.OK and generation == self._generation:
                    pause = _GAP_PAUSE_S if reply.status is Status.GAP else 0.0
                    self._go_back(pause)
            self._changed.notify_all()

    def _rises(self, in_force: int, first: bool) -> bool:
        """Whether the writer goes on above the epoch that made a batch stale."""
        if first and in_force > self._epoch:
            self._epoch = in_force + 1
            self._go_back(0.0)
        # Below: it answers what was sent before the epoch was raised.
        return in_force < self._epoch

    def _on_failure(self, generation: int) -> None:
        with self._changed:
            if generation != self._generation:
                return
            first, longest = _BACK_OFF_S
            self._go_back(min(longest, first * 2**self._failures))
            self._failures = min(self._failures + 1, 10)
            self._changed.notify_all()

    def _forget_below(self, sequence: int) -> None:
        while self._window and self._window[0].sequence < sequence:
            self._acknowledged += len(self._window.popleft().rows)
            self._sent = max(0, self._sent - 1)

    def _go_back(self, pause_s: float) -> None:
        self._generation += 1
        self._resent += 1
        self._sent = 0
        self._retry_at = time.monotonic() + pause_s
