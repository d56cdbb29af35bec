"""The service over real Zenoh links: exactly once, back-pressure, the ratio."""

import threading
import time

import numpy as np
import pytest
import zenoh

from replay.client import ReplayTimeout, Sampler, Writer, fetch_rows, fetch_stats
from replay.local import ReplayConfig
from replay.session import ask
from replay.spec import Field, ReplayError, RowSpec
from replay.wire import SampleReply, SampleRequest, Status
from replay.wire_inserts import Insert, InsertReply
from tests.replay_parts import (
    KEYS,
    OPEN,
    SMALL,
    SPEC,
    Service,
    eventually,
    make_rows,
    service,
    session_to,
)


def stored_numbers(session: zenoh.Session) -> list[int]:
    """The numbers of all rows in the table, in the order of their ids."""
    pages = fetch_rows(session=session, keys=KEYS, spec=SPEC, page_rows=100)
    return [int(n) for page in pages for n in page.rows["number"]]


def send(
    running: Service, sequence: int, *, epoch: int = 1, base: int = 0, hold_ms: int = 0
) -> InsertReply:
    """One batch of ten rows by hand, numbered by its sequence."""
    message = Insert(
        writer=1,
        epoch=epoch,
        sequence=sequence,
        base=base,
        hold_ms=hold_ms,
        rows=SPEC.as_bytes(make_rows(10 * sequence, 10)),
    )
    payload = ask(running.client, KEYS.insert, message.encode(SPEC), timeout_s=10.0)
    assert payload is not None
    return InsertReply.decode(payload, SPEC)


def make_writer(session: zenoh.Session, *, writer: int = 1, **options: float) -> Writer:
    settings = {"epoch": 1, "batch_rows": 4, "hold_s": 0.3} | options
    return Writer(session=session, keys=KEYS, spec=SPEC, writer=writer, **settings)


def make_sampler(session: zenoh.Session, **options: float) -> Sampler:
    settings = {"batch_size": 8, "hold_s": 0.3} | options
    return Sampler(session=session, keys=KEYS, spec=SPEC, **settings)


def test_rows_come_back_as_they_were_written() -> None:
    with service(OPEN) as running:
        writer = make_writer(running.client)
        for start in range(0, 1003, 17):
            assert writer.append(make_rows(start, min(17, 1003 - start)), 10.0)
        assert writer.close(20.0)
        assert writer.acknowledged == 1003
        assert stored_numbers(running.client) == list(range(1003))
        pages = list(fetch_rows(session=running.client, keys=KEYS, spec=SPEC))
        rows = np.concatenate([page.rows for page in pages])
        np.testing.assert_array_equal(rows, make_rows(0, 1003))
        stats = fetch_stats(running.client, KEYS)
    (told,) = stats["writers"]
    assert (told["writer"], told["epoch"], told["rows"]) == (1, 1, 1003)
    assert told["next_sequence"] == 251  # of 4 rows, the last of 3
    assert (stats["inserts"], stats["duplicates"], stats["gaps"]) == (1003, 0, 0)


def test_duplicates_gaps_and_old_epochs() -> None:
    with service(OPEN) as running:
        replies = [
            send(running, 0),
            send(running, 2),
            send(running, 1),
            send(running, 1),
            send(running, 0, epoch=2),
            send(running, 2),
        ]
        assert [(reply.status, reply.next_sequence) for reply in replies] == [
            (Status.OK, 1),
            (Status.GAP, 1),
            (Status.OK, 2),
            (Status.OK, 2),
            (Status.OK, 1),
            (Status.STALE, 1),
        ]
        assert "give every actor its own number" in replies[-1].reason
        assert stored_numbers(running.client) == [*range(20), *range(10)]
        stats = fetch_stats(running.client, KEYS)
    assert (stats["duplicates"], stats["gaps"], stats["refused"]) == (1, 1, 1)
    assert stats["writers"][0]["rows"] == 30


