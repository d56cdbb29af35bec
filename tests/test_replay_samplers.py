"""Uniform, FIFO and `max_times_sampled` against their definitions."""

import itertools
from collections import Counter
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from replay.limiter import LimiterError
from replay.local import LocalReplay, ReplayConfig
from replay.spec import ReplayError
from replay.table import Table
from tests.replay_parts import SPEC, make_rows

Name = Literal["prioritized", "uniform", "fifo"]


def make_table(sampler: Name, *, most: int, capacity: int = 7, seed: int = 0) -> Table:
    return Table(
        capacity=capacity,
        spec=SPEC,
        priority_exponent=1.0,
        seed=seed,
        sampler=sampler,
        max_times_sampled=most,
    )


def insert(table: Table, count: int) -> None:
    table.insert(SPEC.as_bytes(make_rows(table.inserts, count)))


def draw(table: Table, count: int) -> tuple[list[int], np.ndarray]:
    ids, chances = np.zeros(count, np.uint64), np.zeros(count)
    rows = np.zeros((count, SPEC.row_bytes), np.uint8)
    table.draw(batch_size=count, ids=ids, probabilities=chances)
    table.gather(ids, rows)
    numbers = rows.reshape(-1).view(SPEC.dtype)["number"]
    np.testing.assert_array_equal(numbers, ids)
    return ids.tolist(), chances


def fifo_slowly(left: dict[int, int], count: int) -> list[int]:
    """Oracle: always the oldest key, until it was taken as often as allowed."""
    drawn = []
    for _ in range(count):
        drawn.append(min(left))
        left[drawn[-1]] -= 1
        if left[drawn[-1]] == 0:
            del left[drawn[-1]]
    return drawn


@settings(deadline=None, max_examples=40)
@given(
    operations=st.lists(st.integers(-9, 7).filter(bool), min_size=1, max_size=30),
    most=st.integers(1, 4),
    sampler=st.sampled_from(["prioritized", "uniform", "fifo"]),
)
def test_rows_are_removed_when_they_were_drawn_so_often(
    operations: list[int], most: int, sampler: Name
) -> None:
    """Oracle: a dictionary of the draws that are left; a negative number is a draw."""
    table, left = make_table(sampler, most=most), {}
    for operation in operations:
        if operation > 0:
            left |= {table.inserts + k: most for k in range(operation)}
            insert(table, operation)
            left = {k: n for k, n in left.items() if k >= table.inserts - 7}
        elif -operation > sum(left.values()):
            with pytest.raises(ReplayError, match="cannot draw"):
                draw(table, -operation)
        else:
            drawn, _ = draw(table, -operation)
            if sampler == "fifo":
                assert drawn == fifo_slowly(left, -operation)
            else:
                for key, times in Counter(drawn).items():
                    left[key] -= times
                    assert left[key] >= 0
                left = {k: n for k, n in left.items() if n}
        table.check_invariants()
        assert table.size == len(left)
        assert table.deletes == table.inserts - len(left)
        assert table.read(0, 100)[0].tolist() == sorted(left)


@pytest.mark.parametrize("sampler", ["prioritized", "uniform"])
def test_limited_draws_are_those_taken_one_after_the_other(sampler: Name) -> None:
    """Chi-square of ordered pairs without replacement, against their definition."""
    weights = np.array([1.0, 2.0, 3.0, 6.0]) if sampler == "prioritized" else np.ones(4)
    shares = weights / weights.sum()
    expected = {
        (i, j): shares[i] * shares[j] / (1 - shares[i])
        for i, j in itertools.permutations(range(4), 2)
    }
    table, times = make_table(sampler, most=1, capacity=64), 500
    seen: Counter[tuple[int, ...]] = Counter()
    for _ in range(times):
        first = table.inserts
        insert(table, 4)
        table.update_priorities(np.arange(first, first + 4), weights)
        drawn, chances = draw(table, 2)
        seen[tuple(k - first for k in drawn)] += 1
        np.testing.assert_allclose(chances[0], shares[drawn[0] - first])
        draw(table, 2)  # the others go too: the next round begins with an empty table
        assert table.size == 0
    chi_square = sum(
        (seen[pair] - times * share) ** 2 / (times * share)
        for pair, share in expected.items()
    )
    assert chi_square < 11 + 5 * np.sqrt(22)  # 11 degrees of freedom, 5 deviations


