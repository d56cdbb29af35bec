"""Which slots of the ring are drawn: in proportion to priority, or uniformly.

Rows lie in a ring; those in the table are a window of it (`Window`). Masses are
float32 and their sums float64 (`replay.sum_tree`), and the probabilities told are those
of these masses: a float32 target near 10^6 would move in steps of 0.06, so that light
rows could not be drawn at all, while a rounded mass only is another mass.
"""

import abc
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float, Int64

from replay.sum_tree import SumTree, as_float32

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
        self._exponent = exponent
        self._tree = SumTree(capacity)

    def set(
        self,
        slots: Int64[np.ndarray, " rows"],
        priorities: Float[np.ndarray, " rows"],
    ) -> None:
        """See the base class."""
        wide = np.asarray(priorities, np.float64)
        self._tree.update(slots, as_float32(wide**self._exponent))

    def draw(
        self, positions: Float[np.ndarray, " rows"], window: Window
    ) -> tuple[Int64[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """See the base class."""
        total = self._tree.total
        if total <= 0.0:
            return UniformSelector().draw(positions, window)
        slots = self._tree.find(positions * total)
        return slots, self._tree.at(slots) / total

    def masses(self, slots: Int64[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """See the base class."""
        return self._tree.at(slots)

    def total(self, live: int) -> float:
        """See the base class."""
        return self._tree.total

    def priorities(
        self, slots: Int64[np.ndarray, " rows"]
    ) -> Float[np.ndarray, " rows"]:
        """See the base class."""
        return self._tree.at(slots) ** (1.0 / self._exponent)

    @property
    def memory_bytes(self) -> int:
        """4.6 bytes per slot."""
        return self._tree.memory_bytes

    def check_invariants(self) -> None:
        """Asserts what must hold after every operation; for tests."""
        self._tree.check_invariants()


def make_selector(
    name: SamplerName, *, capacity: int, exponent: float
) -> AbstractSelector:
    """The selector of these settings.

    FIFO needs no selector: `Table` draws in the order of the ids.
    """
    if name == "prioritized" and exponent > 0.0:
        return PrioritizedSelector(capacity=capacity, exponent=exponent)
    return UniformSelector()