def test_a_full_table_pushes_back_and_goes_on() -> None:
    """Without a sampler the writer is held, told "busy" and loses nothing."""
    with service(SMALL) as running:
        writer = make_writer(running.client, window=2, hold_s=0.1)
        numbers = iter(range(0, 10_000, 4))
        while writer.append(make_rows(next(numbers), 4), 0.4):
            pass
        # I s - S <= m s + e, so I <= 15: three batches of 4.
        assert writer.acknowledged == 12
        assert writer.waited_s >= 0.3
        stats = fetch_stats(running.client, KEYS)
        assert stats["inserts"] == 12
        assert stats["busy_inserts"] > 0
        assert stats["insert_wait_s"] > 0.1
        sampler = make_sampler(running.client)
        while not writer.flush(0.0):
            sampler.sample(10.0)
        stored = stored_numbers(running.client)
        assert stored == list(range(len(stored)))
        assert len(stored) == writer.acknowledged >= 20
        writer.close()


def test_an_early_sampler_waits_for_data() -> None:
    with service(SMALL) as running:
        sampler = make_sampler(running.client, hold_s=0.05)
        with pytest.raises(ReplayTimeout, match="do actors insert"):
            sampler.sample(0.3)
        assert 0.1 < sampler.waited_s < 10.0
        assert fetch_stats(running.client, KEYS)["busy_samples"] > 0
        writer = make_writer(running.client)
        writer.append(make_rows(0, 12))
        sample = sampler.sample(10.0)
        assert sample.ids.shape == (8,)
        np.testing.assert_array_equal(sample.rows, make_rows(0, 12)[sample.ids])
        writer.close()


def test_samples_per_insert_is_the_configured_ratio() -> None:
    """Two writers and a sampler at full speed: 2 within 2% over 4,000 inserts."""
    with service(SMALL) as running, session_to(running.endpoint) as other:
        writers = [make_writer(running.client, writer=w) for w in (0, 1)]
        stop = threading.Event()

        def write(writer: Writer, number: int) -> None:
            start = 0
            while not stop.is_set():
                if writer.append(make_rows(start, 4, writer=number), 0.2):
                    start += 4

        threads = [
            threading.Thread(target=write, args=(writer, number))
            for number, writer in enumerate(writers)
        ]
        for thread in threads:
            thread.start()
        sampler = make_sampler(other, batches_per_reply=1)
        while (sample := sampler.sample(20.0)).inserts < 4000:
            sampler.update_priorities(sample.ids, sample.rows["number"] % 5 + 0.5)
        stats = fetch_stats(other, KEYS)
        stop.set()
        for thread in threads:
            thread.join()
        for writer in writers:
            writer.flush(0.0)
    assert stats["samples_per_insert"] == pytest.approx(2.0, rel=0.02)
    assert stats["stale_updates"] == 0
    assert {w["writer"] for w in stats["writers"]} == {0, 1}


def test_priorities_reach_the_table_with_the_next_query() -> None:
    with service(SMALL) as running:
        writer = make_writer(running.client)
        writer.append(make_rows(0, 12))
        assert writer.flush(10.0)
        sampler = make_sampler(running.client, batch_size=4, in_flight=1)
        first = sampler.sample(10.0)
        np.testing.assert_allclose(first.probabilities, 1 / 12)
        sampler.update_priorities(np.arange(12), 1.0 * (np.arange(12) == 5))
        sampler.sample(10.0)  # was asked for before the update
        third = sampler.sample(10.0)
        assert third.ids.tolist() == [5] * 4
        np.testing.assert_allclose(third.probabilities, 1.0)
        writer.close()


def test_several_batches_in_a_reply_are_handed_out_one_by_one() -> None:
    config = ReplayConfig(capacity=100, min_size=50, tolerance=1.0)
    with service(config) as running:
        writer = make_writer(running.client)
        writer.append(make_rows(0, 60))
        assert writer.flush(10.0)
        sampler = make_sampler(running.client, batches_per_reply=3, in_flight=1)
        batches = [sampler.sample(10.0) for _ in range(3)]
        assert [batch.rows.shape for batch in batches] == [(8,)] * 3
        for batch in batches:  # each is stratified over the 60 rows by itself
            assert (np.diff(batch.ids.astype(int)) > 0).all()
        writer.close()


