"""The rate limiter: keeps samples and inserts in proportion.

With I rows inserted, D deleted (pushed out), S sampled, s samples per insert, minimum
size m and tolerance e (in samples):

    n samples are allowed when  I - D >= m  and  I s - S - n >= m s - e
    n inserts are allowed when  I + n - D <= m  or  (I + n) s - S <= m s + e

This is Reverb's definition (Cassirer et al. 2021, `SampleToInsertRatio`), for n items
at once. Pure: no clock, no lock; whoever owns the counters asks.

When both sides can wait for each other for ever, for batches of up to a inserts and b
samples. Write d = (I - m) s - S, the samples owed.

- Filled (I - D >= m, which then stays): inserts wait while d > e - a s, samples while
  d < b - e. No d does both if and only if b - e <= e - a s, that is  2 e >= b + a s.
- Filling (I < m, nothing sampled yet): samples wait; the batch that crosses m may
  bring at most e / s rows more than m. Batches of any size up to a are allowed for,
  so at worst a - 1 rows cross:  e >= (a - 1) s.

With `max_times_sampled` M > 0 a row is removed at its M-th draw, so the table can fall
below m again while samples are owed. Then, and while filling, inserts of any size are
allowed as long as I - D < m (Reverb's rule for one item at a time), or the batch that
crosses m could be held for ever. Three further conditions:

- S <= M I always, so the ratio can only be met if s <= M;
- m rows have at least m draws left, so samples of b <= m rows are always possible;
- what is let in below m, where nobody looks at the samples owed, must not push out rows
  with draws left: those would be owed for ever, and more with every batch (measured:
  0.25 samples per insert for 1). From m - 1 rows on there must be room for a batch, so
  the capacity is at least m + a - 1.

Then a FIFO table keeps the ratio. Samplers that draw at random leave some rows undrawn
for so long that the ring pushes them out: their draws are lost, and with s = M the
samples fall behind by as much (1% for prioritised rows, s = M = 8 and a capacity of
16 m); a larger M makes up for them.
"""

from dataclasses import dataclass
from typing import final

from replay.spec import ReplayError


class LimiterError(ReplayError):
    """Settings with which actors and learner would wait for each other for ever."""


@final
@dataclass(frozen=True, kw_only=True)
class RateLimiter:
    """The two rules of the module's docstring."""

    samples_per_insert: float
    min_size: int
    tolerance: float  # e, in samples
    max_times_sampled: int = 0  # M; 0 is no limit
    capacity: int | None = None  # rows; None: there is room for any number

    def __post_init__(self) -> None:
        """Refuses settings that mean nothing."""
        if not (0 < self.samples_per_insert < float("inf") and self.min_size >= 1):
            raise LimiterError(
                f"samples_per_insert={self.samples_per_insert} must be finite and > 0 "
                f"and min_size={self.min_size} at least 1"
            )
        if not 0 <= self.tolerance < float("inf"):
            raise LimiterError(f"tolerance={self.tolerance} must be finite and >= 0")
        most = self.max_times_sampled
        if not 0 <= most < 1 << 31:
            raise LimiterError(
                f"max_times_sampled={most} must be 0 (no limit) to {(1 << 31) - 1}"
            )
        if 0 < most < self.samples_per_insert:
            raise LimiterError(
                f"max_times_sampled={most} is below samples_per_insert="
                f"{self.samples_per_insert:g}: no row is sampled more often than "
                f"{most} times, so samples can never exceed inserts x {most} and the "
                "ratio is never reached; raise max_times_sampled or lower "
                "samples_per_insert"
            )

    def _owed(self, inserts: int, samples: int) -> float:
        """Samples that the inserted rows still allow, 0 at the exact ratio."""
        return (inserts - self.min_size) * self.samples_per_insert - samples

    def debt(self, *, inserts: int, samples: int) -> float:
        """Samples that the inserted rows still allow, 0 at the exact ratio."""
        return self._owed(inserts, samples)

    def may_insert(self, n: int, *, inserts: int, deletes: int, samples: int) -> bool:
        """Whether `n` more rows may be inserted at once."""
        if inserts + n - deletes <= self.min_size:
            return True
        if self.max_times_sampled and inserts - deletes < self.min_size:
            return True
        return self._owed(inserts + n, samples) <= self.tolerance

    def may_sample(self, n: int, *, inserts: int, deletes: int, samples: int) -> bool:
        """Whether `n` rows may be sampled at once."""
        if inserts - deletes < self.min_size:
            return False
        return self._owed(inserts, samples + n) >= -self.tolerance

    def check_batches(self, *, insert_rows: int, sample_rows: int) -> None:
        """Refuses batch sizes with which both sides could wait for ever."""
        per_insert = insert_rows * self.samples_per_insert
        both = (sample_rows + per_insert) / 2
        filling = (insert_rows - 1) * self.samples_per_insert
        if self.max_times_sampled:
            filling = 0.0
            self._check_removal(insert_rows=insert_rows, sample_rows=sample_rows)
        if self.tolerance >= max(both, filling):
            return
        if self.tolerance < both:
            why = (
                "once filled, an insert can wait for samples while a sample waits for "
                "inserts"
            )
        else:
            why = (
                "while filling, the insert that crosses min_size can be too large to "
                "be let in, and nothing can be sampled before it"
            )
        raise LimiterError(
            f"rate limiter would deadlock: inserts of {insert_rows} rows and samples "
            f"of {sample_rows} at samples_per_insert={self.samples_per_insert:g} need "
            f"a tolerance of {max(both, filling):g} samples, it is "
            f"{self.tolerance:g}: {why}; raise the tolerance or min_size, or use "
            "smaller batches"
        )

    def _check_removal(self, *, insert_rows: int, sample_rows: int) -> None:
        """The conditions on batches where rows are removed once drawn so often."""
        if sample_rows > self.min_size:
            raise LimiterError(
                f"rate limiter would deadlock: min_size={self.min_size} rows may have "
                f"one draw left each (max_times_sampled={self.max_times_sampled}), too "
                f"few for samples of {sample_rows}; raise min_size or use smaller "
                "batches"
            )
        needed = self.min_size + insert_rows - 1
        if self.capacity is not None and self.capacity < needed:
            raise LimiterError(
                f"the ratio would drift: with max_times_sampled="
                f"{self.max_times_sampled} inserts of {insert_rows} rows are let in "
                f"below min_size={self.min_size} and would push out rows that are owed "
                f"draws; capacity={self.capacity} must be at least {needed}"
            )
