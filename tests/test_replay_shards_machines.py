"""A run over three machines: the hub, a shard that joins by `--announce`, the clients.

Each machine is a network namespace with links of its own to both others, and the two
of the services see no processes but their own: rows go over the network alone, as
between real machines. The roles are the commands that a user gives.
"""

import contextlib
import dataclasses
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from launch.config import RunFile, quick, row_spec_of
from launch.join import HELD_OUT, SCENES, TRAIN
from replay.client import ReplayTimeout, fetch_rows
from replay.keys import RunKeys
from replay.session import open_session
from replay.shards_directory import ShardDirectory
from replay.shards_sampler import ShardedSampler
from replay.shards_writer import ShardedWriter
from replay.spec import RowSpec
from tests.replay_parts import eventually
from tests.replay_shard_parts import shard_of

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
RUN = "machines"
# The ends of each link: this machine and the hub's, this and the shard's, those two.
TO_HUB, TO_SHARD, BETWEEN = (
    (f"10.79.{link}.1", f"10.79.{link}.2") for link in range(3)
)
HUB_PORT, SHARD_PORT = 7447, 7448
ROWS = 10  # of a batch of a writer


def machine(name: str) -> list[str]:
    """What a command is put behind to run on a machine, seeing its processes alone."""
    alone = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]
    return ["ip", "netns", "exec", name, *alone]


@contextlib.contextmanager
def machines() -> Iterator[tuple[str, str]]:
    """Two machines beside this one, all linked; those of the hub and of the shard."""
    hub, shard = (f"slip{os.getpid()}{letter}" for letter in "hs")
    made = subprocess.run(["ip", "netns", "add", hub], capture_output=True)
    if made.returncode:
        pytest.skip("no right to make network namespaces")
    links = [
        (None, hub, TO_HUB),
        (None, shard, TO_SHARD),
        (hub, shard, BETWEEN),
    ]
    try:
        subprocess.run(["ip", "netns", "add", shard], check=True)
        for number, (one, other, addresses) in enumerate(links):
            ends = (f"sl{os.getpid()}x{number}", f"sl{os.getpid()}y{number}")
            inside = f"netns {one} " if one else ""
            made_of = f"{ends[0]} {inside}type veth peer name {ends[1]} netns {other}"
            subprocess.run(["ip", "link", "add", *made_of.split()], check=True)
            for place, end, address in zip((one, other), ends, addresses, strict=True):
                ip = ["ip", "-n", place] if place else ["ip"]
                to = [f"{address}/30", "dev", end]
                subprocess.run([*ip, "addr", "add", *to], check=True)
                subprocess.run([*ip, "link", "set", end, "up"], check=True)
        yield hub, shard
    finally:
        for name in (hub, shard):
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


