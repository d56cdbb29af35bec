"""The table: rows in a ring, and which of them are drawn how often.

Rows have global ids 0, 1, 2, ... in the order of insertion; row `id` lies in slot
`id % capacity`, so the oldest are pushed out first (FIFO). Row i is drawn with
probability

    P(i) = p_i^alpha / sum_k p_k^alpha        (Schaul et al. 2016, eq. 1)

New rows have priority p = 1 (as Acme inserts them); the learner later sets |TD error|.
A batch of B is drawn stratified: one draw from each of B equal parts of the total
mass. Rows of priority 0 are not drawn; if all are 0, the draw is uniform. alpha = 0
is uniform sampling, and needs no tree (and no torch).

The tree is torchrl's, which checks nothing: a bad index corrupts memory. So ids and
priorities are checked here before anything is touched. It is the float64 one: drawing
64 from a million costs 12 us against 10 in float32, and a float32 target near 10^6
moves in steps of 0.06, so that light rows could not be drawn at all.
"""

import abc
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int64, Integer, UInt8, UInt64

from replay.spec import ReplayError, RowSpec

INITIAL_PRIORITY = 1.0
MAX_PRIORITY = 1e30  # larger ones would overflow the total mass of a full table


class PriorityError(ReplayError):
    """Priorities that cannot be sampled by."""


