"""Sampling is right: 10^6 draws over live updates against the exact probabilities.

Between draws rows are inserted, evicted and given new priorities. A mirror keeps what
is in the table by id, and for every draw adds what the definition expects of each id,
and the variance of that. Draws of one batch are stratified, so a row's count varies
less than a multinomial one: row i of mass m_i covers B m_i / M strata, those it covers
whole draw it for certain, the (at most two) that it shares with probability q. So

    E = B m_i / M        Var = sum over its strata of q (1 - q)

and z^2 = (count - E)^2 / Var has mean 1 for every id, whatever its strata. For batches
of one this is the chi-square of independent draws. The mean of z^2 over the ids is
tested from both sides: far above 1 is a bias, far below 1 is a variance that is not
the sampler's.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pytest
import torch

from learner.targets import importance_weights
from replay.client import Sampler, Writer, fetch_stats
from replay.local import LocalReplay, ReplayConfig
from replay.spec import Sample
from tests.replay_parts import KEYS, SPEC, make_rows, service, session_to

DRAWS = 1_000_000
CAPACITY = 500
EXPONENT = 0.6
DEVIATIONS = 5.0  # of the mean of z^2: p < 1e-6 from either side
Name = Literal["prioritized", "uniform"]


def open_config(sampler: Name, exponent: float = EXPONENT) -> ReplayConfig:
    """A limiter that never stands in the way."""
    return ReplayConfig(
        capacity=CAPACITY,
        min_size=100,
        samples_per_insert=512.0,
        tolerance=1e4,
        priority_exponent=exponent,
        sampler=sampler,
    )


@dataclass
class Mirror:
    """The table by its definition, and what has been drawn of it."""

    exponent: float
    most: int  # ids there can be
    priorities: np.ndarray = field(init=False)
    counts: np.ndarray = field(init=False)
    expected: np.ndarray = field(init=False)
    variance: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        """Nothing has been drawn."""
        self.priorities = np.ones(self.most)
        self.counts, self.expected, self.variance = np.zeros((3, self.most))

    def masses(self, inserts: int) -> tuple[np.ndarray, np.ndarray]:
        """Ids in the table in the order of their slots, and p^alpha."""
        ids = np.arange(max(0, inserts - CAPACITY), inserts)
        ids = ids[np.argsort(ids % CAPACITY)]
        return ids, self.priorities[ids] ** self.exponent

    def add(self, ids: np.ndarray, inserts: int, batch_size: int) -> None:
        """Counts a reply of whole batches."""
        rows, masses = self.masses(inserts)
        batches = len(ids) // batch_size
        edges = np.concatenate([[0.0], np.cumsum(masses)]) * batch_size / masses.sum()
        begin, last = edges[:-1], edges[1:]
        head = np.minimum(last, np.floor(begin) + 1) - begin
        tail = np.where(np.floor(last) > np.floor(begin), last - np.floor(last), 0.0)
        self.counts += np.bincount(ids.astype(int), minlength=self.most)
        self.expected[rows] += batches * (last - begin)
        self.variance[rows] += batches * (head * (1 - head) + tail * (1 - tail))

    def deviations(self) -> float:
        """By how many standard deviations the mean of z^2 is off 1."""
        assert self.counts.sum() == pytest.approx(self.expected.sum())
        there = self.variance > 20.0  # near enough to a normal distribution
        assert there.sum() > 300
        squares = (self.counts - self.expected)[there] ** 2 / self.variance[there]
        return float((squares.mean() - 1.0) / np.sqrt(2.0 / there.sum()))


def drive(
    replay: LocalReplay,
    mirror: Mirror,
    *,
    batch_size: int,
    keep: Callable[[np.ndarray], np.ndarray] = lambda ids: ids,
) -> None:
    """Draws a million; `keep` may spoil what was drawn, for a test of the test."""
    random = np.random.default_rng(7)
    replay.insert(make_rows(0, 300))
    for _ in range(DRAWS // 1024):
        buffer = replay.sample_into_buffer(
            batch_size=batch_size, batches=1024 // batch_size
        )
        ids = buffer.ids.astype(np.int64)
        mirror.add(keep(ids), replay.inserts, batch_size)
        changed = np.unique(ids[:200])
        new = random.gamma(1.0, size=len(changed)) * random.choice([0.1, 1.0, 10.0])
        replay.update_priorities(changed, new)
        mirror.priorities[changed] = new
        replay.insert(make_rows(replay.inserts, int(random.integers(1, 4))))
    assert replay.inserts > 3 * CAPACITY  # most rows have been pushed out


@pytest.mark.parametrize(
    ("sampler", "batch_size"),
    [
        ("prioritized", 64),
        pytest.param("prioritized", 1, marks=pytest.mark.slow),
        pytest.param("uniform", 1, marks=pytest.mark.slow),
        pytest.param("uniform", 64, marks=pytest.mark.slow),
    ],
)
def test_a_million_draws_over_live_updates_are_in_proportion(
    sampler: Name, batch_size: int
) -> None:
    replay = LocalReplay(spec=SPEC, config=open_config(sampler), seed=3)
    mirror = Mirror(EXPONENT if sampler == "prioritized" else 0.0, 4000)
    drive(replay, mirror, batch_size=batch_size)
    assert abs(mirror.deviations()) < DEVIATIONS
    replay.table.check_invariants()


@pytest.mark.slow
def test_a_slightly_wrong_exponent_is_found() -> None:
    """The test can fail: 0.6 is told from 0.7."""
    replay = LocalReplay(spec=SPEC, config=open_config("prioritized"), seed=3)
    mirror = Mirror(EXPONENT + 0.1, 4000)
    drive(replay, mirror, batch_size=64)
    assert mirror.deviations() > 2 * DEVIATIONS


@pytest.mark.slow
def test_a_sampler_that_prefers_some_rows_is_found() -> None:
    """One draw in twenty of an odd id is given to the even id below it."""
    replay = LocalReplay(spec=SPEC, config=open_config("uniform"), seed=3)
    mirror, random = Mirror(0.0, 4000), np.random.default_rng(1)

    def keep(ids: np.ndarray) -> np.ndarray:
        return ids - (ids % 2) * (random.random(len(ids)) < 0.05)

    drive(replay, mirror, batch_size=1, keep=keep)
    assert mirror.deviations() > 2 * DEVIATIONS


def check_against_definition(mirror: Mirror, sample: Sample, beta: float) -> None:
    """Probabilities, importance weights and the learner's formula, in float64."""
    rows, masses = mirror.masses(sample.inserts)
    place = np.empty(mirror.most, int)
    place[rows] = np.arange(len(rows))
    exact = masses[place[sample.ids.astype(int)]] / masses.sum()
    np.testing.assert_allclose(sample.probabilities, exact, rtol=1e-6)
    np.testing.assert_allclose(sample.mass, masses.sum(), rtol=1e-6)
    # Schaul et al. 2016, sec. 3.4: (1 / N P)^beta over the batch's largest.
    weights = (1.0 / (sample.size * exact)) ** beta
    weights /= weights.max()
    told = torch.from_numpy(sample.probabilities.copy())
    ours = importance_weights(told.float(), beta).double().numpy()
    np.testing.assert_allclose(ours, weights, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["prioritized", "uniform"])
