"""The sampler's look-ahead is bounded: a slow learner does not work off old draws."""

from replay.client import Sampler, Writer, fetch_stats
from replay.local import ReplayConfig
from tests.replay_parts import KEYS, SPEC, eventually, make_rows, service

FULL = ReplayConfig(
    capacity=1 << 12,
    min_size=64,
    samples_per_insert=1000.0,
    tolerance=1.0,
    priority_exponent=0.6,
)
BATCH, IN_FLIGHT = 8, 3


def test_a_slow_learner_is_not_flooded() -> None:
    """Drawn are the batches that were taken, and `in_flight` beyond them."""
    with service(FULL) as running:
        session = running.client
        writer = Writer(session=session, keys=KEYS, spec=SPEC, writer=0, epoch=1)
        writer.append(make_rows(0, 64))
        assert writer.flush(10.0)
        sampler = Sampler(
            session=session,
            keys=KEYS,
            spec=SPEC,
            batch_size=BATCH,
            in_flight=IN_FLIGHT,
        )

        def drawn() -> int:
            return fetch_stats(session, KEYS)["samples"] // BATCH

        for taken in range(1, 21):
            sampler.sample(10.0)
            # The learner computes for so long that all it asked for is drawn.
            eventually(lambda: drawn() >= taken + IN_FLIGHT - 1, 1.0)  # noqa: B023
            assert taken <= drawn() <= taken + IN_FLIGHT
        writer.close()
