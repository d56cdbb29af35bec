"""The ratio of samples to inserts over every 10,000 consecutive inserts, really served.

With S samples per insert and a tolerance of e samples, |(I - m) S - S_drawn| <= e at
every moment once filled, so over a window of W rows the samples are off by at most 2 e
of S W. The settings put that at half a percent: 1% must hold, and a limiter four times
as loose need not hold it (the last test shows that it is found).
"""

import contextlib
import threading
from dataclasses import replace

import numpy as np
import pytest

from replay.client import Sampler, Writer
from replay.local import ReplayConfig
from tests.replay_parts import KEYS, SPEC, make_rows, service, session_to

WINDOW = 10_000
BATCH = 8
DRAWN = 64
S = 4.0
MIN_SIZE = 1_000
# e = 100 samples: 2 e is 0.5% of S x WINDOW = 40,000, and 2 e >= 64 + 8 S.
CONFIG = ReplayConfig(
    capacity=1 << 15,
    min_size=MIN_SIZE,
    samples_per_insert=S,
    tolerance=100 / (S * MIN_SIZE),
)


def worst(marks: np.ndarray) -> float:
    """The worst relative error of the ratio over windows of the marks.

    Marks are (inserts, samples) in the order in which they were so; each window goes
    from a mark to the first one that is at least `WINDOW` inserts later.
    """
    inserts, samples = marks[marks[:, 0] >= MIN_SIZE + BATCH].T
    ends = np.searchsorted(inserts, inserts + WINDOW)
    starts = np.flatnonzero(ends < len(inserts))
    ends = ends[starts]
    assert len(starts) > 100
    expected = S * (inserts[ends] - inserts[starts])
    return float(np.abs((samples[ends] - samples[starts]) / expected - 1.0).max())


def write(endpoint: str, writers: range, stop: threading.Event) -> None:
    """Writes as several writers from one session until told to stop."""
    with session_to(endpoint) as session:
        sinks = [
            Writer(
                session=session,
                keys=KEYS,
                spec=SPEC,
                writer=writer,
                epoch=1,
                batch_rows=BATCH,
                window=2,
            )
            for writer in writers
        ]
        start = 0
        while not stop.is_set():
            for writer, sink in zip(writers, sinks, strict=True):
                sink.append(make_rows(start, BATCH, writer=writer), 0.05)
            start += BATCH


def marks_of(config: ReplayConfig, writers: int, inserts: int) -> np.ndarray:
    """(inserts, samples) at each reply of a service, until it has so many inserts.

    There is one reader with one query out at a time: a reply's `inserts` are those at
    its draw, and what was drawn is what was received.
    """
    stop, marks, samples = threading.Event(), [(0, 0)], 0
    with service(config) as running, contextlib.ExitStack() as stack:
        threads = [
            threading.Thread(
                target=write,
                args=(running.endpoint, range(first, min(first + 8, writers)), stop),
            )
            for first in range(0, writers, 8)
        ]
        for thread in threads:
            thread.start()
            stack.callback(thread.join)
        stack.callback(stop.set)
        sampler = Sampler(
            session=running.client,
            keys=KEYS,
            spec=SPEC,
            batch_size=DRAWN,
            in_flight=1,
            hold_s=1.0,
        )
        while marks[-1][0] < inserts:
            sample = sampler.sample(30.0)
            samples += len(sample.ids)
            marks.append((sample.inserts, samples))
    return np.array(marks)


@pytest.mark.slow
@pytest.mark.parametrize("writers", [1, 8, 64])
def test_ratio_is_within_a_hundredth_over_any_ten_thousand_inserts(
    writers: int,
) -> None:
    marks = marks_of(CONFIG, writers, MIN_SIZE + WINDOW + 3_000)
    owed = S * (marks[1:, 0] - MIN_SIZE) - marks[1:, 1]
    tolerance = CONFIG.limiter().tolerance
    assert np.abs(owed).max() <= tolerance
    error = worst(marks)
    assert error <= (2 * tolerance + S * BATCH + DRAWN) / (S * WINDOW) < 0.01
    print(f"{writers} writers: {error:.2%}")


@pytest.mark.parametrize(("looser", "found"), [(1, False), (2.5, True)])
def test_a_limiter_that_is_too_loose_is_found(looser: float, found: bool) -> None:
    """Each side in turn goes as far as it may, once in every half window."""
    limiter = replace(CONFIG, tolerance=looser * CONFIG.tolerance).limiter()
    inserts, samples, marks = MIN_SIZE, 0, []
    while inserts < 4 * WINDOW:
        now = {"inserts": inserts, "deletes": 0, "samples": samples}
        ahead = inserts // WINDOW % 2 == 0  # who goes first: the writers
        insert = limiter.may_insert(BATCH, **now)
        sample = limiter.may_sample(BATCH, **now)
        assert insert or sample
        if insert and (ahead or not sample):
            inserts += BATCH
        else:
            samples += BATCH
        marks.append((inserts, samples))
    assert (worst(np.array(marks)) > 0.01) == found
