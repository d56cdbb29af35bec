"""An actor's end where there are shards: one writer, which shard it writes to changes.

`replay.shards.home_of` says which shard. When it changes (a shard joined, left or came
back) the rows that come go to the new one, in a writer of a later epoch:

    the former shard is up             its writer sends what it has to its end
    it is gone, rows were in memory    what it did not acknowledge is sent to the new
                                       one; what it did is gone with it
    it is gone, rows are on its disk   nothing changes: the writer waits until it is
                                       back, and no row is lost or doubled

A shard counts as gone once nobody has seen it for `_SETTLE_S`: when the hub is killed,
all shards seem to go at once. If a shard in memory is cut off and not dead, what it
stored without being able to say so is stored twice.
"""

import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final, final

import numpy as np

from replay.client import Writer
from replay.shards import ShardLink, home_of
from replay.shards_directory import ShardDirectory
from replay.spec import ReplayError, RowSpec

_SETTLE_S: Final = 0.5
_LOOK_S: Final = 0.2  # between two looks at where to write


@final
@dataclass(eq=False)
class _Stream:
    """What is sent to one shard."""

    link: ShardLink
    writer: Writer
    settled: int = 0  # rows acknowledged and let go of
    kept: deque[np.ndarray] = field(default_factory=deque)  # what is not acknowledged

    def settle(self) -> None:
        """Lets go of what is acknowledged."""
        while self.kept and self.settled + len(self.kept[0]) <= (
            self.writer.acknowledged
        ):
            self.settled += len(self.kept.popleft())

    def abandon(self) -> list[np.ndarray]:
        """Ends the writer; the rows that were not acknowledged, in order."""
        try:
            self.writer.close(0.0)
        except ReplayError:
            pass  # it is given up, whatever it says
        self.settle()
        return list(self.kept)


