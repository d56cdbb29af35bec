"""How the converted scenes make up the arrays of a bank.

Four ways, by the array's name:

    each      one value or row a scene
    padded    one block a scene, filled up to the largest of the bank
    table     rows of any number a scene, one scene behind the other
    start     the number of the first row that a scene has in a table

`Layout` is told of one scene after the other, keeps only sums and maxima, and then
knows type and shape of every array, so that a bank of any size is written scene by
scene. Where a table's integers all fit, it is stored in 16 bits instead of 32.

JAX counts in 32 bits: no table may have 2^31 rows. At 10,000 recorded scenes the
longest, `list_edges`, has about 10^9.
"""

from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np

from sim import routes

PADDED = {
    "tracks": 0.0,  # see `BEHIND`
    "log": 0.0,
    "log_valid": 0.0,
    "object_type": 0.0,
    "route": 0.0,
    **dict.fromkeys(routes.PER_OBJECT, 0.0),
    **dict.fromkeys(routes.PER_CHUNK, 0.0),
    "route_spacing": 1.0,
    "stop_position": 0.0,
    "light_position": 0.0,
    "light_through": 0.0,
    "light_state": 0.0,
}
BEHIND = {"tracks": ("object_type", 0)}
"""Arrays filled up with the length that an axis of another one has in the bank: the
row behind the last, which stands for no row."""
TABLES = (
    "cell_row",
    "rows",
    "row_count",
    "segments",
    "segment_kind",
    "segment_rows",
    "chunks",
    "cell_edges",
    "fine_state",
    "list_first",
    "list_count",
    "list_edges",
    "edges",
)
STARTS = {
    "cell_start": "cell_row",
    "segment_start": "segments",
    "chunk_start": "chunks",
    "fine_start": "fine_state",
    "list_start": "list_first",
    "edge_start": "edges",
}
SHIFTED = {"cell_row": "rows", "list_first": "list_edges"}
"""Tables whose values, where not negative, are row numbers of another one: the bank's
and not the scene's. (What is the scene's own stays small, and is narrowed.)"""
NARROWED = ("cell_edges", "fine_state", "list_edges")
COUNTED = ("candidates", "list_count")
"""An array 0, 1, ... as long as the largest value of another one."""

_MOST_ROWS = 2**31 - 1

Shapes = dict[str, tuple[int, ...]]


class LayoutError(Exception):
    """The scenes do not fit into one bank; the message says what does not."""


class Sizes(NamedTuple):
    """What a layout has to know of a converted scene."""

    shapes: Shapes
    dtypes: dict[str, np.dtype]
    largest: dict[str, int]  # the largest value of some arrays


def sizes_of(converted: Mapping[str, np.ndarray]) -> Sizes:
    """The sizes of one scene's arrays."""
    return Sizes(
        shapes={name: array.shape for name, array in converted.items()},
        dtypes={name: array.dtype for name, array in converted.items()},
        largest={
            name: int(converted[name].max(initial=0))
            for name in (*NARROWED, COUNTED[1])
        },
    )


class Spec(NamedTuple):
    """Type and shape of an array of the bank, and what it is padded with."""

    dtype: np.dtype
    shape: tuple[int, ...]
    fill: float = 0.0


@final
class Layout:
    """Types and shapes of the arrays of a bank whose scenes are told of by `add`."""

    def __init__(self) -> None:
        """No scene yet."""
        self._dtypes: dict[str, np.dtype] = {}
        self._scenes = 0
        self._widest: Shapes = {}
        self._rows = dict.fromkeys(TABLES, 0)
        self._largest: dict[str, int] = {}

    def add(self, sizes: Sizes) -> None:
        """One more scene, with arrays of these sizes."""
        self._scenes += 1
        self._dtypes |= sizes.dtypes  # the same for all scenes
        for name, shape in sizes.shapes.items():
            ours = shape[1:] if name in TABLES else shape
            known = self._widest.get(name, ours)
            self._widest[name] = tuple(
                max(pair) for pair in zip(known, ours, strict=True)
            )
            if name in self._rows:
                self._rows[name] += shape[0]
        for name, value in sizes.largest.items():
            self._largest[name] = max(value, self._largest.get(name, 0))

    def specs(self) -> dict[str, Spec]:
        """Every array of the bank; LayoutError if 32 bits cannot count its rows."""
        specs = {}
        for name, widest in self._widest.items():
            first = self._rows[name] if name in TABLES else self._scenes
            if first > _MOST_ROWS:
                raise LayoutError(
                    f"{first} rows of {name} for {self._scenes} scenes, at most "
                    f"{_MOST_ROWS}; write several banks"
                )
            # A gather needs a row to read even where no scene has any.
            shape = widest if name in TABLES else tuple(max(1, n) for n in widest)
            specs[name] = Spec(
                self._dtype(name), (max(1, first), *shape), self._fill(name)
            )
        for name in STARTS:
            specs[name] = Spec(np.dtype(np.int32), (self._scenes,))
        counted, by = COUNTED
        longest = max(1, self._largest.get(by, 0))
        specs[counted] = Spec(np.dtype(np.int32), (longest,))
        return specs

    def _fill(self, name: str) -> float:
        """What an array is padded with."""
        if name in BEHIND:
            of, axis = BEHIND[name]
            return self._widest[of][axis]
        return PADDED.get(name, 0.0)

    def _dtype(self, name: str) -> np.dtype:
        """The type that a table is stored in."""
        fits = self._largest.get(name, 0) <= np.iinfo(np.int16).max
        return np.dtype(np.int16) if name in NARROWED and fits else self._dtypes[name]


def placed(name: str, array: np.ndarray, spec: Spec, rows: Mapping[str, int]) -> bytes:
    """The bytes that a scene adds to an array of the bank.

    `rows` says how many rows of each table the scenes before it have.
    """
    if name in SHIFTED:
        array = np.where(array >= 0, array + rows[SHIFTED[name]], array)
    if name not in TABLES and array.shape != spec.shape[1:]:
        pads = [
            (0, want - have)
            for want, have in zip(spec.shape[1:], array.shape, strict=True)
        ]
        array = np.pad(array, pads, constant_values=spec.fill)
    return np.ascontiguousarray(array, spec.dtype).tobytes()
