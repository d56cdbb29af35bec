"""The table: rows in a ring, and which of them are drawn how often.

Rows have global ids 0, 1, 2, ... in the order of insertion; row `id` lies in slot
`id % capacity`, so the oldest are pushed out first (FIFO). Three ways to draw:

    prioritized   row i with probability P(i) = p_i^alpha / sum_k p_k^alpha (Schaul et
                  al. 2016, eq. 1). New rows have p = 1 (as Acme inserts them); the
                  learner later sets |TD error|. Rows of priority 0 are not drawn; if
                  all are 0, the draw is uniform
    uniform       every row alike; needs no tree, as does alpha = 0
    fifo          always the oldest row (Reverb's Fifo selector), until it is removed

A batch of B is drawn stratified: one draw from each of B equal parts of the total mass.

`max_times_sampled` (Reverb): a row that has been drawn so often is removed at once. Its
slot stays empty until the ring comes round, so `capacity` counts slots from the oldest
row kept. Draws are then independent and not stratified: those of rows that are used up
are refused and drawn again, which makes the draws exactly those taken one after the
other, each from what is left; a draw's probability is that of the round it came in.

Ids and priorities are checked here before a tree is touched.
"""

from typing import final

import numpy as np
from jaxtyping import Float, Int64, Integer, UInt8, UInt64

from replay.selectors import PrioritizedSelector, SamplerName, Window, make_selector
from replay.spec import ReplayError, RowSpec
from replay.storage import AbstractStorage, MemoryStorage, WriterMark
from replay.sum_tree import as_float32

INITIAL_PRIORITY = 1.0
MAX_PRIORITY = np.float32(1e30)  # and so masses, and any sum of them, are finite
_ROUNDS = 8  # of refused draws before the rows that are left are listed


class PriorityError(ReplayError):
    """Priorities that cannot be sampled by."""