def test_what_can_never_work_is_refused_with_its_reason() -> None:
    other = RowSpec((Field("writer", "i4"),))
    with service(SMALL) as running:
        stranger = Writer(
            session=running.client, keys=KEYS, spec=other, writer=9, epoch=1
        )
        stranger.append(np.zeros(64, other.dtype))
        with pytest.raises(ReplayError, match="row schema"):
            stranger.close(10.0)
        greedy = make_writer(running.client, writer=3, batch_rows=64)
        greedy.append(make_rows(0, 64))
        with pytest.raises(ReplayError, match="would deadlock"):
            greedy.close(10.0)
        sampler = make_sampler(running.client, batch_size=100)
        with pytest.raises(ReplayError, match="would deadlock"):
            sampler.sample(10.0)
        with pytest.raises(ReplayError, match="diverged"):
            sampler.update_priorities(np.array([1]), np.array([float("nan")]))
        assert fetch_stats(running.client, KEYS)["inserts"] == 0


def test_the_service_checks_priorities_itself() -> None:
    request = SampleRequest(
        batch_size=1,
        batches=1,
        hold_ms=0,
        ids=np.array([0], np.uint64),
        priorities=np.array([float("nan")]),
    )
    with service(SMALL) as running:
        payload = ask(running.client, KEYS.sample, request.encode(SPEC), timeout_s=10.0)
        assert payload is not None
        reply = SampleReply.decode(payload, SPEC)
        assert (reply.status, "diverged" in reply.reason) == (Status.REFUSED, True)
        for key in (KEYS.insert, KEYS.sample, KEYS.fetch):
            assert ask(running.client, key, b"rubbish", timeout_s=10.0) is not None
        assert fetch_stats(running.client, KEYS)["refused"] == 4


def test_a_replaced_writer_is_told_so() -> None:
    with service(OPEN) as running:
        old, new = make_writer(running.client), make_writer(running.client, epoch=2)
        for writer in (old, new):
            writer.append(make_rows(0, 4))
            assert writer.flush(10.0)
        old.append(make_rows(4, 4))
        with pytest.raises(ReplayError, match="replaced by a process of epoch 2"):
            old.flush(10.0)
        new.close()


def test_a_writer_started_after_its_clock_was_set_back_goes_on() -> None:
    """Epochs are clock readings: a later life may begin with an earlier one."""
    with service(OPEN) as running:
        for epoch, first in ((9, 0), (3, 4), (3, 8)):
            writer = make_writer(running.client, epoch=epoch)
            writer.append(make_rows(first, 4))
            assert writer.close(10.0)
            assert writer.acknowledged == 4
        assert stored_numbers(running.client) == list(range(12))
        assert fetch_stats(running.client, KEYS)["writers"][0]["epoch"] == 11


def test_nobody_there_is_told_in_one_line() -> None:
    with service(OPEN) as running:
        nobody = type(KEYS)("another-run")
        started = time.monotonic()
        with pytest.raises(ReplayTimeout, match="is the replay service up"):
            fetch_stats(running.client, nobody, timeout=5.0)
        assert time.monotonic() - started < 4.0  # an empty answer, not a timeout
        writer = Writer(
            session=running.client, keys=nobody, spec=SPEC, writer=0, epoch=0
        )
        assert writer.append(make_rows(0, 64))
        assert eventually(lambda: writer.resent >= 3)
        assert not writer.close(0.1)
        assert writer.acknowledged == 0


@pytest.mark.parametrize(
    ("settings", "why"), [({"window": 0}, "window=0"), ({"epoch": -1}, "epoch=-1")]
)
def test_bad_writer_settings(settings: dict[str, int], why: str) -> None:
    with service(OPEN) as running, pytest.raises(ReplayError, match=why):
        make_writer(running.client, **settings)
