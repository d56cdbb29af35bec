"""Rows of n steps out of the scans' single ones.

    s_tm1   where a_tm1 was chosen          s_t   k steps later
    reward     sum over j < k of gamma^j r_{t+j}
    discount   gamma^(k-1), or 0 if and only if s_t is terminal

k is n, or fewer steps where the episode ends before (Sutton and Barto, 2018, eq. 7.1):
every transition becomes the first of one row, none crosses an episode's end, and one
that was only truncated bootstraps from its last state by the power of its own length.
The learner multiplies the discount by the last gamma (`learner.learner`).

On the host, since the number of rows that a step completes varies: for 128 transitions
0.08 ms of CPU with n = 1 and 0.22 with n = 3, beside a scan of 5.
"""

from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Int

from actors.acting import Transitions, own_first
from actors.rows import row_spec


@final
class Windows:
    """Takes scan by scan, gives the rows that are whole; keeps the others open."""

    def __init__(self, *, n_step: int, discount: float, actor: int) -> None:
        """`discount` is gamma; `actor` is written into the rows."""
        if n_step < 1:
            raise ValueError(f"n_step={n_step} must be at least 1")
        self._n_step = n_step
        self._discount = np.float32(discount)
        self._actor = actor
        self._serial = 0
        self._waiting: list[np.ndarray] = []  # rows that fill no batch yet
        self._kept: tuple[Transitions, np.ndarray, np.ndarray] | None = None

    def add(self, transitions: Transitions, version: int) -> np.ndarray:
        """The rows that a scan completes, by the steps at which they begin."""
        versions = np.full(len(transitions.scene), version)
        begins = np.asarray(transitions.present)
        if self._kept is not None:
            kept, kept_versions, still_open = self._kept
            transitions = jax.tree.map(
                lambda *parts: np.concatenate(parts), kept, transitions
            )
            versions = np.concatenate([kept_versions, versions])
            begins = np.concatenate([still_open, begins])
        span, reward, discount, whole = self._returns(transitions)
        at = np.nonzero(begins & whole)
        rows = self._gather(transitions, at, span[at])
        rows["reward"], rows["discount"] = reward[at], discount[at]
        rows["weights_version"] = versions[at[0]]
        rows["actor"] = self._actor
        rows["serial"] = self._serial + np.arange(len(rows))
        self._serial += len(rows)
        if self._n_step > 1:
            last = slice(-(self._n_step - 1), None)
            self._kept = (
                jax.tree.map(lambda values: values[last].copy(), transitions),
                versions[last],
                (begins & ~whole)[last],
            )
        return rows

    def batches(
        self, transitions: Transitions, version: int, size: int
    ) -> list[np.ndarray]:
        """The same cut into batches of `size`; what is left waits for the next scan.

        The replay's limiter is checked for batches of one size.
        """
        made = self.add(transitions, version)
        # Without the type it would be packed: rows are padded to 64 bytes.
        rows = np.concatenate([*self._waiting, made], dtype=made.dtype)
        whole = len(rows) - len(rows) % size
        self._waiting = [rows[whole:]]
        return [rows[first : first + size] for first in range(0, whole, size)]

    def _returns(
        self, transitions: Transitions
    ) -> tuple[
        Int[np.ndarray, "steps environments slots"],
        np.ndarray,
        np.ndarray,
        Bool[np.ndarray, "steps environments slots"],
    ]:
        """Span, return, discount of the windows that begin at each step; which end."""
        over = np.asarray(transitions.over)
        reward = np.array(transitions.reward)
        discount = np.array(transitions.discount)
        span, goes_on = np.ones(over.shape, np.int32), ~over
        gamma = self._discount
        for later in range(1, min(self._n_step, len(over))):
            here = slice(len(over) - later)
            more = goes_on[here]
            added = gamma**later * transitions.reward[later:]
            reward[here] += np.where(more, added, np.float32(0))
            discount[here] *= np.where(
                more, gamma * transitions.discount[later:], np.float32(1)
            )
            span[here] += more
            goes_on[here] &= ~over[later:]
        return span, reward, discount, ~goes_on | (span == self._n_step)

    def _gather(
        self,
        transitions: Transitions,
        at: tuple[np.ndarray, ...],
        span: Int[np.ndarray, " rows"],
    ) -> np.ndarray:
        """The rows without what was summed."""
        slots, one_step = transitions.states.shape[2:4]
        history = one_step - 1
        first, environment, slot = at
        spec = row_spec(history, n_step=self._n_step, others=slots - 1)
        rows = np.zeros(len(first), spec.dtype)
        rows["scene"] = transitions.scene[first, environment]
        rows["step"] = transitions.step[first + span - 1, environment]
        rows["controlled"] = transitions.controlled[at]
        rows["action"] = transitions.action[at]
        if self._n_step > 1:
            rows["span"] = span
        beside = own_first(slots)[slot, 1:]
        own = (first[:, None], environment[:, None], slot[:, None])
        for name in ("states", "valid"):
            values = np.asarray(getattr(transitions, name))
            rows[name] = self._spanning(values, own, span)[:, 0]
            if slots > 1:
                others = (*own[:2], beside)
                rows[f"others_{name}"] = self._spanning(values, others, span)
        if slots > 1:
            rows["others"] = transitions.controlled[*own[:2], beside]
        return rows

    def _spanning(
        self,
        values: np.ndarray,
        cells: tuple[np.ndarray, ...],
        span: Int[np.ndarray, " rows"],
    ) -> np.ndarray:
        """The first step's states, then each later step's last; 0 beyond the span."""
        step, environment, slot = cells  # they broadcast to [rows, objects]
        parts = [values[cells]]
        for later in range(1, self._n_step):
            at = np.minimum(step + later, len(values) - 1)
            last = values[at, environment, slot, -1]
            last[span <= later] = 0
            parts.append(last[:, :, None])
        return np.concatenate(parts, 2)
