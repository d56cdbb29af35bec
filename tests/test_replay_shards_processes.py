"""Shards as real processes, killed and joining under load; draws against one table."""

import contextlib
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from replay.client import ReplayTimeout, fetch_rows
from replay.keys import RunKeys
from replay.local import ReplayConfig
from replay.session import open_session
from replay.shards import live_shards
from replay.shards_directory import ShardDirectory
from replay.shards_sampler import ShardedSampler
from tests.replay_durable_parts import CHECKED, checksum, fast_folder
from tests.replay_parts import KEYS, SPEC, eventually, free_endpoint
from tests.replay_shard_parts import directory_of, fill, shard_of, shards_of

pytestmark = pytest.mark.slow


def start(*words: object) -> psutil.Popen:
    """A role; one that says `ready` has said so."""
    process = psutil.Popen(
        [sys.executable, "-m", "tests.replay_shard_roles", *map(str, words)],
        stdout=subprocess.PIPE,
        text=True,
    )
    if words[0] == "shard":
        assert process.stdout.readline() == "ready\n"
    return process


class Fleet:
    """Three shards, four writers and a learner that draws in this process."""

    def __init__(self, folder: Path | None) -> None:
        """With a folder the shards are durable."""
        self.folder = folder
        self.endpoints = [free_endpoint() for _ in range(3)]
        self.shards = [self.serve(number) for number in range(3)]
        kind = "durable" if folder else "memory"
        self.writers = [start("writer", self.hub, w, 3, kind) for w in range(4)]
        self.session = open_session(connect=[self.hub])
        self.directory = ShardDirectory(
            session=self.session, keys=KEYS, spec=CHECKED, hub=[self.hub]
        )
        self.said: list[str] = []
        self.drawn = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._learn)
        self._thread.start()

    @property
    def hub(self) -> str:
        """Where shard 0 listens."""
        return self.endpoints[0]

    def serve(self, number: int) -> psutil.Popen:
        """Starts a shard, where it was if it was there."""
        hub = self.hub if number else "-"
        folder = self.folder / str(number) if self.folder else "-"
        return start("shard", number, self.endpoints[number], hub, folder)

    def kill(self, number: int) -> None:
        """kill -9."""
        self.shards[number].send_signal(signal.SIGKILL)
        self.shards[number].wait()

    def _learn(self) -> None:
        sampler = ShardedSampler(
            directory=self.directory,
            spec=CHECKED,
            batch_size=64,
            say=self.said.append,
        )
        while not self._stop.is_set():
            with contextlib.suppress(ReplayTimeout):
                batch = sampler.sample(0.1)
                sampler.update_priorities(batch.ids, np.ones(64))
                self.drawn += 1

    def goes_on(self, batches: int = 30) -> bool:
        """Whether the learner gets so many more batches."""
        before = self.drawn
        return eventually(lambda: self.drawn >= before + batches, 60.0)

    def end_writers(self) -> list[int]:
        """Asks the writers to end; how many rows each wrote."""
        for writer in self.writers:
            writer.send_signal(signal.SIGTERM)
        told = [writer.communicate(timeout=90)[0].split() for writer in self.writers]
        assert all(words[0] == "all" for words in told)
        assert [writer.returncode for writer in self.writers] == [0, 0, 0, 0]
        return [int(words[1]) for words in told]

    def rows(self) -> np.ndarray:
        """Of all shards that are up."""
        return np.concatenate(
            [
                page.rows
                for shard in live_shards(self.session, KEYS)
                for page in fetch_rows(
                    session=self.session,
                    keys=RunKeys(KEYS.run_id, shard),
                    spec=CHECKED,
                )
            ]
        )

    def close(self) -> None:
        """Ends everything."""
        self._stop.set()
        self._thread.join()
        self.directory.close()
        self.session.close()  # type: ignore[no-untyped-call]
        for process in (*self.writers, *self.shards):
            with contextlib.suppress(psutil.Error):
                process.kill()
            process.wait()


@contextlib.contextmanager
def fleet(folder: Path | None) -> Iterator[Fleet]:
    """Ended whatever happens."""
    running = Fleet(folder)
    try:
        yield running
    finally:
        running.close()


