"""The ratio of samples to inserts over any 10,000 consecutive inserts, really served.

There is one reader with one query out at a time. Each reply tells the inserts at its
draw, so the service's whole path is known: between two draws the samples stand still
while inserts go on from the one reply's count to the other's, and at a draw the
inserts stand still. No insert needs a mark of its own: every window of 10,000 inserts,
from any row on, is looked at, with what was drawn at its ends counted in or left out,
whichever is worse.

With S samples per insert and a tolerance of e samples, |(I - m) S - S_drawn| <= e at
every moment once filled, so over a window of W rows the samples are off by at most 2 e
of S W. The settings put that at half a percent: 1% must hold, and a limiter three
times as loose need not hold it (the last test shows that it is found).
"""

import contextlib
import threading
from dataclasses import replace

import numpy as np
import pytest

from replay.client import Sampler, Writer, fetch_stats
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
    """The worst relative error of the ratio over all windows of `WINDOW` inserts.

    Marks are (inserts at a draw, samples after it), in order.
    """
    inserts, samples = marks.T
    first, last = MIN_SIZE + BATCH, int(inserts[-1])
    moments = np.arange(first, last + 1)
    # Of the draws at so many inserts, none is counted in the least, all in the most.
    drawn = np.concatenate([[0], samples])
    least = drawn[np.searchsorted(inserts, moments, side="left")]
    most = drawn[np.searchsorted(inserts, moments, side="right")]
    assert len(moments) > WINDOW + 1_000
    expected = S * WINDOW
    over = (most[WINDOW:] - least[:-WINDOW]).max() / expected - 1.0
    under = 1.0 - (least[WINDOW:] - most[:-WINDOW]).min() / expected
    return float(max(over, under))


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
    """(inserts, samples) of each draw of a service, until it has so many inserts.

    What was drawn is what was received: the service's own counters must say so, too.
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
        counted = fetch_stats(running.client, KEYS)["samples"]
        assert samples <= counted <= samples + DRAWN  # one is asked for ahead
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
    assert error <= 2 * tolerance / (S * WINDOW) < 0.01
    print(f"{writers} writers: {error:.2%}")


@pytest.mark.parametrize(("looser", "found"), [(1, False), (3, True)])
def test_a_limiter_that_is_too_loose_is_found(looser: float, found: bool) -> None:
    """Each side in turn goes as far as it may, once in every half window."""
    limiter = replace(CONFIG, tolerance=looser * CONFIG.tolerance).limiter()
    inserts, samples, marks, step = MIN_SIZE, 0, [], 16
    while inserts < 4 * WINDOW:
        now = {"inserts": inserts, "deletes": 0, "samples": samples}
        ahead = inserts // WINDOW % 2 == 0  # who goes first: the writers
        insert = limiter.may_insert(step, **now)
        sample = limiter.may_sample(step, **now)
        assert insert or sample
        if insert and (ahead or not sample):
            inserts += step
        else:
            samples += step
        marks.append((inserts, samples))
    assert (worst(np.array(marks)) > 0.01) == found
