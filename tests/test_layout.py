"""The arrays of a bank: types that hold their values, and what 32 bits cannot count."""

import numpy as np
import pytest

from sim import bank
from sim.layout import (
    COUNTED,
    NARROWED,
    PADDED,
    STARTS,
    TABLES,
    Layout,
    LayoutError,
    Sizes,
    placed,
    sizes_of,
)
from sim.parts import part_of
from tests import scenes


def sizes() -> Sizes:
    """Those of a small scene."""
    return sizes_of(part_of(scenes.scene_of([scenes.driver()])).load())


def with_rows(known: Sizes, name: str, rows: int) -> Sizes:
    """As if a table had so many rows."""
    shape = (rows, *known.shapes[name][1:])
    return known._replace(shapes=known.shapes | {name: shape})


def test_every_array_of_the_bank_has_its_way() -> None:
    layout = Layout()
    layout.add(sizes())
    assert set(layout.specs()) == set(bank.Bank._fields)
    named = [*PADDED, *TABLES, *STARTS, COUNTED[0]]
    assert len(named) == len(set(named))
    each = set(bank.Bank._fields) - set(named)
    assert all(len(layout.specs()[name].shape) <= 2 for name in each)


@pytest.mark.parametrize(("largest", "bits"), [(32767, 16), (32768, 32)])
def test_a_table_is_as_wide_as_its_largest_value(largest: int, bits: int) -> None:
    layout, known = Layout(), sizes()
    layout.add(known)
    layout.add(known._replace(largest=known.largest | {NARROWED[0]: largest}))
    specs = layout.specs()
    assert specs[NARROWED[0]].dtype == np.dtype(f"int{bits}")
    assert specs[NARROWED[1]].dtype == np.int16
    values = np.array([largest, -1], np.int32)
    stored = placed(NARROWED[0], values, specs[NARROWED[0]], {})
    assert np.frombuffer(stored, specs[NARROWED[0]].dtype).tolist() == [largest, -1]


def test_more_rows_than_32_bits_count_are_refused() -> None:
    layout, known = Layout(), sizes()
    layout.add(with_rows(known, "list_edges", 2**31 - 2))
    layout.specs()
    layout.add(with_rows(known, "list_edges", 2))
    with pytest.raises(LayoutError, match=r"2147483648 rows of list_edges for 2 scen"):
        layout.specs()


def test_ten_thousand_recorded_scenes_can_be_counted() -> None:
    """With tables twice as long as those of the largest scene at hand."""
    known = sizes()
    for name, rows in (
        ("list_edges", 130_000),
        ("cell_row", 11_000),
        ("edges", 14_000),
    ):
        known = with_rows(known, name, rows)
    layout = Layout()
    for _ in range(10_000):
        layout.add(known)
    assert layout.specs()["list_edges"].shape == (1_300_000_000,)