def test_a_million_draws_through_the_wire(sampler: Name) -> None:
    """A service, a writer and a sampler that reads ahead, each by a session.

    Queries in flight carry updates that the mirror has and the service has not: the
    reply's mass says after how many of them it was drawn.
    """
    prioritized = sampler == "prioritized"
    mirror = Mirror(EXPONENT if prioritized else 0.0, 4000)
    random = np.random.default_rng(5)
    with (
        service(open_config(sampler), seed=4) as running,
        session_to(running.endpoint) as other,
    ):
        writer = Writer(
            session=running.client,
            keys=KEYS,
            spec=SPEC,
            writer=0,
            epoch=1,
            batch_rows=2,
        )
        writer.append(make_rows(0, 300))
        assert writer.flush(20.0)
        drawn = Sampler(
            session=other, keys=KEYS, spec=SPEC, batch_size=64, batches_per_reply=8
        )
        pending: list[tuple[np.ndarray, np.ndarray]] = []
        start = 300
        for turn in range(DRAWS // 64):
            sample = drawn.sample(20.0)
            while prioritized and pending:
                mass = mirror.masses(sample.inserts)[1].sum()
                if abs(mass - sample.mass) < 1e-9 * mass:
                    break
                ids, new = pending.pop(0)
                mirror.priorities[ids] = new
            mirror.add(sample.ids, sample.inserts, 64)
            if turn % 16 == 0:
                check_against_definition(mirror, sample, beta=random.uniform(0.2, 1.0))
                np.testing.assert_array_equal(
                    sample.rows["number"], sample.ids.astype(np.int64)
                )
                ids = np.unique(sample.ids).astype(np.int64)
                new = random.gamma(1.0, size=len(ids)) + 0.01
                drawn.update_priorities(ids, new)
                pending.append((ids, new))
                writer.append(make_rows(start, 2))
                start += 2
        assert writer.close(20.0)
        stats = fetch_stats(running.client, KEYS)
    assert abs(mirror.deviations()) < DEVIATIONS
    assert stats["inserts"] > 4 * CAPACITY