class AbstractSelector(abc.ABC):
    """Draws slots. Not thread-safe; its caller checks slots and priorities."""

    @abc.abstractmethod
    def set(
        self,
        slots: Int64[np.ndarray, " rows"],
        priorities: Float[np.ndarray, " rows"],
    ) -> None:
        """Gives these slots these priorities; of a repeated slot the last holds."""

    @abc.abstractmethod
    def draw(
        self, positions: Float[np.ndarray, " rows"], size: int
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Slots among the first `size` and their probabilities.

        `positions` in (0, 1] are where in the total mass to draw.
        """

    @abc.abstractmethod
    def masses(self, size: int) -> Float[np.ndarray, " rows"]:
        """p^alpha of the first `size` slots."""

    @abc.abstractmethod
    def total(self) -> float:
        """The sum that the draws go by."""


@final
class UniformSelector(AbstractSelector):
    """Every row is equally likely."""

    def set(
        self,
        slots: Int64[np.ndarray, " rows"],
        priorities: Float[np.ndarray, " rows"],
    ) -> None:
        """Priorities make no difference."""

    def draw(
        self, positions: Float[np.ndarray, " rows"], size: int
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """See the base class."""
        slots = np.ceil(positions * size).astype(np.int64) - 1
        return np.clip(slots, 0, size - 1), np.full(len(slots), 1.0 / size)

    def masses(self, size: int) -> Float[np.ndarray, " rows"]:
        """All one."""
        return np.ones(size)

    def total(self) -> float:
        """Not known here and not needed."""
        return float("nan")


@final
class PrioritizedSelector(AbstractSelector):
    """In proportion to priority^exponent, by a sum tree."""

    def __init__(self, *, capacity: int, exponent: float) -> None:
        """Starts with no mass."""
        # Here and not at the top: it takes seconds and half a gigabyte, and whoever
        # only samples uniformly or reads the configuration needs none of it.
        from torchrl._torchrl import SumSegmentTreeFp64

        self._exponent = exponent
        self._capacity = capacity
        self._tree: Any = SumSegmentTreeFp64(capacity)

    def set(
        self,
        slots: Int64[np.ndarray, " rows"],
        priorities: Float[np.ndarray, " rows"],
    ) -> None:
        """See the base class."""
        self._tree.update(slots, np.asarray(priorities**self._exponent, np.float64))

    def draw(
        self, positions: Float[np.ndarray, " rows"], size: int
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """See the base class."""
        total = self.total()
        if total <= 0.0:
            return UniformSelector().draw(positions, size)
        slots = self._scan(positions * total, size)
        masses = self._tree.at(slots)
        # A target within rounding of a boundary can land on a row without mass.
        for share in (0.5, 0.25, 0.75):
            empty = masses <= 0.0
            if not empty.any():
                return slots, masses / total
            moved = self._scan(positions[empty] * (total * share), size)
            slots[empty] = moved
            masses[empty] = self._tree.at(moved)
        heaviest = int(np.argmax(self.masses(size)))
        slots[masses <= 0.0] = heaviest
        return slots, self._tree.at(slots) / total

    def _scan(
        self, targets: Float[np.ndarray, " rows"], size: int
    ) -> Int64[np.ndarray, " rows"]:
        """The first slot at which the running sum reaches the target."""
        # It returns the tree's size for a target above the sum.
        return np.minimum(self._tree.scan_lower_bound(targets), size - 1)

    def masses(self, size: int) -> Float[np.ndarray, " rows"]:
        """See the base class."""
        return self._tree.at(np.arange(size))

    def total(self) -> float:
        """See the base class."""
        return float(self._tree.query(0, self._capacity))


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
    ) -> None:
        """An empty table; its memory is taken page by page as it fills."""
        if capacity < 1 or not 0.0 <= priority_exponent <= 1.0:
            raise ReplayError(
                f"capacity={capacity} must be at least 1 and "
                f"priority_exponent={priority_exponent} in [0, 1]"
            )
        self.capacity = capacity
        self.inserts = 0
        """Rows ever inserted; also the id of the next row."""
        self._rows = np.zeros((capacity, spec.row_bytes), np.uint8)
        self._ids = np.zeros(capacity, np.uint64)
        self._random = np.random.default_rng(seed)
        self._selector: AbstractSelector = UniformSelector()
        if priority_exponent > 0.0:
            self._selector = PrioritizedSelector(
                capacity=capacity, exponent=priority_exponent
            )

    @property
    def size(self) -> int:
        """Rows in the table."""
        return min(self.inserts, self.capacity)

    @property
    def deletes(self) -> int:
        """Rows pushed out."""
        return self.inserts - self.size

    def insert(self, rows: UInt8[np.ndarray, "rows row_bytes"]) -> None:
        """Appends rows, pushing out the oldest; one copy, or two where it wraps."""
        count = len(rows)
        if rows.shape[1] != self._rows.shape[1] or count > self.capacity:
            raise ReplayError(
                f"{count} rows of {rows.shape[1]} bytes do not fit a table of "
                f"{self.capacity} rows of {self._rows.shape[1]}"
            )
        ids = np.arange(self.inserts, self.inserts + count, dtype=np.uint64)
        first = self.inserts % self.capacity
        head = min(count, self.capacity - first)
        self._rows[first : first + head] = rows[:head]
        self._rows[: count - head] = rows[head:]
        self._ids[first : first + head] = ids[:head]
        self._ids[: count - head] = ids[head:]
        slots = (ids % np.uint64(self.capacity)).astype(np.int64)
        self._selector.set(slots, np.full(count, INITIAL_PRIORITY))
        self.inserts += count

    def draw(
        self,
        *,
        batch_size: int,
        ids: UInt64[np.ndarray, " rows"],
        probabilities: Float[np.ndarray, " rows"],
        rows: UInt8[np.ndarray, "rows row_bytes"],
    ) -> None:
        """Fills the given arrays with whole batches, each stratified by itself."""
        if self.size == 0 or len(ids) % batch_size:
            raise ReplayError(
                f"cannot draw {len(ids)} rows in batches of {batch_size} from a table "
                f"of {self.size}"
            )
        strata = np.tile(np.arange(1, batch_size + 1), len(ids) // batch_size)
        # In (0, 1]: a target of exactly 0 would find the first row even if it has
        # no mass.
        positions = (strata - self._random.random(len(ids))) / batch_size
        slots, probabilities[:] = self._selector.draw(positions, self.size)
        np.take(self._ids, slots, out=ids, mode="clip")
        # "clip" because "raise" makes NumPy gather into a buffer of its own first.
        np.take(self._rows, slots, axis=0, out=rows, mode="clip")

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
        slots = (wanted % np.uint64(self.capacity)).astype(np.int64)
        alive = (self._ids[slots] == wanted) & (slots < self.size)
        if alive.any():
            self._selector.set(slots[alive], priorities[alive].astype(np.float64))
        return int(len(ids) - alive.sum())

    def read(
        self, first_id: int, limit: int
    ) -> tuple[
        UInt64[np.ndarray, " rows"],
        Float[np.ndarray, " rows"],
        UInt8[np.ndarray, "rows row_bytes"],
    ]:
        """Ids, probabilities and rows that are left of `limit` ids from `first_id`."""
        start = max(first_id, self.deletes)
        stop = min(start + limit, self.inserts)
        ids = np.arange(start, max(start, stop), dtype=np.uint64)
        slots = (ids % np.uint64(self.capacity)).astype(np.int64)
        masses = self._selector.masses(self.size)
        probabilities = masses / max(masses.sum(), np.finfo(np.float64).tiny)
        return ids, probabilities[slots], self._rows[slots]

    def mean_mass(self) -> float:
        """Mean of p^alpha over the rows in the table; 0 when it is empty."""
        if self.size == 0 or isinstance(self._selector, UniformSelector):
            return float(self.size > 0)
        return self._selector.total() / self.size

    def check_invariants(self) -> None:
        """Asserts what must hold after every operation; for tests."""
        size = self.size
        slots = np.arange(size)
        ids = self._ids[:size]
        assert (ids % np.uint64(self.capacity) == slots.astype(np.uint64)).all()
        kept = np.arange(self.deletes, self.inserts, dtype=np.uint64)
        assert (np.sort(ids) == kept).all()
        masses = self._selector.masses(size)
        assert (np.isfinite(masses) & (masses >= 0)).all()
        if isinstance(self._selector, PrioritizedSelector):
            whole = self._selector.masses(self.capacity)
            assert (whole[size:] == 0).all()
            assert np.isclose(self._selector.total(), masses.sum(), rtol=1e-9)