@contextlib.contextmanager
def role(where: str, cache: Path, *words: object) -> Iterator[subprocess.Popen[bytes]]:
    """`slipstream replay` on a machine with a cache of its own."""
    program = [sys.executable, "-m", "launch", "replay", "--run-id", RUN]
    process = subprocess.Popen(
        [*machine(where), *program, *map(str, words), "--durable", "--insecure"],
        cwd=ROOT,
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def prepared(folder: Path) -> RunFile:
    """The folder of a run of two shards, with no scenes to speak of."""
    config = dataclasses.replace(quick(), shards=2)
    run = RunFile(run_id=RUN, config=config, train_hash="", held_out_hash="", scenes=())
    (folder / SCENES).mkdir(parents=True)
    for name in (TRAIN, HELD_OUT):
        (folder / SCENES / name).write_bytes(b"none")
    run.write(folder)
    return run


class Clients:
    """Two writers and a learner on this machine."""

    def __init__(self, spec: RowSpec) -> None:
        """Links to the shards as they are announced."""
        self._spec = spec
        self._stack = contextlib.ExitStack()
        self.session, self.directory = self._place()
        self.said: list[str] = []
        self.sampler = ShardedSampler(
            directory=self.directory, spec=spec, batch_size=64, say=self.said.append
        )
        self.written = [0, 0]
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._write, args=(writer,)) for writer in range(2)
        ]

    def _place(
        self, wanted: tuple[int, ...] | None = None
    ) -> tuple[zenoh.Session, ShardDirectory]:
        """A session to the hub, and the shards as it sees them."""
        endpoint = f"tcp/{TO_HUB[1]}:{HUB_PORT}"
        session = open_session(connect=[endpoint], timeout_s=60.0)
        self._stack.callback(session.close)
        directory = ShardDirectory(
            session=session,
            keys=RunKeys(RUN),
            spec=self._spec,
            hub=[endpoint],
            insecure=True,
            wanted=wanted,
        )
        self._stack.callback(directory.close)
        return session, directory

    def start(self) -> None:
        """The writers begin."""
        for thread in self._threads:
            thread.start()

    def _write(self, number: int) -> None:
        _, directory = self._place(wanted=())  # a writer's links are its own
        writer = ShardedWriter(
            directory=directory,
            spec=self._spec,
            writer=number,
            epoch=time.time_ns() // 1_000_000,
            shards=2,
            durable=True,
            batch_rows=ROWS,
        )
        count = 0
        while not self._stop.is_set():
            rows = np.zeros(ROWS, self._spec.dtype)
            rows["actor"], rows["serial"] = number, np.arange(count, count + ROWS)
            while not writer.append(rows, 0.2) and not self._stop.is_set():
                rows = rows[:0]
            count += ROWS
        if writer.close(30.0):
            self.written[number] = count

    def draws(self, shards: set[int], *, after: str = "") -> int:
        """Draws until rows of all these came, and the line was said; rows of shard 1.

        Rows of no other shard may come once it was said.
        """
        seen: set[int] = set()
        drawn = remote = 0
        deadline = time.monotonic() + 30.0
        while not (shards <= seen and drawn >= 50):
            assert time.monotonic() < deadline, (seen, drawn, self.said)
            with contextlib.suppress(ReplayTimeout):
                numbers = shard_of(self.sampler.sample(0.2).ids)
                if after and after not in self.said[-1:]:
                    continue
                seen |= set(numbers.tolist())
                remote += int((numbers == 1).sum())
                drawn += 1
        assert seen == shards
        return remote

    def end(self) -> None:
        """Ends the writers, which wait until all is acknowledged."""
        self._stop.set()
        deadline = time.monotonic() + 40.0
        while any(thread.is_alive() for thread in self._threads):
            assert time.monotonic() < deadline
            with contextlib.suppress(ReplayTimeout):
                self.sampler.sample(0.1)  # what is owed may be what they wait for

    def close(self) -> None:
        """Ends all."""
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        self._stack.close()


def received(device: str) -> int:
    """Bytes that came in by a network device of this machine."""
    return int(Path(f"/sys/class/net/{device}/statistics/rx_bytes").read_text())


def test_a_shard_of_another_machine_joins_dies_and_comes_back(tmp_path: Path) -> None:
    """Announced, drawn from over its own link; every row of both shards once."""
    folder = tmp_path / "run"
    spec = row_spec_of(prepared(folder))
    with contextlib.ExitStack() as stack:
        hub_place, shard_place = stack.enter_context(machines())
        words = ("--listen", f"tcp/0.0.0.0:{HUB_PORT}", "--run", folder)
        stack.enter_context(role(hub_place, tmp_path, *words))
        joining = ("--shard", 1, "--connect", f"tcp/{BETWEEN[0]}:{HUB_PORT}")
        reached = f"tcp/{TO_SHARD[1]}:{SHARD_PORT}"
        joining += ("--listen", f"tcp/0.0.0.0:{SHARD_PORT}", "--announce", reached)
        other = tmp_path / "other"  # where that machine keeps what it fetched
        shard = stack.enter_context(role(shard_place, other, *joining))
        clients = Clients(spec)
        stack.callback(clients.close)
        assert eventually(lambda: len(clients.directory.links) == 2, 40.0)
        assert clients.directory.links[1].endpoints == (reached,)
        device = f"sl{os.getpid()}x1"
        before = received(device)
        clients.start()
        remote = clients.draws({0, 1})
        assert received(device) - before > remote * spec.row_bytes > 0
        shard.kill()
        clients.draws({0}, after="replay shard 1 left: drawn from no longer")
        stack.enter_context(role(shard_place, other, *joining))
        clients.draws(
            {0, 1}, after="replay shard 1 joined: drawn from once it has rows"
        )
        clients.end()
        pages = [
            page.rows
            for number in range(2)
            for page in fetch_rows(
                session=clients.session, keys=RunKeys(RUN, number), spec=spec
            )
        ]
        rows = np.concatenate(pages)
        for writer, count in enumerate(clients.written):
            serials = rows["serial"][rows["actor"] == writer]
            assert count > 0
            np.testing.assert_array_equal(serials, np.arange(count))