@final
class ShardedWriter:
    """Like `replay.writer.Writer`, over the shards of a run. For one thread."""

    def __init__(
        self,
        *,
        directory: ShardDirectory,
        spec: RowSpec,
        writer: int,
        epoch: int,
        shards: int,
        durable: bool,
        window: int = 4,
        batch_rows: int = 64,
    ) -> None:
        """`shards`: how many the run began with; `durable`: a shard's rows outlive it.

        `epoch` has to grow by more than the number of moves from one process to the
        next; a clock in milliseconds does.
        """
        self._directory = directory
        self._spec = spec
        self._writer = writer
        self._epoch = epoch
        self._durable = durable
        self._window = window
        self._batch_rows = batch_rows
        self._known = set(range(shards))
        self._seen: dict[int, float] = {}  # when a shard was last up
        self._began = time.monotonic()
        self._pending: deque[np.ndarray] = deque()  # not given to a writer yet
        self._stream: _Stream | None = None
        self._ending: list[_Stream] = []  # of shards that were left
        self._moves = 0
        self._acknowledged, self._waited_s, self._resent = 0, 0.0, 0
        self._idle_s = 0.0
        self._changed = threading.Event()
        directory.on_change(self._changed.set)

    @property
    def acknowledged(self) -> int:
        """Rows that a shard has confirmed to hold."""
        return self._acknowledged + sum(s.writer.acknowledged for s in self._streams)

    @property
    def waited_s(self) -> float:
        """Total time that the caller was held up."""
        writers = sum(s.writer.waited_s for s in self._streams)
        return self._waited_s + self._idle_s + writers

    @property
    def resent(self) -> int:
        """How often a writer went back."""
        return self._resent + sum(s.writer.resent for s in self._streams)

    @property
    def shard(self) -> int | None:
        """Written to now; None while there is none."""
        return self._stream.link.shard if self._stream else None

    @property
    def _streams(self) -> list[_Stream]:
        return self._ending + ([self._stream] if self._stream else [])

    def append(self, rows: np.ndarray, timeout: float | None = None) -> bool:
        """Takes all rows; blocks while the window is full.

        False if they could not be sent on within `timeout` seconds: they are kept, and
        the next call, which may bring none, goes on with them.
        """
        rows = self._spec.check(rows)
        for start in range(0, len(rows), self._batch_rows):
            self._pending.append(rows[start : start + self._batch_rows].copy())
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            self._look()
            left = None if deadline is None else deadline - time.monotonic()
            if self._feed(_LOOK_S if left is None else max(0.0, min(_LOOK_S, left))):
                return True
            if left is not None and left <= 0:
                return False

    def flush(self, timeout: float) -> bool:
        """Sends what is left; whether all was acknowledged within `timeout` s."""
        deadline = time.monotonic() + timeout
        while True:
            self._look()
            left = max(0.0, deadline - time.monotonic())
            short = min(_LOOK_S, left)
            if self._feed(short):
                streams = self._streams
                if all([s.writer.flush(short) for s in streams]):
                    return True
            if left <= 0:
                return False

    def close(self, timeout: float = 10.0) -> bool:
        """Flushes and ends the writers; whether all was acknowledged."""
        try:
            return self.flush(timeout)
        finally:
            for stream in self._streams:
                stream.abandon()

    def _feed(self, timeout: float) -> bool:
        """Hands the pending rows to the shard's writer; whether it took them all."""
        deadline = time.monotonic() + timeout
        if self._stream is None:
            if not self._pending:
                return True
            self._changed.clear()
            self._changed.wait(timeout)
            self._idle_s += max(0.0, timeout - (deadline - time.monotonic()))
            return False
        stream, nothing = self._stream, np.zeros(0, self._spec.dtype)
        while True:
            left = max(0.0, deadline - time.monotonic())
            # A full batch that did not fit into the window is still the writer's.
            if not stream.writer.append(nothing, left):
                return False
            if not self._pending:
                return True
            room, piece = stream.writer.room, self._pending.popleft()
            if len(piece) > room:
                self._pending.appendleft(piece[room:])
                piece = piece[:room]
            if not self._durable:
                stream.settle()
                stream.kept.append(piece)
            stream.writer.append(piece, 0.0)  # taken also if the window is full

    def _look(self) -> None:
        """Moves if another shard is to be written to, ends what has been sent."""
        now = time.monotonic()
        up = self._directory.announced
        self._seen |= dict.fromkeys(up, now)
        self._known |= set(up)
        for stream in list(self._ending):
            gone = now - self._seen.get(stream.link.shard, 0.0) > _SETTLE_S
            if gone and not self._durable:
                self._pending.extendleft(reversed(self._end(stream)))
            elif stream.writer.flush(0.0):
                self._end(stream)
        settling = now - self._began < _SETTLE_S
        live = [n for n, seen in self._seen.items() if now - seen <= _SETTLE_S]
        target = home_of(
            self._writer,
            known=tuple(self._known),
            live=live,
            # At the start the shards become known one after the other.
            waits=self._durable or settling,
        )
        still = {stream.link.shard for stream in self._streams}
        self._directory.want(frozenset(still | {target}))
        link = next((x for x in self._directory.links if x.shard == target), None)
        if link is not None and (self._stream is None or self._stream.link is not link):
            self._move(link)

    def _move(self, link: ShardLink) -> None:
        former = self._stream
        if former is not None:
            self._ending.append(former)
        self._stream = _Stream(
            link=link,
            writer=Writer(
                session=link.session,
                keys=link.keys,
                spec=self._spec,
                writer=self._writer,
                epoch=self._epoch + self._moves,
                window=self._window,
                batch_rows=self._batch_rows,
            ),
        )
        self._moves += 1

    def _end(self, stream: _Stream) -> list[np.ndarray]:
        """Ends a stream; what it could not get acknowledged."""
        self._ending.remove(stream)
        left = stream.abandon()
        self._acknowledged += stream.writer.acknowledged
        self._waited_s += stream.writer.waited_s
        self._resent += stream.writer.resent
        return left
