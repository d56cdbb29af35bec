"""A sum tree in blocks: draws in proportion to mass, without a compiled extension.

Leaves are float32 (the masses of the slots), and every node above is the float64 sum of
a block of 16 below it, added up anew whenever one of them changes: nothing drifts. The
tree is as high as leaves at most 256 nodes on top. 4.6 bytes per slot in all, for any
capacity.

`find` gives the definition's answer: the first slot at which the running sum of the
masses reaches the target. Downwards, a whole batch takes one level at a time: gather
each target's block, multiply it by a triangular matrix of ones (the sums of what
stands before each child), and go to the last child whose sum is below the target. The
product may add in any order, so a target within rounding of a boundary may end at a
leaf without mass; such a one goes down again by itself, with sums that are monotone.

Blocks of 8 and 32 were measured and were no better than 16 up to 10^6 slots; the sums
within blocks are the work, so larger ones were not tried out as a whole.

Bad slots and masses are for the caller to refuse.
"""

from typing import Final, final

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

_BITS: Final = 4
_FAN: Final = 1 << _BITS
_TOP: Final = 256
_ROWS: Final = 1024  # in one product: a larger one would start BLAS's threads
_SMALLEST: Final = np.float32(np.finfo(np.float32).tiny)


def as_float32(values: Float[np.ndarray, " rows"]) -> Float32[np.ndarray, " rows"]:
    """Nearest float32; what is positive stays so, however small."""
    nearest = values.astype(np.float32)
    small = nearest < _SMALLEST
    if small.any():
        nearest[small & (values > 0.0)] = _SMALLEST
    return nearest


@final
class SumTree:
    """Masses by slot. Not thread-safe."""

    def __init__(self, capacity: int) -> None:
        """Starts with no mass."""
        self._capacity = capacity
        self._levels: list[np.ndarray] = []
        nodes, height = capacity, 0
        while nodes > _TOP:
            nodes, height = -(-nodes // _FAN), height + 1
        # Whole blocks everywhere: rounding may lead beyond the last slot, never beyond
        # the arrays.
        for level in range(height, 0, -1):
            kind = np.float32 if level == height else np.float64
            self._levels.append(np.zeros((nodes * _FAN ** (level - 1), _FAN), kind))
        self._top = np.zeros(nodes, np.float64 if height else np.float32)
        bottom = self._levels[0].reshape(-1) if self._levels else self._top
        self._leaves: Float32[np.ndarray, " slots"] = bottom
        self._sums = np.zeros(nodes + 1)  # what stands before each node of the top
        self._above = [level.reshape(-1) for level in self._levels[1:]]
        self._above += [self._top] if self._levels else []
        self._ones = np.ones(_FAN)
        # Column k: what stands before child FAN - 1 - k, so that the first sum below
        # the target is that of the last child.
        self._before = np.triu(np.ones((_FAN, _FAN)), 1)[:, ::-1].copy()
        self._places = np.arange(_ROWS) * _FAN

    @property
    def total(self) -> float:
        """The sum of all masses."""
        return float(self._sums[-1])

    @property
    def memory_bytes(self) -> int:
        """What the tree takes."""
        return sum(level.nbytes for level in (*self._levels, self._top, self._sums))

    def at(self, slots: Int64[np.ndarray, " rows"]) -> Float64[np.ndarray, " rows"]:
        """The masses of these slots."""
        return self._leaves[slots].astype(np.float64)

    def update(
        self,
        slots: Int64[np.ndarray, " rows"],
        masses: Float32[np.ndarray, " rows"],
    ) -> None:
        """Gives slots masses; of a slot that is there twice the last holds."""
        self._leaves[slots] = masses
        nodes = slots
        for level, above in zip(self._levels, self._above, strict=True):
            nodes = nodes >> _BITS
            same = nodes[1:] == nodes[:-1]
            if 2 * np.count_nonzero(same) > len(nodes):  # neighbours, as in an insert
                nodes = np.concatenate([nodes[:1], nodes[1:][~same]])
            above[nodes] = self._add_up(level.take(nodes, axis=0))
        np.cumsum(self._top, dtype=np.float64, out=self._sums[1:])

    def _add_up(self, blocks: np.ndarray) -> Float64[np.ndarray, " blocks"]:
        if len(blocks) > _ROWS:
            return np.add.reduce(blocks, axis=1, dtype=np.float64)
        return blocks @ self._ones

    def find(self, targets: Float[np.ndarray, " rows"]) -> Int64[np.ndarray, " rows"]:
        """For targets in (0, total]: the first slot whose running sum reaches it."""
        if len(targets) <= _ROWS:
            return self._find(targets)
        parts = range(0, len(targets), _ROWS)
        return np.concatenate([self._find(targets[p : p + _ROWS]) for p in parts])

    def _find(self, targets: Float[np.ndarray, " rows"]) -> Int64[np.ndarray, " rows"]:
        targets = np.minimum(targets, self._sums[-1])
        nodes = self._sums[1:].searchsorted(targets)
        # Positive, here and below: a node is entered only where its start is less.
        rest = targets - self._sums[nodes]
        places = self._places[: len(targets)]
        for level in reversed(self._levels):
            sums = level.take(nodes, axis=0) @ self._before
            back = (sums < rest[:, None]).argmax(axis=1)
            rest -= sums.take(places + back)
            nodes = (nodes << _BITS) + (_FAN - 1) - back
        lost = self._leaves.take(nodes) <= 0.0
        if lost.any():
            nodes[lost] = [self._find_one(target) for target in targets[lost]]
        return nodes

    def _find_one(self, target: float) -> int:
        """The same without rounding's exceptions: every step is into some mass."""
        node, nodes = 0, self._top
        for level in (*reversed(self._levels), None):
            sums = np.cumsum(nodes, dtype=np.float64)
            child = int(sums.searchsorted(min(target, sums[-1])))
            target = min(target, sums[-1]) - (sums[child - 1] if child else 0.0)
            node = node * _FAN + child
            if level is not None:
                nodes = level[node]
        return node

    def check_invariants(self) -> None:
        """Asserts what must hold after every operation; for tests."""
        for level, above in zip(self._levels, self._above, strict=True):
            assert (level >= 0.0).all() and np.isfinite(level).all()
            sums = np.cumsum(level, axis=1, dtype=np.float64)[:, -1]
            np.testing.assert_allclose(above, sums, rtol=1e-14)
        assert (self._leaves[self._capacity :] == 0.0).all()
        top = self._top.sum(dtype=np.float64)
        np.testing.assert_allclose(self.total, top, rtol=1e-14)