def test_killed_durable_shards_lose_and_double_no_row() -> None:
    with fast_folder() as folder, fleet(folder) as running:
        assert running.goes_on()
        for number in (1, 2, 0):
            running.kill(number)
            if number:
                left = f"replay shard {number} left: drawn from no longer"
                assert eventually(lambda line=left: line in running.said, 5.0)
            running.shards[number] = running.serve(number)
            assert running.goes_on()
        written = running.end_writers()
        assert eventually(lambda: live_shards(running.session, KEYS) == [0, 1, 2])
        rows = running.rows()
        for writer, count in enumerate(written):
            own = rows[rows["writer"] == writer]
            numbers = np.sort(own["number"])
            np.testing.assert_array_equal(numbers, np.arange(count))
        assert all(row["crc"] == checksum(row) for row in rows)


def test_a_run_in_memory_goes_on_without_a_killed_shard_and_with_one_that_joins() -> (
    None
):
    with fleet(None) as running:
        assert running.goes_on()
        running.kill(2)
        assert eventually(lambda: "replay shard 2 left" in running.said[-1], 5.0)
        assert running.goes_on()
        running.endpoints.append(free_endpoint())
        running.shards.append(running.serve(3))
        assert eventually(lambda: "replay shard 3 joined" in running.said[-1], 20.0)
        assert running.goes_on()
        written = running.end_writers()
        rows = running.rows()
        for writer, count in enumerate(written):
            numbers = np.sort(rows["number"][rows["writer"] == writer])
            assert len(np.unique(numbers)) == len(numbers)
            assert numbers[-1] == count - 1
            # Writer 2's first rows went with its shard, nobody else's, and no more.
            holes = np.flatnonzero(np.diff(numbers) != 1)
            assert len(holes) == 0 and (writer == 2 or numbers[0] == 0)


def test_weighted_draws_are_one_big_tables() -> None:
    """Chi-square against p_i / sum(p), and the mean weighted by 1 / (N P)."""
    config = ReplayConfig(
        capacity=1 << 12,
        min_size=50,
        samples_per_insert=1e6,
        tolerance=1e3,
        priority_exponent=0.6,
    )
    with (
        shards_of(config, 3) as shards,
        directory_of(shards[0], count=3) as directory,
    ):
        sizes = {0: 60, 1: 120, 2: 220}
        fill(directory, sizes)
        sampler = ShardedSampler(
            directory=directory, spec=SPEC, batch_size=64, batches_per_reply=4
        )
        assert eventually(lambda: sampler.sample(20.0).size == 400)
        ids = np.concatenate(
            [
                np.arange(count, dtype=np.uint64) | np.uint64(shard << 48)
                for shard, count in sizes.items()
            ]
        )
        # Another scale in each shard: their shares are far from their sizes'.
        random = np.random.default_rng(0)
        priorities = random.uniform(0.1, 1, 400) * np.repeat([9, 1, 3], [60, 120, 220])
        sampler.update_priorities(ids, priorities)
        masses = priorities**0.6
        expected = dict(zip(ids.tolist(), masses / masses.sum(), strict=True))

        def settled() -> bool:
            batch = sampler.sample(20.0)
            exact = [expected[i] for i in batch.ids.tolist()]
            return np.allclose(batch.probabilities, exact, 1e-6, 0)  # float32 masses

        assert eventually(settled)
        for _ in range(30):  # what was under way when the priorities changed
            sampler.sample(20.0)
        drawn = [sampler.sample(20.0) for _ in range(1500)]
        exact = [
            batch
            for batch in drawn
            if np.allclose(
                batch.probabilities, [expected[i] for i in batch.ids.tolist()], 1e-6, 0
            )
        ]
        assert len(exact) > 1200  # in the others a shard was late
        all_ids = np.concatenate([batch.ids for batch in exact])
        counts = np.array([(all_ids == one).sum() for one in ids])
        wanted = np.array([expected[one] for one in ids.tolist()]) * len(all_ids)
        chi_square = ((counts - wanted) ** 2 / wanted).sum()
        assert chi_square < 399 + 4 * np.sqrt(2 * 399)
        # Late or not, the weighted mean of any function of the rows is its mean.
        weights = [1 / (batch.size * batch.probabilities) for batch in drawn]
        assert abs(np.mean(np.concatenate(weights)) - 1) < 0.02
        value = [
            np.mean(w * (shard_of(b.ids) == 1))
            for w, b in zip(weights, drawn, strict=True)
        ]
        assert abs(np.mean(value) - 120 / 400) < 0.02
