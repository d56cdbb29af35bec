"""kill -9 of a durable service under load: every acknowledged row exactly once.

By all ways that rows take: every second writer puts them into memory of its own for the
service to read, the learner draws through memory or by a stream.
"""

import contextlib
import functools
import random
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from replay.client import ReplayTimeout, Sampler, fetch_rows, fetch_stats
from replay.local import LocalReplay
from replay.session import open_session
from tests.replay_durable_parts import CHECKED, LOADED, checked_rows, checksum
from tests.replay_parts import KEYS, eventually, free_endpoint, session_to
from tests.test_replay_processes import has_rows, role, wait_for_service


class Learner:
    """Samples as fast as it gets, and counts what it got."""

    def __init__(self, session: zenoh.Session) -> None:
        """Begins at once, in a thread."""
        self.received = 0
        self.bad = 0
        self._stop = threading.Event()
        self.sampler = Sampler(
            session=session, keys=KEYS, spec=CHECKED, batch_size=32, hold_s=0.5
        )
        self.sampler.stream_bytes = 1  # also answers as small as these
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(ReplayTimeout):
                sample = self.sampler.sample(0.5)
                self.received += len(sample.ids)
                self.bad += int(sample.rows["crc"][0]) != checksum(sample.rows[0])

    def close(self) -> None:
        """Ends the thread; returns when nothing that it asked for is drawn any more."""
        self._stop.set()
        self._thread.join()
        assert eventually(self._is_answered)

    def _is_answered(self) -> bool:
        self.sampler._collect()
        return not self.sampler._outstanding


@contextlib.contextmanager
def load(
    endpoint: str, session: zenoh.Session, writers: int
) -> Iterator[tuple[list["subprocess.Popen[str]"], Learner]]:
    """Writers as processes and a learner; ended in any case."""
    with contextlib.ExitStack() as stack:
        processes = [
            stack.enter_context(role("checked", endpoint, writer, 1))
            for writer in range(writers)
        ]
        learner = Learner(session)
        stack.callback(learner.close)
        yield processes, learner


def check_rows(session: zenoh.Session, written: list[int]) -> int:
    """Every row of every writer once, in order, as it was written; how many."""
    pages = list(fetch_rows(session=session, keys=KEYS, spec=CHECKED))
    rows = np.concatenate([page.rows for page in pages])
    ids = np.concatenate([page.ids for page in pages])
    np.testing.assert_array_equal(ids, np.arange(len(ids)))
    for writer, count in enumerate(written):
        got = rows[rows["writer"] == writer]
        np.testing.assert_array_equal(got["number"], np.arange(count))
        np.testing.assert_array_equal(got, checked_rows(0, count, writer=writer))
    assert len(rows) == sum(written)  # none invented
    return len(rows)


def kill_under_load(
    folder: Path, *, kills: int, writers: int, seed: int, streamed: bool
) -> None:
    """Kills the service at random moments, recovery included, then counts."""
    chance, endpoint = random.Random(seed), free_endpoint()
    with contextlib.ExitStack() as stack:
        service = stack.enter_context(role("service", endpoint, folder))
        wait_for_service(service)
        session = stack.enter_context(session_to(endpoint))
        drawn = open_session(connect=[endpoint], shared_memory=not streamed)
        stack.callback(drawn.close)
        processes, learner = stack.enter_context(load(endpoint, drawn, writers))
        assert eventually(lambda: has_rows(session, 200))
        stored = sampled = 0
        for turn in range(kills):
            with contextlib.suppress(subprocess.TimeoutExpired):
                service.wait(chance.uniform(0.0, 1.5 if turn % 5 else 0.3))
            service.kill()
            service.wait()
            service = stack.enter_context(role("service", endpoint, folder))
            if turn % 5:  # else it is killed while it starts and recovers
                wait_for_service(service)
                assert eventually(functools.partial(has_rows, session, stored))
                stats = fetch_stats(session, KEYS)
                assert stats["inserts"] >= stored and stats["samples"] >= sampled
                stored, sampled = stats["inserts"], stats["samples"]
        assert eventually(functools.partial(has_rows, session, stored))
        for process in processes:
            process.terminate()
        written = [int(p.communicate(timeout=90)[0].split()[-1]) for p in processes]
        assert eventually(lambda: has_rows(session, sum(written)))
        learner.close()
        stats = fetch_stats(session, KEYS)
        assert stats["inserts"] == check_rows(session, written) > kills
        assert {w["writer"]: w["rows"] for w in stats["writers"]} == dict(
            enumerate(written)
        )
        assert learner.bad == 0
        assert learner.sampler.streamed >= kills * streamed
        assert learner.sampler.placed >= kills * (not streamed)
        # Drawn and not received: at most what was in flight at each kill and the end.
        lost = stats["samples"] - learner.received
        assert 0 <= lost <= (kills + 1) * 2 * 32
        service.terminate()
        assert service.wait(20) == 0
    again = LocalReplay(spec=CHECKED, config=LOADED, seed=0, folder=folder)
    assert (again.inserts, again.samples) == (stats["inserts"], stats["samples"])
    again.close()


@pytest.fixture(autouse=True)
def streams_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Soon again after a kill."""
    monkeypatch.setattr("replay.sampler._STREAM_RETRY_S", 0.1)


def test_killed_under_load_it_keeps_every_acknowledged_row_once(tmp_path: Path) -> None:
    kill_under_load(tmp_path / "replay", kills=3, writers=2, seed=0, streamed=True)


@pytest.mark.slow
@pytest.mark.parametrize("streamed", [False, True])
def test_fifty_kills_with_four_writers(tmp_path: Path, streamed: bool) -> None:
    kill_under_load(
        tmp_path / "replay", kills=25, writers=4, seed=1 + streamed, streamed=streamed
    )


@pytest.mark.slow
def test_a_million_rows_are_back_in_seconds(tmp_path: Path) -> None:
    replay = LocalReplay(spec=CHECKED, config=LOADED, seed=0, folder=tmp_path)
    rows = CHECKED.as_bytes(checked_rows(0, 500, writer=0))
    for _ in range(1 << 11):
        while not replay.may_insert(500):
            if not replay.may_sample(500):
                assert replay.durable is not None
                replay.durable.wait()
            else:
                replay.sample(500)
        replay.insert_bytes(rows)
    before = replay.inserts
    assert before == 1_024_000
    replay.close()
    started = time.monotonic()
    again = LocalReplay(spec=CHECKED, config=LOADED, seed=0, folder=tmp_path)
    assert time.monotonic() - started < 10.0
    assert again.inserts == before
    again.close()
