"""The table against its definition: FIFO ring, proportional stratified draws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from replay.limiter import LimiterError
from replay.local import LocalReplay, ReplayConfig
from replay.spec import ReplayError, Sample
from replay.table import PriorityError, Table
from tests.replay_parts import SMALL, SPEC, make_rows


def make_table(capacity: int, *, exponent: float = 0.6, seed: int = 0) -> Table:
    return Table(capacity=capacity, spec=SPEC, priority_exponent=exponent, seed=seed)


def insert(table: Table, start: int, count: int) -> None:
    table.insert(SPEC.as_bytes(make_rows(start, count)))


def draw(table: Table, batch_size: int, batches: int = 1) -> Sample:
    count = batch_size * batches
    ids, probabilities = np.zeros(count, np.uint64), np.zeros(count)
    rows = np.zeros((count, SPEC.row_bytes), np.uint8)
    table.draw(batch_size=batch_size, ids=ids, probabilities=probabilities)
    table.gather(ids, rows)
    return Sample(
        ids=ids,
        probabilities=probabilities,
        rows=rows.reshape(-1).view(SPEC.dtype),
        size=table.size,
        inserts=table.inserts,
        mass=table.mass(),
    )


# Float32, as masses are: smaller ones count as the smallest of these.
PRIORITIES = st.floats(0, 1e3, width=32, allow_subnormal=False)
operations = st.lists(
    st.one_of(
        st.integers(1, 7),
        st.lists(st.tuples(st.integers(0, 60), PRIORITIES), max_size=6),
    ),
    min_size=1,
    max_size=25,
)


@settings(deadline=None)
@given(operations=operations, exponent=st.sampled_from([0.0, 0.6, 1.0]))
def test_table_agrees_with_a_dictionary(
    operations: list[int | list[tuple[int, float]]], exponent: float
) -> None:
    """Oracle: a dictionary of priorities, whose oldest keys are removed."""
    table, oracle, inserted = make_table(7, exponent=exponent), {}, 0
    for operation in operations:
        if isinstance(operation, int):
            insert(table, inserted, operation)
            oracle |= {inserted + k: 1.0 for k in range(operation)}
            inserted += operation
            oracle = {k: p for k, p in oracle.items() if k >= inserted - 7}
        else:
            ids = np.array([k for k, _ in operation], np.uint64)
            stale = table.update_priorities(ids, np.array([p for _, p in operation]))
            assert stale == sum(k not in oracle for k, _ in operation)
            oracle |= {k: p for k, p in operation if k in oracle}
        table.check_invariants()
        ids, probabilities, rows = table.read(0, 100)
        assert ids.tolist() == sorted(oracle)
        masses = np.array([oracle[k] ** exponent for k in sorted(oracle)])
        expected = masses / masses.sum() if masses.sum() else masses
        # Masses are float32.
        np.testing.assert_allclose(probabilities, expected, rtol=1e-6)
        stored = rows.reshape(-1).view(SPEC.dtype)
        assert stored["number"].tolist() == sorted(oracle)


@settings(deadline=None)
@given(
    priorities=st.lists(st.integers(0, 9), min_size=1, max_size=40).filter(any),
    batch_size=st.integers(1, 16),
)
def test_stratified_draws_agree_with_the_definition(
    priorities: list[int], batch_size: int
) -> None:
    """Each draw lies in its own part of the running sum, found without a tree."""
    table = make_table(40, exponent=1.0)
    insert(table, 0, len(priorities))
    table.update_priorities(np.arange(len(priorities)), np.array(priorities, float))
    sample = draw(table, batch_size, 3)
    sums = np.concatenate([[0], np.cumsum(priorities)]) * batch_size / sum(priorities)
    strata = np.tile(np.arange(batch_size), 3)
    slots = sample.ids.astype(np.int64)
    assert (sums[slots] <= strata + 1 + 1e-9).all()
    assert (sums[slots + 1] >= strata - 1e-9).all()
    expected = np.array(priorities)[slots] / sum(priorities)
    assert (expected > 0).all()
    np.testing.assert_allclose(sample.probabilities, expected, rtol=1e-12)
    np.testing.assert_array_equal(sample.rows["number"], slots)


@pytest.mark.parametrize("exponent", [0.0, 0.6, 1.0])
def test_draws_are_in_proportion(exponent: float) -> None:
    """Chi-square of single draws (batches of one, so that they are independent)."""
    rows, draws = 50, 40_000
    table = make_table(64, exponent=exponent, seed=3)
    insert(table, 0, rows)
    priorities = np.random.default_rng(1).gamma(1.0, size=rows)
    table.update_priorities(np.arange(rows), priorities)
    counts = np.bincount(draw(table, 1, draws).ids.astype(int), minlength=rows)
    expected = draws * priorities**exponent / (priorities**exponent).sum()
    chi_square = ((counts - expected) ** 2 / expected).sum()
    # 49 degrees of freedom: mean 49, deviation 9.9; 5 deviations.
    assert chi_square < 49 + 5 * np.sqrt(2 * 49)


def test_stratified_batches_vary_less_than_independent_draws() -> None:
    table = make_table(64, exponent=1.0)
    insert(table, 0, 64)
    for _ in range(20):
        assert len(set(draw(table, 64).ids.tolist())) == 64


def test_light_rows_of_a_heavy_table_are_drawn() -> None:
    """Sums in float64 resolve 1e-9 of the mass; float32 ones never draw it."""
    table = make_table(1 << 17, exponent=1.0)
    insert(table, 0, 1 << 17)
    table.update_priorities(np.arange(1 << 17), np.full(1 << 17, 0.0))
    table.update_priorities(np.array([3, 70_000]), np.array([1.0, 1e9]))
    positions = np.array([0.5e-9, 0.9e-9, 1.5e-9, 1.0])
    slots, probabilities = table._selector.draw(positions, table._window)
    assert slots.tolist() == [3, 3, 70_000, 70_000]
    np.testing.assert_allclose(probabilities[:1], 1e-9, rtol=1e-6)


def test_rows_without_any_priority_are_drawn_uniformly() -> None:
    table = make_table(8)
    insert(table, 0, 5)
    table.update_priorities(np.arange(5), np.zeros(5))
    sample = draw(table, 100)
    assert set(sample.ids.tolist()) == set(range(5))
    np.testing.assert_array_equal(sample.probabilities, 0.2)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e-3, 1e31])
def test_bad_priorities_are_refused_and_change_nothing(bad: float) -> None:
    table = make_table(8)
    insert(table, 0, 5)
    before = table.read(0, 8)[1]
    with pytest.raises(PriorityError, match="of row 3"):
        table.update_priorities(np.array([1, 3]), np.array([9.0, bad]))
    np.testing.assert_array_equal(table.read(0, 8)[1], before)
    table.check_invariants()


@pytest.mark.parametrize("stale", [0, 3, 12, 2**63, 2**64 - 1])
def test_ids_that_are_not_there_are_skipped_and_counted(stale: int) -> None:
    table = make_table(8)
    insert(table, 0, 6)
    insert(table, 6, 6)  # ids 4 to 11 are left
    ids = np.array([stale, 5], np.uint64)
    assert table.update_priorities(ids, np.array([50.0, 2.0])) == 1
    masses = table._selector.masses(np.arange(8))
    assert masses[5] == pytest.approx(2.0**0.6)
    assert (np.delete(masses, 5) == 1.0).all()


def test_empty_slots_cannot_be_given_priority() -> None:
    table = make_table(8)
    insert(table, 0, 1)
    # Slot 3 holds nothing yet, though its stored id (0) is not 3's either way; id 0
    # in slot 0 is alive, and a never-given id of an empty slot is not.
    assert table.update_priorities(np.array([0, 3, 8]), np.array([2.0, 5.0, 5.0])) == 2
    table.check_invariants()


def test_misuse_is_refused() -> None:
    table = make_table(4)
    with pytest.raises(ReplayError, match="cannot draw 2 rows"):
        draw(table, 2)
    with pytest.raises(ReplayError, match="do not fit"):
        insert(table, 0, 5)
    with pytest.raises(PriorityError, match="2 ids but 1 priorities"):
        table.update_priorities(np.array([0, 1]), np.array([1.0]))
    with pytest.raises(ReplayError, match="priority_exponent"):
        make_table(4, exponent=1.5)


def run_local(seed: int) -> tuple[LocalReplay, list[int]]:
    """Inserts and samples as the limiter lets them, with made-up priorities."""
    replay, drawn, inserted = LocalReplay(spec=SPEC, config=SMALL, seed=seed), [], 0
    for _ in range(500):
        while replay.may_insert(4):
            replay.insert(make_rows(inserted, 4))
            inserted += 4
        while replay.may_sample(8):
            sample = replay.sample(8)
            np.testing.assert_array_equal(sample.rows["number"], sample.ids)
            replay.update_priorities(sample.ids, sample.ids % 7 + 0.5)
            drawn += sample.ids.tolist()
    replay.table.check_invariants()
    return replay, drawn


def test_local_replay_is_deterministic_and_keeps_the_ratio() -> None:
    first, drawn = run_local(seed=5)
    assert drawn == run_local(seed=5)[1]
    assert drawn != run_local(seed=6)[1]
    assert first.samples_per_insert == pytest.approx(2.0, rel=0.02)


def test_local_replay_refuses_what_the_limiter_does_not_admit() -> None:
    replay = LocalReplay(spec=SPEC, config=SMALL, seed=0)
    with pytest.raises(LimiterError, match="samples before"):
        replay.sample(8)
    replay.insert(make_rows(0, 10))
    with pytest.raises(LimiterError, match="inserts before"):
        replay.insert(make_rows(10, 64))


def test_updates_of_rows_that_are_gone_are_counted() -> None:
    config = ReplayConfig(
        capacity=10, min_size=10, samples_per_insert=1.0, tolerance=3.0
    )
    replay = LocalReplay(spec=SPEC, config=config, seed=0)
    replay.insert(make_rows(0, 10))
    replay.insert(make_rows(10, 5))
    replay.update_priorities(np.array([4, 5]), np.array([2.0, 2.0]))
    assert replay.stale_updates == 1
