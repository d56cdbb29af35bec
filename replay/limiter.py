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

    def __post_init__(self) -> None:
        """Refuses settings that mean nothing."""
        if not (0 < self.samples_per_insert < float("inf") and self.min_size >= 1):
            raise LimiterError(
                f"samples_per_insert={self.samples_per_insert} must be finite and > 0 "
                f"and min_size={self.min_size} at least 1"
            )
        if not 0 <= self.tolerance < float("inf"):
            raise LimiterError(f"tolerance={self.tolerance} must be finite and >= 0")

    def _owed(self, inserts: int, samples: int) -> float:
        """Samples that the inserted rows still allow, 0 at the exact ratio."""
        return (inserts - self.min_size) * self.samples_per_insert - samples

    def may_insert(self, n: int, *, inserts: int, deletes: int, samples: int) -> bool:
        """Whether `n` more rows may be inserted at once."""
        if inserts + n - deletes <= self.min_size:
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
