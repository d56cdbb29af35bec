"""Rows that a sampler keeps: what both ends must agree on, against the definition."""

import threading

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.mirror import MAX_MIRROR_BYTES, Mirror, SentRows, may_mirror

ROW_BYTES = 8


def row_of(ids: np.ndarray) -> np.ndarray:
    """A row's bytes follow from its id."""
    return (ids + np.uint64(1)).astype("<u8").view(np.uint8).reshape(-1, ROW_BYTES)


@given(
    capacity=st.integers(1, 9),
    turns=st.lists(st.tuples(st.integers(0, 20), st.integers(1, 12)), max_size=30),
    data=st.data(),
)
def test_a_sampler_has_every_row_that_it_draws_and_is_sent_each_once(
    capacity: int, turns: list[tuple[int, int]], data: st.DataObject
) -> None:
    """Inserts and draws in any order; what is sent is what the definition says."""
    sent, mirror = SentRows(capacity), Mirror(capacity=capacity, row_bytes=ROW_BYTES)
    known: set[int] = set()  # the oracle: ids that were ever sent
    inserts = 0
    for inserted, drawn in turns:
        inserts += inserted
        if not inserts:
            continue
        live = st.integers(max(0, inserts - capacity), inserts - 1)
        ids = np.array([data.draw(live) for _ in range(drawn)], np.uint64)
        new = ids[sent.unsent(ids, inserts)]
        assert [int(i) for i in new] == list(
            dict.fromkeys(int(i) for i in ids if int(i) not in known)
        )
        known |= {int(i) for i in new}
        assert mirror.keep(ids, row_of(new)) and mirror.kept == len(known)
        rows = np.zeros((drawn, ROW_BYTES), np.uint8)
        mirror.gather(ids, rows)
        assert (rows == row_of(ids)).all()


@pytest.mark.parametrize("wrong", ["fewer", "more", "another"])
def test_other_rows_than_are_lacking_are_noticed(wrong: str) -> None:
    mirror = Mirror(capacity=4, row_bytes=ROW_BYTES)
    ids = np.array([1, 2, 1], np.uint64)
    if wrong == "another":  # two rows of one slot cannot both be in the table
        ids[1] = 5
    rows = row_of(
        np.arange({"fewer": 1, "more": 3, "another": 1}[wrong], dtype=np.uint64)
    )
    assert not mirror.keep(ids, rows)


def test_a_table_that_is_too_large_is_not_kept() -> None:
    assert may_mirror(MAX_MIRROR_BYTES // 8192, 8192)
    assert not may_mirror(MAX_MIRROR_BYTES // 8192 + 1, 8192)
    assert not may_mirror(0, 8192)


def test_what_was_kept_is_the_systems_again() -> None:
    """Each connection has a thread of its own, which may have a heap of its own."""
    capacity, row_bytes, threads = 1 << 17, 128, 6
    all_began, rows = threading.Barrier(threads), np.ones((256, row_bytes), np.uint8)

    def connect() -> None:
        for _ in range(3):
            all_began.wait()
            mirror = Mirror(capacity=capacity, row_bytes=row_bytes)
            for ids in np.arange(capacity, dtype=np.uint64).reshape(-1, 256):
                assert mirror.keep(ids, rows)

    before = psutil.Process().memory_info().rss
    connections = [threading.Thread(target=connect) for _ in range(threads)]
    for connection in connections:
        connection.start()
    for connection in connections:
        connection.join()
    grown = psutil.Process().memory_info().rss - before
    assert grown < 2 * capacity * row_bytes
