"""Rows: fixed-size records described by a spec, and what a sample of them is.

A row is a packed little-endian struct. Its size is padded to a multiple of 64 bytes,
so that rows start on cache lines in the ring and in messages. The spec's hash (names,
dtypes, shapes, in order) travels with every message: two processes that disagree
about the layout find out at the first message and not by wrong numbers.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float, UInt64

ROW_ALIGNMENT = 64  # bytes
SCHEMA_HASH_BYTES = 8
MAX_ROW_BYTES = 1 << 20


class ReplayError(Exception):
    """Replay cannot go on; the message says what, where and what to do."""


class ReplayTimeout(ReplayError):
    """Nothing could be sampled in the time given; asking again is fine."""


@final
@dataclass(frozen=True)
class Field:
    """One column of a row."""

    name: str
    dtype: str  # a fixed-size numeric NumPy type, e.g. "f4"; stored little-endian
    shape: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Refuses what cannot travel as plain bytes."""
        dtype = np.dtype(self.dtype)
        if dtype.kind not in "biuf" or dtype.itemsize > 8:
            raise ReplayError(
                f"row field {self.name!r}: dtype {self.dtype!r} is not a number of at "
                "most 8 bytes; use one of i1..i8, u1..u8, f2..f8, ?"
            )
        if not self.name or any(size < 1 for size in self.shape):
            raise ReplayError(
                f"row field {self.name!r}: needs a name and a shape of sizes >= 1, "
                f"got {self.shape}"
            )


@final
@dataclass(frozen=True)
class RowSpec:
    """The layout of a row: fields in order, packed, padded to 64 bytes."""

    fields: tuple[Field, ...]

    def __post_init__(self) -> None:
        """Refuses empty, repeated and oversized layouts."""
        names = [field.name for field in self.fields]
        if not names or len(set(names)) != len(names):
            raise ReplayError(f"row fields {names}: need at least one, names unique")
        if self.row_bytes > MAX_ROW_BYTES:
            raise ReplayError(
                f"a row of {self.row_bytes} bytes exceeds {MAX_ROW_BYTES}; ship "
                "states, not observations"
            )

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """The structured dtype of a row."""
        offsets, offset = [], 0
        formats = []
        for field in self.fields:
            column = np.dtype((np.dtype(field.dtype).newbyteorder("<"), field.shape))
            formats.append(column)
            offsets.append(offset)
            offset += column.itemsize
        padded = -(-offset // ROW_ALIGNMENT) * ROW_ALIGNMENT
        names = [field.name for field in self.fields]
        # numpy's stubs do not know this form of the argument.
        layout = {
            "names": names,
            "formats": formats,
            "offsets": offsets,
            "itemsize": padded,
        }
        return np.dtype(layout)  # type: ignore[call-overload]

    @property
    def row_bytes(self) -> int:
        """Bytes of a row, padding included."""
        return int(self.dtype.itemsize)

    @cached_property
    def schema_hash(self) -> bytes:
        """Eight bytes that differ when names, dtypes, shapes or their order do."""
        text = ";".join(
            f"{field.name}:{np.dtype(field.dtype).newbyteorder('<').str}:{field.shape}"
            for field in self.fields
        )
        return hashlib.sha256(text.encode()).digest()[:SCHEMA_HASH_BYTES]

    def check(self, rows: np.ndarray) -> np.ndarray:
        """Returns `rows` as a contiguous vector of this layout, or raises."""
        if rows.dtype != self.dtype or rows.ndim != 1:
            raise ReplayError(
                f"rows are {rows.ndim}-dimensional {rows.dtype}; expected a vector of "
                f"{self.dtype} (make it with numpy.zeros(n, spec.dtype))"
            )
        return np.ascontiguousarray(rows)

    def as_bytes(self, rows: np.ndarray) -> np.ndarray:
        """The rows' bytes, [rows, row_bytes] uint8, without a copy if contiguous."""
        return self.check(rows).view(np.uint8).reshape(len(rows), self.row_bytes)


@final
@dataclass(frozen=True, kw_only=True)
class Sample:
    """Rows drawn from the replay, one or several batches one after the other."""

    ids: UInt64[np.ndarray, " batch"]  # global, in the order of insertion
    probabilities: Float[np.ndarray, " batch"]  # of drawing this row, float64
    rows: np.ndarray  # [batch], structured by the spec; may be read-only
    size: int  # rows in the table when they were drawn
    inserts: int  # rows ever inserted when they were drawn
    mass: float  # sum over the table of what rows are drawn in proportion to