@pytest.mark.parametrize("sampler", ["prioritized", "uniform"])
def test_a_few_rows_left_among_many_used_up_are_found(sampler: Name) -> None:
    table = make_table(sampler, most=1, capacity=4096)
    insert(table, 4096)
    seen = draw(table, 4000)[0]
    if sampler == "prioritized":  # none has any priority: what is left is uniform
        table.update_priorities(np.arange(4096), np.zeros(4096))
    seen += draw(table, 95)[0]
    seen += draw(table, 1)[0]
    assert sorted(seen) == list(range(4096))
    assert table.size == 0


def test_uniform_draws_cover_a_ring_that_has_come_round() -> None:
    table = make_table("uniform", most=0, capacity=50)
    insert(table, 40)
    insert(table, 40)
    counts = Counter(draw(table, 50)[0])  # stratified: each of 50 parts once
    assert counts == dict.fromkeys(range(30, 80), 1)


def test_removed_rows_cannot_be_given_priority() -> None:
    table = make_table("fifo", most=1)
    insert(table, 3)
    draw(table, 1)
    assert table.update_priorities(np.array([0, 1]), np.array([5.0, 5.0])) == 1
    table.check_invariants()


@pytest.mark.parametrize(
    ("settings_", "why"),
    [
        ({"sampler": "fifo"}, "would draw the oldest row for ever"),
        ({"max_times_sampled": 3}, "samples can never exceed inserts x 3"),
        ({"max_times_sampled": -1}, "must be 0"),
        ({"max_times_sampled": 2**31}, "must be 0"),
    ],
)
def test_settings_without_sense_are_refused(
    settings_: dict[str, int | str], why: str
) -> None:
    with pytest.raises(ReplayError, match=why):
        ReplayConfig(**settings_)


def test_samples_larger_than_what_may_be_left_are_refused() -> None:
    config = ReplayConfig(
        capacity=100, min_size=10, samples_per_insert=2.0, max_times_sampled=2
    )
    with pytest.raises(LimiterError, match="may have one draw left each"):
        config.limiter().check_batches(insert_rows=1, sample_rows=11)


@settings(deadline=None, max_examples=30)
@given(
    ratio=st.sampled_from([0.5, 1.0, 2.0]),
    most=st.integers(1, 4),
    min_size=st.integers(1, 12),
    spare=st.integers(0, 12),
    insert_rows=st.integers(1, 8),
    sample_rows=st.integers(1, 8),
    sampler=st.sampled_from(["prioritized", "uniform", "fifo"]),
    data=st.data(),
)
def test_accepted_settings_with_removal_never_block_both_sides(
    ratio: float,
    most: int,
    min_size: int,
    spare: int,
    insert_rows: int,
    sample_rows: int,
    sampler: Name,
    data: st.DataObject,
) -> None:
    """A real table, at the border of what is accepted, in any order."""
    needed = (sample_rows + insert_rows * ratio) / 2
    try:
        config = ReplayConfig(
            capacity=max(min_size, insert_rows) + spare,
            min_size=min_size,
            samples_per_insert=ratio,
            tolerance=needed / (ratio * min_size) + 1e-9,
            sampler=sampler,
            max_times_sampled=most,
        )
        config.limiter().check_batches(insert_rows=insert_rows, sample_rows=sample_rows)
    except LimiterError:
        return
    replay = LocalReplay(spec=SPEC, config=config, seed=0)
    for _ in range(60):
        a = data.draw(st.integers(1, insert_rows))
        b = data.draw(st.integers(1, sample_rows))
        may_insert, may_sample = replay.may_insert(a), replay.may_sample(b)
        assert may_insert or may_sample, (replay.inserts, replay.samples, replay.size)
        if may_insert and (not may_sample or data.draw(st.booleans())):
            replay.insert(make_rows(replay.inserts, a))
        else:
            replay.sample(b)
    replay.table.check_invariants()


def test_a_fifo_queue_hands_out_every_row_once_in_order() -> None:
    """samples_per_insert = max_times_sampled = 1: on-policy learning's queue."""
    config = ReplayConfig(
        capacity=64,
        min_size=8,
        samples_per_insert=1.0,
        tolerance=1.0,
        sampler="fifo",
        max_times_sampled=1,
    )
    replay, drawn = LocalReplay(spec=SPEC, config=config, seed=0), []
    for _ in range(200):
        while replay.may_insert(4):
            replay.insert(make_rows(replay.inserts, 4))
        while replay.may_sample(8):
            drawn += replay.sample(8).ids.tolist()
    assert drawn == list(range(len(drawn)))
    assert len(drawn) > 1000
    assert replay.samples_per_insert == pytest.approx(1.0, rel=0.02)