@final
class Table:
    """Ring, ids and selector. Not thread-safe: one thread owns it."""

    def __init__(
        self,
        *,
        capacity: int,
        spec: RowSpec,
        priority_exponent: float,
        seed: int | np.random.SeedSequence,
        sampler: SamplerName = "prioritized",
        max_times_sampled: int = 0,
        storage: AbstractStorage | None = None,
    ) -> None:
        """Takes up what the storage holds; without one, an empty table in memory."""
        if capacity < 1 or not 0.0 <= priority_exponent <= 1.0:
            raise ReplayError(
                f"capacity={capacity} must be at least 1 and "
                f"priority_exponent={priority_exponent} in [0, 1]"
            )
        self.capacity = capacity
        self._storage = storage or MemoryStorage(
            capacity=capacity,
            row_bytes=spec.row_bytes,
            count_draws=max_times_sampled > 0,
        )
        self._rows = self._storage.rows
        self._most = max_times_sampled
        self._fifo = sampler == "fifo"
        self._random = np.random.default_rng(seed)
        self._selector = make_selector(
            sampler, capacity=capacity, exponent=priority_exponent
        )
        self.inserts = self._storage.state.inserts
        """Rows ever inserted; also the id of the next row."""
        self._oldest = self._storage.state.oldest
        self._removed = 0  # of the rows from the oldest on: drawn as often as allowed
        self._cursor = self._oldest  # FIFO: no row below this id is left
        self._take_up()

    def _take_up(self) -> None:
        """Rebuilds what is derived from the storage: one scan of its columns."""
        slots = self._window.slots()
        if not len(slots):
            return
        live = self._live(slots)
        self._removed = int(len(slots) - live.sum())
        if live.any():
            self._cursor = self._oldest + int(np.argmax(live))
        priorities = np.full(len(slots), INITIAL_PRIORITY, np.float32)
        if self._storage.priorities is not None:
            priorities = self._storage.priorities[slots]
        # What a power loss left half written must not reach the tree.
        sound = (priorities >= 0.0) & (priorities <= MAX_PRIORITY)
        priorities = np.where(sound, priorities, INITIAL_PRIORITY)
        self._selector.set(slots, np.where(live, priorities, 0.0))

    @property
    def size(self) -> int:
        """Rows in the table."""
        return self.inserts - self._oldest - self._removed

    @property
    def deletes(self) -> int:
        """Rows pushed out, or removed because they were drawn as often as allowed."""
        return self.inserts - self.size

    @property
    def _window(self) -> Window:
        """The slots from the oldest row to the newest."""
        return Window(
            self._oldest % self.capacity, self.inserts - self._oldest, self.capacity
        )

    def _live(self, slots: Int64[np.ndarray, " rows"]) -> np.ndarray:
        """Which of the window's slots hold a row that may still be drawn."""
        if self._storage.times is None:
            return np.ones(len(slots), bool)
        return self._storage.times[slots] < self._most

    def _ids_of(self, slots: Int64[np.ndarray, " rows"]) -> Int64[np.ndarray, " rows"]:
        """The ids of the rows in these slots of the window."""
        return self.inserts - 1 - (self.inserts - 1 - slots) % self.capacity

    # Inserting

    def insert(
        self,
        rows: UInt8[np.ndarray, "rows row_bytes"],
        mark: WriterMark | None = None,
    ) -> None:
        """Appends rows, pushing out the oldest; one copy, or two where it wraps.

        `mark` says where their writer stands with them: stored together or not at all.
        """
        count = len(rows)
        if rows.shape[1] != self._rows.shape[1] or count > self.capacity:
            raise ReplayError(
                f"{count} rows of {rows.shape[1]} bytes do not fit a table of "
                f"{self.capacity} rows of {self._rows.shape[1]}"
            )
        storage = self._storage
        slots = (self.inserts + np.arange(count)) % self.capacity
        self._push_out(max(self._oldest, self.inserts + count - self.capacity))
        head = min(count, self.capacity - int(slots[0]))
        storage.write_rows(int(slots[0]), rows[:head])
        if head < count:
            storage.write_rows(0, rows[head:])
        if storage.priorities is not None:
            storage.priorities[slots] = INITIAL_PRIORITY
        if storage.times is not None:
            storage.times[slots] = 0
        storage.commit(self.inserts + count, mark)
        self.inserts += count
        self._selector.set(slots, np.full(count, INITIAL_PRIORITY))

    def _push_out(self, oldest: int) -> None:
        """Forgets the rows below this id, before their slots are overwritten."""
        if oldest == self._oldest:
            return
        if self._removed:
            gone = np.arange(self._oldest, min(oldest, self.inserts)) % self.capacity
            self._removed -= int(len(gone) - self._live(gone).sum())
        self._storage.evict(oldest)
        self._oldest = oldest

    # Drawing

    def draw(
        self,
        *,
        batch_size: int,
        ids: UInt64[np.ndarray, " rows"],
        probabilities: Float[np.ndarray, " rows"],
    ) -> None:
        """Fills the given arrays with whole batches, each stratified by itself.

        The rows are had by `gather`, before anything else is inserted.
        """
        count = len(ids)
        if self.size == 0 or count % batch_size or not self._can_draw(count):
            raise ReplayError(
                f"cannot draw {count} rows in batches of {batch_size} from a table "
                f"of {self.size}"
            )
        if self._fifo:
            slots = self._draw_oldest(count)
            probabilities[:] = 1.0
        elif self._most:
            slots, probabilities[:] = self._draw_limited(count)
        else:
            strata = np.tile(np.arange(1, batch_size + 1), count // batch_size)
            # In (0, 1]: a target of exactly 0 would find the first row even if it has
            # no mass.
            positions = (strata - self._random.random(count)) / batch_size
            slots, probabilities[:] = self._selector.draw(positions, self._window)
        ids[:] = self._ids_of(slots)

    def gather(
        self,
        ids: UInt64[np.ndarray, " rows"],
        rows: UInt8[np.ndarray, "rows row_bytes"],
    ) -> None:
        """Copies the rows of ids that have just been drawn."""
        slots = (ids % np.uint64(self.capacity)).astype(np.int64)
        # "clip" because "raise" makes NumPy gather into a buffer of its own first.
        np.take(self._rows, slots, axis=0, out=rows, mode="clip")

    def _can_draw(self, count: int) -> bool:
        """Whether the rows that are left may be drawn so often in all."""
        times = self._storage.times
        if times is None or count <= self.size:
            return True
        slots = self._window.slots()
        return bool((self._most - times[slots].astype(np.int64)).sum() >= count)

    def _draw_oldest(self, count: int) -> Int64[np.ndarray, " rows"]:
        """The oldest row as often as it may be drawn, then the next."""
        times = self._storage.times
        assert times is not None
        self._cursor = max(self._cursor, self._oldest)
        last = min(self.inserts, self._cursor + count + 1)
        slots = np.arange(self._cursor, last) % self.capacity
        left = self._most - times[slots].astype(np.int64)
        drawn = np.repeat(slots, left)[:count]
        self._use_up(drawn)
        self._cursor = int(self._ids_of(drawn[-1:])[0])
        return drawn

    def _draw_limited(
        self, count: int
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Independent draws, none of a row that has been drawn often enough."""
        times = self._storage.times
        assert times is not None
        slots, probabilities = np.zeros(0, np.int64), np.zeros(0)
        rounds = 0
        while len(slots) < count:
            positions = 1.0 - self._random.random(count - len(slots))
            drawn, chances = self._round(positions, listed=rounds >= _ROUNDS)
            left = self._most - times[drawn].astype(np.int64)
            kept = _earlier_copies(drawn) < left
            slots = np.concatenate([slots, drawn[kept]])
            probabilities = np.concatenate([probabilities, chances[kept]])
            self._use_up(drawn[kept])
            rounds += 1
        return slots, probabilities

    def _round(
        self, positions: Float[np.ndarray, " rows"], *, listed: bool
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Draws from what is left now; unless `listed` some may be used up."""
        if listed:
            slots = self._window.slots()
            slots = slots[self._live(slots)]
            sums = np.cumsum(self._selector.masses(slots))
            if sums[-1] <= 0.0:
                sums = np.arange(1.0, len(slots) + 1)
            drawn = slots[np.searchsorted(sums, positions * sums[-1])]
        else:
            drawn, _ = self._selector.draw(positions, self._window)
        total = self._selector.total(self.size)
        if total <= 0.0:
            return drawn, np.full(len(drawn), 1.0 / self.size)
        return drawn, self._selector.masses(drawn) / total

    def _use_up(self, slots: Int64[np.ndarray, " rows"]) -> None:
        """Counts draws; removes the rows that may not be drawn again."""
        times = self._storage.times
        assert times is not None
        np.add.at(times, slots, 1)
        full = np.unique(slots[times[slots] >= self._most])
        self._removed += len(full)
        self._selector.set(full, np.zeros(len(full)))

    def update_priorities(
        self,
        ids: Integer[np.ndarray, " updates"],
        priorities: Float[np.ndarray, " priorities"],
    ) -> int:
        """Sets priorities; returns how many ids were gone (or never given out).

        Raises before anything is changed if a priority is NaN, infinite, negative
        or above `MAX_PRIORITY`.
        """
        if len(ids) != len(priorities):
            raise PriorityError(f"{len(ids)} ids but {len(priorities)} priorities")
        good = (priorities >= 0.0) & (priorities <= MAX_PRIORITY)  # NaN is neither
        if not good.all():
            raise PriorityError(
                f"priority {priorities[~good][0]} of row {ids[~good][0]}: must be in "
                f"[0, {MAX_PRIORITY:g}]; has the loss diverged?"
            )
        wanted = ids.astype(np.uint64)
        there = (wanted >= np.uint64(self._oldest)) & (wanted < np.uint64(self.inserts))
        slots = (wanted[there] % np.uint64(self.capacity)).astype(np.int64)
        new = as_float32(priorities[there])
        live = self._live(slots)
        slots, new = slots[live], new[live]
        if len(slots):
            if self._storage.priorities is not None:
                self._storage.priorities[slots] = new
            self._selector.set(slots, new)
        return int(len(ids) - len(slots))

    # Questions

    def read(
        self, first_id: int, limit: int
    ) -> tuple[
        UInt64[np.ndarray, " rows"],
        Float[np.ndarray, " rows"],
        UInt8[np.ndarray, "rows row_bytes"],
    ]:
        """Ids, probabilities and bytes of the first `limit` rows from `first_id`."""
        start = min(max(first_id, self._oldest), self.inserts)
        # Without removed rows the next `limit` ids are all there.
        reach = self.inserts if self._removed else min(start + limit, self.inserts)
        ids = np.arange(start, max(start, reach), dtype=np.int64)
        ids = ids[self._live(ids % self.capacity)][:limit]
        slots = ids % self.capacity
        total = self._selector.total(self.size)
        probabilities = self._selector.masses(slots) / max(total, 1e-300)
        return ids.astype(np.uint64), probabilities, self._rows[slots]

    def ages_and_priorities(
        self, most: int = 4096
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Rows inserted since, and priority, of up to `most` rows spread evenly."""
        slots = self._window.slots()
        slots = slots[:: max(1, len(slots) // most)]
        slots = slots[self._live(slots)]
        ages = self.inserts - 1 - self._ids_of(slots)
        return ages, self._selector.priorities(slots)

    @property
    def memory_bytes(self) -> int:
        """Rows, the columns beside them and the selector, once the table is full."""
        storage = self._storage
        columns = (storage.rows, storage.priorities, storage.times)
        stored = sum(column.nbytes for column in columns if column is not None)
        return stored + self._selector.memory_bytes

    def mass(self) -> float:
        """Sum over the table of what rows are drawn in proportion to: p^alpha, or 1."""
        return self._selector.total(self.size) if self.size else 0.0

    def mean_mass(self) -> float:
        """Mean of p^alpha over the rows in the table; 0 when it is empty."""
        return self.mass() / max(1, self.size)

    def check_invariants(self) -> None:
        """Asserts what must hold after every operation; for tests."""
        slots = self._window.slots()
        assert 0 <= self._oldest <= self.inserts <= self._oldest + self.capacity
        ids = np.arange(self._oldest, self.inserts)
        assert (self._ids_of(slots) == ids).all()
        live = self._live(slots)
        assert self.size == live.sum()
        masses = self._selector.masses(slots)
        assert (np.isfinite(masses) & (masses >= 0)).all()
        if isinstance(self._selector, PrioritizedSelector):
            whole = self._selector.masses(np.arange(self.capacity))
            assert np.isclose(whole.sum(), masses[live].sum(), rtol=1e-9)
            self._selector.check_invariants()
            assert np.isclose(self._selector.total(self.size), whole.sum(), rtol=1e-9)


def _earlier_copies(values: Int64[np.ndarray, " rows"]) -> Int64[np.ndarray, " rows"]:
    """How often each value occurs before its place."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    starts = np.searchsorted(ordered, ordered, side="left")
    ranks = np.empty(len(values), np.int64)
    ranks[order] = np.arange(len(values)) - starts
    return ranks
