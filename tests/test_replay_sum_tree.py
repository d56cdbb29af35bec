"""The sum tree against its definition: running sums of the masses."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from replay.selectors import PrioritizedSelector, Window
from replay.sum_tree import SumTree, as_float32

SIZES = [1, 7, 256, 257, 4097, 70_000]  # no level, one, two, three
MASSES = st.one_of(
    st.sampled_from([0.0, 1e-30, 1.0, 1e30]), st.floats(0, 1e30), st.floats(0, 9)
)
UPDATES = st.lists(
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), MASSES), max_size=40),
    min_size=1,
    max_size=6,
)


def find_slowly(masses: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Oracle: the definition, with no tree."""
    return np.searchsorted(np.cumsum(masses, dtype=np.float64), targets)


def check_find(tree: SumTree, masses: np.ndarray, targets: np.ndarray) -> None:
    """Equal, but for targets within rounding of a boundary; never without mass."""
    found = tree.find(targets)
    assert (masses[found] > 0.0).all()
    sums = np.concatenate([[0.0], np.cumsum(masses, dtype=np.float64)])
    slack = 1e-13 * sums[-1]
    assert (sums[found] <= targets + slack).all()
    assert (sums[found + 1] >= targets - slack).all()


@settings(deadline=None, max_examples=60)
@given(capacity=st.sampled_from(SIZES), updates=UPDATES, seed=st.integers(0, 99))
@example(capacity=4097, updates=[[(0.1, 1e-30), (0.2, 1e30), (0.3, 1e-30)]], seed=0)
def test_tree_agrees_with_the_definition(
    capacity: int, updates: list[list[tuple[float, float]]], seed: int
) -> None:
    """Oracle: an array that a loop assigns to."""
    tree, masses = SumTree(capacity), np.zeros(capacity, np.float32)
    for update in updates:
        slots = np.array([int(place * capacity) for place, _ in update], np.int64)
        new = as_float32(np.array([mass for _, mass in update], np.float64))
        tree.update(slots, new)
        for slot, mass in zip(slots, new, strict=True):
            masses[slot] = mass
        tree.check_invariants()
        np.testing.assert_array_equal(tree.at(np.arange(capacity)), masses)
        total = masses.sum(dtype=np.float64)
        assert tree.total == pytest.approx(total, rel=1e-14)
        if total > 0.0:
            shares = 1.0 - np.random.default_rng(seed).random(32)
            boundaries = np.cumsum(masses[masses > 0.0], dtype=np.float64)[:32]
            targets = np.concatenate([shares * tree.total, boundaries])
            check_find(tree, masses, targets)


@pytest.mark.parametrize("capacity", SIZES)
def test_a_full_tree_agrees_with_the_definition(capacity: int) -> None:
    """Whole numbers, of which no sum is rounded: then it is exactly equal."""
    random = np.random.default_rng(0)
    tree = SumTree(capacity)
    for _ in range(3):
        masses = random.integers(0, 4, capacity).astype(np.float32)
        masses[-1] = 2.0
        tree.update(np.arange(capacity), masses)
        slots = random.integers(0, capacity, 100)
        masses[slots] = 1.0
        tree.update(slots, np.ones(100, np.float32))
        tree.check_invariants()
        assert tree.total == masses.sum()
        targets = random.integers(1, int(masses.sum()) + 1, 3000).astype(np.float64)
        np.testing.assert_array_equal(tree.find(targets), find_slowly(masses, targets))


def test_nothing_drifts_over_many_updates() -> None:
    """Sums are added up anew: a heavy row that came and went leaves no trace."""
    tree, ones = SumTree(5000), np.ones(5000, np.float32)
    tree.update(np.arange(5000), ones)
    for slot in range(0, 5000, 7):
        tree.update(np.array([slot]), np.array([1e30], np.float32))
        tree.update(np.array([slot]), np.array([1.0], np.float32))
    assert tree.total == 5000.0
    tree.check_invariants()


def test_targets_beyond_rounding_end_at_rows_with_mass() -> None:
    """Only the middle has mass; targets at both ends and above the sum find it."""
    for capacity in SIZES:
        tree, slot = SumTree(capacity), capacity // 2
        tree.update(np.array([slot]), np.array([0.3], np.float32))
        targets = tree.total * np.array([1e-300, 0.5, 1.0, 1.0 + 1e-12])
        assert tree.find(targets).tolist() == [slot] * 4
        assert [tree._find_one(float(target)) for target in targets] == [slot] * 4


def test_masses_stay_positive_and_finite() -> None:
    """The least float64 and the largest priority, with every kind of exponent."""
    values = np.array([0.0, 5e-324, 1e-60, 1.0, 1e30])
    for exponent in (1e-3, 0.6, 1.0):
        selector = PrioritizedSelector(capacity=300, exponent=exponent)
        selector.set(np.arange(5), values)
        masses = selector.masses(np.arange(5))
        assert (masses[1:] > 0.0).all() and masses[0] == 0.0
        assert np.isfinite(masses).all() and np.isfinite(selector.total(5))
        selector.check_invariants()


def test_probabilities_are_those_of_the_masses_that_are_drawn_by() -> None:
    """Against float64 throughout: float32 masses cost less than 1e-6 of a weight."""
    random, capacity = np.random.default_rng(1), 20_000
    priorities = random.lognormal(0.0, 6.0, capacity)
    selector = PrioritizedSelector(capacity=capacity, exponent=0.6)
    selector.set(np.arange(capacity), priorities)
    exact = priorities**0.6 / (priorities**0.6).sum()
    positions = 1.0 - random.random(4096)
    slots, told = selector.draw(positions, Window(0, capacity, capacity))
    np.testing.assert_allclose(told, exact[slots], rtol=2e-7)
    for beta in (0.4, 1.0):
        weights = (capacity * told) ** -beta
        np.testing.assert_allclose(weights, (capacity * exact[slots]) ** -beta, 1e-6)


@pytest.mark.parametrize("capacity", [100_000, 131_073, 1_000_000])
def test_the_tree_takes_less_than_five_bytes_a_slot(capacity: int) -> None:
    assert SumTree(capacity).memory_bytes <= 5 * capacity
