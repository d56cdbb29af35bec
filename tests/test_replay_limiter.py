"""The limiter against its definition, and against deadlock."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from replay.limiter import LimiterError, RateLimiter
from replay.local import LocalReplay, ReplayConfig
from replay.selectors import SamplerName
from replay.spec import ReplayError
from tests.replay_parts import SPEC, make_rows

counts = st.integers(0, 400)


def allowed_slowly(limiter: RateLimiter, n: int, i: int, d: int, s: int) -> list[bool]:
    """Oracle: the two rules as the design states them (inserts, samples)."""
    spi, m, e = limiter.samples_per_insert, limiter.min_size, limiter.tolerance
    insert = i + n - d <= m or (i + n) * spi - s <= m * spi + e
    sample = i - d >= m and i * spi - s - n >= m * spi - e
    return [insert, sample]


@given(
    spi=st.sampled_from([0.25, 0.5, 1.0, 2.0, 8.0]),
    m=st.integers(1, 100),
    e=st.integers(0, 300),
    n=st.integers(1, 64),
    inserts=counts,
    deletes=counts,
    samples=counts,
)
def test_limiter_agrees_with_the_definition(
    spi: float, m: int, e: int, n: int, inserts: int, deletes: int, samples: int
) -> None:
    limiter = RateLimiter(samples_per_insert=spi, min_size=m, tolerance=e)
    now = {"inserts": inserts, "deletes": min(deletes, inserts), "samples": samples}
    got = [limiter.may_insert(n, **now), limiter.may_sample(n, **now)]
    assert got == allowed_slowly(limiter, n, inserts, min(deletes, inserts), samples)


@given(
    spi=st.sampled_from([0.25, 0.5, 1.0, 3.0, 8.0]),
    m=st.integers(1, 60),
    e=st.floats(0, 300),
    insert_rows=st.integers(1, 24),
    sample_rows=st.integers(1, 48),
    spare=st.integers(0, 40),
    data=st.data(),
)
def test_accepted_settings_never_block_both_sides(
    spi: float,
    m: int,
    e: float,
    insert_rows: int,
    sample_rows: int,
    spare: int,
    data: st.DataObject,
) -> None:
    """Any order of batches of any size up to the declared ones goes on for ever."""
    limiter = RateLimiter(samples_per_insert=spi, min_size=m, tolerance=e)
    try:
        limiter.check_batches(insert_rows=insert_rows, sample_rows=sample_rows)
    except LimiterError:
        return
    capacity = max(m, insert_rows) + spare
    inserts = samples = 0
    for _ in range(60):
        now = {
            "inserts": inserts,
            "deletes": max(0, inserts - capacity),
            "samples": samples,
        }
        a = data.draw(st.integers(1, insert_rows))
        b = data.draw(st.integers(1, sample_rows))
        may_insert, may_sample = (
            limiter.may_insert(a, **now),
            limiter.may_sample(b, **now),
        )
        assert may_insert or may_sample, (now, a, b)
        if may_insert and (not may_sample or data.draw(st.booleans())):
            inserts += a
        else:
            samples += b


@pytest.mark.parametrize(
    ("m", "e", "insert_rows", "sample_rows", "why"),
    [(100, 7.0, 4, 8, "once filled"), (7, 16.0, 10, 1, "while filling")],
)
def test_refused_settings_do_deadlock(
    m: int, e: float, insert_rows: int, sample_rows: int, why: str
) -> None:
    """The refusal is right: some order of batches leaves both sides waiting."""
    limiter = RateLimiter(samples_per_insert=2.0, min_size=m, tolerance=e)
    with pytest.raises(LimiterError, match=f"would deadlock.*{why}"):
        limiter.check_batches(insert_rows=insert_rows, sample_rows=sample_rows)
    stuck = [
        (inserts, samples)
        for inserts in range(2 * m + 20)
        for samples in range(0, 4 * m + 40)
        if (inserts >= m or samples == 0)
        and not limiter.may_insert(
            insert_rows, inserts=inserts, deletes=0, samples=samples
        )
        and not limiter.may_sample(
            sample_rows, inserts=inserts, deletes=0, samples=samples
        )
    ]
    assert stuck


def test_the_papers_settings_are_accepted() -> None:
    limiter = ReplayConfig().limiter()
    assert limiter.tolerance == pytest.approx(800.0)
    limiter.check_batches(insert_rows=64, sample_rows=64)


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"samples_per_insert": 0.0}, "must be finite and > 0"),
        ({"samples_per_insert": float("inf")}, "must be finite and > 0"),
        ({"min_size": 0}, "at least 1"),
        ({"tolerance": -0.1}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"capacity": 999}, "wait for ever"),
    ],
)
def test_meaningless_settings_are_refused(settings: dict[str, float], why: str) -> None:
    with pytest.raises(ReplayError, match=why):
        ReplayConfig(**settings)


def can_stick(limiter: RateLimiter, a: int, b: int, capacity: int) -> bool:
    """Whether some order of batches of up to a and b rows leaves a and b waiting."""
    # Once filled only the samples owed matter: further on nothing new is reached.
    most = limiter.min_size + 4 * (a + b) + 8
    most += int(4 * limiter.tolerance / limiter.samples_per_insert)
    todo, seen = [(0, 0)], set()
    while todo:
        inserts, samples = todo.pop()
        if (inserts, samples) in seen or inserts > most:
            continue
        seen.add((inserts, samples))
        now = {
            "inserts": inserts,
            "deletes": max(0, inserts - capacity),
            "samples": samples,
        }
        more = [n for n in range(1, a + 1) if limiter.may_insert(n, **now)]
        drawn = [n for n in range(1, b + 1) if limiter.may_sample(n, **now)]
        if a not in more and b not in drawn:
            return True
        todo += [(inserts + n, samples) for n in more]
        todo += [(inserts, samples + n) for n in drawn]
    return False


@settings(max_examples=25, deadline=None)
@given(
    spi=st.sampled_from([0.5, 1.0, 2.0, 3.0]),
    m=st.integers(1, 8),
    a=st.integers(1, 4),
    b=st.integers(1, 6),
    spare=st.integers(0, 4),
)
def test_the_border_is_where_deadlock_begins(
    spi: float, m: int, a: int, b: int, spare: int
) -> None:
    """Every order: none sticks at the border, some does 5/8 of a sample below it.

    Not always right below: samples are whole, so the check can be too careful, by half
    a sample.
    """
    border = max((b + a * spi) / 2, (a - 1) * spi)
    capacity = max(m, a) + spare
    accepted = RateLimiter(samples_per_insert=spi, min_size=m, tolerance=border)
    accepted.check_batches(insert_rows=a, sample_rows=b)
    assert not can_stick(accepted, a, b, capacity)
    below = max(0.0, border - 0.625)
    refused = RateLimiter(samples_per_insert=spi, min_size=m, tolerance=below)
    with pytest.raises(LimiterError, match="would deadlock"):
        refused.check_batches(insert_rows=a, sample_rows=b)
    assert can_stick(refused, a, b, capacity)


def removing(
    spi: float,
    m: int,
    a: int,
    b: int,
    *,
    sampler: SamplerName,
    most: int,
    capacity: int,
    tolerance: float,
) -> LocalReplay:
    """A real table whose rows are removed once drawn so often; raises if refused."""
    config = ReplayConfig(
        capacity=capacity,
        min_size=m,
        samples_per_insert=spi,
        tolerance=tolerance / (spi * m),
        sampler=sampler,
        max_times_sampled=most,
    )
    config.limiter().check_batches(insert_rows=a, sample_rows=b)
    return LocalReplay(spec=SPEC, config=config, seed=0)


def work(replay: LocalReplay, a: int, b: int, *, steps: int, seed: int) -> float:
    """Steps in a random order; the samples owed at the end in tolerances."""
    random = np.random.default_rng(seed)
    eager = random.random()  # how much the writers are ahead
    for _ in range(steps):
        inserted, drawn = random.integers(1, [a, b], endpoint=True).tolist()
        if replay.may_insert(a) and random.random() < eager:
            replay.insert(make_rows(replay.inserts, a))
        elif replay.may_insert(inserted) and random.random() < eager:
            replay.insert(make_rows(replay.inserts, inserted))
        elif replay.may_sample(drawn):
            ids = replay.sample(drawn).ids
            # Also of no priority at all: what is left of the others is used up first.
            replay.update_priorities(ids, random.integers(0, 3, drawn) * 0.5)
        assert replay.may_insert(a) or replay.may_sample(b)
    replay.table.check_invariants()
    debt = replay.limiter.debt(inserts=replay.inserts, samples=replay.samples)
    return debt / replay.limiter.tolerance


@settings(max_examples=15, deadline=None)
@given(
    spi=st.sampled_from([0.3, 0.5, 1.0, 2.0, 2.5]),
    m=st.integers(1, 12),
    a=st.integers(1, 8),
    b=st.integers(1, 8),
    spare=st.integers(0, 3),
    sampler=st.sampled_from(["prioritized", "uniform", "fifo"]),
    seed=st.integers(0, 1 << 30),
)
def test_removal_at_every_border_at_once_blocks_nobody(
    spi: float, m: int, a: int, b: int, spare: int, sampler: SamplerName, seed: int
) -> None:
    """M, tolerance, capacity and m as small as accepted; one less of each is refused.

    And a FIFO table, which loses no draws, does not fall behind.
    """
    m = max(m, b)
    border = {
        "sampler": sampler,
        "most": math.ceil(spi),
        "capacity": m + a - 1,
        "tolerance": (b + a * spi) / 2 + 1e-9,
    }
    wider = {**border, "capacity": m + a - 1 + spare}
    debt = work(removing(spi, m, a, b, **wider), a, b, steps=60, seed=seed)
    if sampler == "fifo":
        # One batch below m beside the tolerance, and rows of which some draws are left.
        assert debt <= 1 + (a * spi + (a + b) * border["most"]) / border["tolerance"]
    with pytest.raises(ReplayError, match=r"would drift|wait for ever"):
        removing(spi, m, a, b, **{**border, "capacity": m + a - 2})
    narrow = 0.99 * border["tolerance"]
    with pytest.raises(LimiterError, match="would deadlock"):
        removing(spi, m, a, b, **{**border, "tolerance": narrow})
    with pytest.raises(LimiterError, match="one draw left each"):
        removing(spi, m, a, m + 1, **{**border, "tolerance": 1e3})
    if border["most"] > 1:
        with pytest.raises(LimiterError, match="samples can never exceed"):
            removing(spi, m, a, b, **{**border, "most": border["most"] - 1})


@pytest.mark.parametrize("sampler", ["uniform", "fifo"])
@pytest.mark.parametrize(("capacity", "drifts"), [(10, True), (16, False)])
def test_refused_capacities_do_drift(
    sampler: SamplerName, capacity: int, drifts: bool
) -> None:
    """The refusal is right: the samples fall behind without end, else they do not."""
    a, b, most = 4, 1, 2
    config = ReplayConfig(
        capacity=capacity,
        min_size=10,
        samples_per_insert=1.0,
        tolerance=0.3,
        sampler=sampler,
        max_times_sampled=most,
    )
    replay = LocalReplay(spec=SPEC, config=config, seed=0)
    for _ in range(600):
        if replay.may_insert(a):
            replay.insert(make_rows(replay.inserts, a))
        else:
            replay.sample(b)
    debt = replay.limiter.debt(inserts=replay.inserts, samples=replay.samples)
    assert (debt > 50 * replay.limiter.tolerance) == drifts
    if drifts:
        with pytest.raises(LimiterError, match=r"would drift.*at least 13"):
            config.limiter().check_batches(insert_rows=a, sample_rows=b)
    else:
        assert abs(debt) <= replay.limiter.tolerance
