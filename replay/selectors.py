"""Which slots of the ring are drawn: in proportion to priority, or uniformly.

Rows lie in a ring; those in the table are a window of it (`Window`). The tree is
torchrl's, which checks nothing: a bad index corrupts memory, so whoever calls has
checked slots and priorities. It is the float64 one: drawing 64 from a million costs
12 us against 10 in float32, and a float32 target near 10^6 moves in steps of 0.06, so
that light rows could not be drawn at all.
"""

import abc
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float, Int64

SamplerName = Literal["prioritized", "uniform", "fifo"]


@final
@dataclass(frozen=True)
class Window:
    """`size` slots of a ring of `capacity`, from slot `first` on."""

    first: int
    size: int
    capacity: int

    def slots(self) -> Int64[np.ndarray, " rows"]:
        """All of them, oldest row first."""
        return (self.first + np.arange(self.size)) % self.capacity


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
        self, positions: Float[np.ndarray, " rows"], window: Window
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Slots of the window and their probabilities.

        `positions` in (0, 1] are where in the total mass to draw.
        """

    @abc.abstractmethod
    def masses(self, slots: Int64[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """What the slots weigh: p^alpha, or 1."""

    @abc.abstractmethod
    def total(self, live: int) -> float:
        """The sum of the masses of the `live` rows that can be drawn."""

    @abc.abstractmethod
    def priorities(
        self, slots: Int64[np.ndarray, " rows"]
    ) -> Float[np.ndarray, " rows"]:
        """What the slots were given."""

    @property
    @abc.abstractmethod
    def memory_bytes(self) -> int:
        """What it takes."""


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
        self, positions: Float[np.ndarray, " rows"], window: Window
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """See the base class."""
        places = np.ceil(positions * window.size).astype(np.int64) - 1
        places = np.clip(places, 0, window.size - 1)
        slots = (window.first + places) % window.capacity
        return slots, np.full(len(slots), 1.0 / window.size)

    def masses(self, slots: Int64[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """All one."""
        return np.ones(len(slots))

    def total(self, live: int) -> float:
        """As many as there are."""
        return float(live)

    def priorities(
        self, slots: Int64[np.ndarray, " rows"]
    ) -> Float[np.ndarray, " rows"]:
        """All one: they are not kept."""
        return np.ones(len(slots))

    @property
    def memory_bytes(self) -> int:
        """Nothing."""
        return 0


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
        self, positions: Float[np.ndarray, " rows"], window: Window
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """See the base class."""
        total = self.total(window.size)
        if total <= 0.0:
            return UniformSelector().draw(positions, window)
        slots = self._scan(positions * total)
        masses = self._tree.at(slots)
        # A target within rounding of a boundary can land on a row without mass.
        for share in (0.5, 0.25, 0.75):
            empty = masses <= 0.0
            if not empty.any():
                return slots, masses / total
            moved = self._scan(positions[empty] * (total * share))
            slots[empty] = moved
            masses[empty] = self._tree.at(moved)
        everything = window.slots()
        heaviest = everything[int(np.argmax(self.masses(everything)))]
        slots[masses <= 0.0] = heaviest
        return slots, self._tree.at(slots) / total

    def _scan(self, targets: Float[np.ndarray, " rows"]) -> Int64[np.ndarray, " rows"]:
        """The first slot at which the running sum reaches the target."""
        # It returns the tree's size for a target above the sum.
        return np.minimum(self._tree.scan_lower_bound(targets), self._capacity - 1)

    def masses(self, slots: Int64[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """See the base class."""
        return self._tree.at(slots)

    def total(self, live: int) -> float:
        """See the base class."""
        return float(self._tree.query(0, self._capacity))

    def priorities(
        self, slots: Int64[np.ndarray, " rows"]
    ) -> Float[np.ndarray, " rows"]:
        """See the base class."""
        return self._tree.at(slots) ** (1.0 / self._exponent)

    @property
    def memory_bytes(self) -> int:
        """Two float64 per leaf, of which there are a power of two."""
        return 16 << (self._capacity - 1).bit_length()


def make_selector(
    name: SamplerName, *, capacity: int, exponent: float
) -> AbstractSelector:
    """The selector of these settings; only one with a tree loads torch.

    FIFO needs no selector: `Table` draws in the order of the ids.
    """
    if name == "prioritized" and exponent > 0.0:
        return PrioritizedSelector(capacity=capacity, exponent=exponent)
    return UniformSelector()
