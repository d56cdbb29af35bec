"""Links that lose, delay, reset and cut; processes that stall: real ones, all of them.

A service, two writers and a reader as processes; in the tests of links the clients
live in a network namespace of their own, behind `tests.replay_link`. The test looks
at the service over a link that nothing is wrong with.
"""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
import zenoh

from replay.client import fetch_rows, fetch_stats
from tests.replay_durable_parts import CHECKED, LOADED, checked_rows
from tests.replay_link import ADDRESSES
from tests.replay_parts import KEYS, eventually, free_endpoint, session_to

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
WATCHED = ("10.78.0.1", "10.78.0.2")  # the link that nothing is wrong with
PORT = 7447
QUERY_S = 6.0  # until the roles' queries time out
Process = subprocess.Popen[str]


@contextlib.contextmanager
def module(name: str, *arguments: object, inside: str = "") -> Iterator[Process]:
    """A module of the tests as a process, killed at the end if it still runs."""
    prefix = ["ip", "netns", "exec", inside] if inside else []
    process = subprocess.Popen(
        [*prefix, sys.executable, "-m", f"tests.{name}", *map(str, arguments)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def told(process: Process) -> str:
    """The next line that it prints."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


@dataclass
class Run:
    """A running service with its clients, and a session that looks at it."""

    service: Process
    writers: list[Process]
    reader: Process
    watch: zenoh.Session

    def counts(self) -> tuple[int, int]:
        """Rows inserted and sampled."""
        stats = fetch_stats(self.watch, KEYS, timeout=20.0)
        return stats["inserts"], stats["samples"]

    def goes_on(self, within: float) -> float:
        """Seconds until every writer and the reader have got further."""

        def marks() -> np.ndarray:
            stats = fetch_stats(self.watch, KEYS, timeout=20.0)
            return np.array([stats["samples"], *(w["rows"] for w in stats["writers"])])

        started, before = time.monotonic(), marks()
        assert eventually(lambda: (marks() > before + 100).all(), within)
        return time.monotonic() - started

    def finish(self) -> None:
        """Ends the clients; every acknowledged row must be there once, unharmed."""
        for writer in self.writers:
            writer.terminate()
        written = [int(p.communicate(timeout=60)[0].split()[-1]) for p in self.writers]
        self.reader.terminate()
        told = self.reader.communicate(timeout=60)[0].split()
        received, damaged, streamed = map(int, told[1:])
        pages = list(fetch_rows(session=self.watch, keys=KEYS, spec=CHECKED))
        rows = np.concatenate([page.rows for page in pages])
        stats = fetch_stats(self.watch, KEYS)
        assert stats["inserts"] == sum(written) == len(rows)
        for writer, count in enumerate(written):
            got = rows[rows["writer"] == writer]
            np.testing.assert_array_equal(got, checked_rows(0, count, writer=writer))
        assert damaged == 0
        assert 0 < received <= stats["samples"]
        assert 32 * streamed > received / 2
        owed = stats["inserts"] - LOADED.min_size - stats["samples"]
        assert abs(owed) <= stats["tolerance"]


@contextlib.contextmanager
def run_of(*, serving: str, watched: str, inside: tuple[str, str]) -> Iterator[Run]:
    """All processes, the service and the clients in their namespaces."""
    endpoints = ",".join(dict.fromkeys([serving, watched]))
    role = "replay_fault_roles"
    with contextlib.ExitStack() as stack:
        service = stack.enter_context(
            module(role, "service", endpoints, inside=inside[0])
        )
        assert told(service) == "ready"
        writers = [
            stack.enter_context(
                module(role, "writer", serving, number, 1, inside=inside[1])
            )
            for number in range(2)
        ]
        reader = stack.enter_context(module(role, "reader", serving, inside=inside[1]))
        watch = stack.enter_context(session_to(watched))
        run = Run(service=service, writers=writers, reader=reader, watch=watch)
        assert eventually(lambda: run.counts()[1] > 0, 60.0)
        assert eventually(lambda: len(fetch_stats(watch, KEYS)["writers"]) == 2, 30.0)
        yield run


@contextlib.contextmanager
def namespaces() -> Iterator[tuple[str, str]]:
    """Two network namespaces, the first with a link to this one."""
    names = (f"slip{os.getpid()}a", f"slip{os.getpid()}b")
    made = subprocess.run(["ip", "netns", "add", names[0]], capture_output=True)
    if made.returncode or not os.access("/dev/net/tun", os.R_OK | os.W_OK):
        pytest.skip("no right to make network namespaces and TUN devices")
    outer = f"slip{os.getpid()}"
    commands = [
        f"netns add {names[1]}",
        f"link add {outer} type veth peer name watch0 netns {names[0]}",
        f"addr add {WATCHED[0]}/30 dev {outer}",
        f"link set {outer} up",
        f"-n {names[0]} addr add {WATCHED[1]}/30 dev watch0",
        f"-n {names[0]} link set watch0 up",
    ]
    try:
        for command in commands:
            subprocess.run(["ip", *command.split()], check=True)
        yield names
    finally:
        # First: a namespace lives on with what is still open in it, and its link too.
        subprocess.run(["ip", "link", "del", outer], capture_output=True)
        for name in names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


def order(link: Process, line: str) -> int:
    """Gives the link an order; how many packets it has lost so far."""
    assert link.stdin is not None
    link.stdin.write(line + "\n")
    link.stdin.flush()
    return int(told(link))


def test_links_that_lose_delay_reset_and_cut() -> None:
    """Slower while it lasts; afterwards it goes on and every row is there once."""
    with contextlib.ExitStack() as stack:
        names = stack.enter_context(namespaces())
        link = stack.enter_context(module("replay_link", *names))
        assert told(link) == "ready"
        run = stack.enter_context(
            run_of(
                serving=f"tcp/{ADDRESSES[0]}:{PORT}",
                watched=f"tcp/{WATCHED[1]}:{PORT}",
                inside=names,
            )
        )
        assert order(link, "loss 0.05") == 0
        print(f"loss of 5%: on after {run.goes_on(90.0):.1f} s")
        order(link, "loss 0.2")
        print(f"loss of 20%: on after {run.goes_on(90.0):.1f} s")
        assert order(link, "loss 0") > 10
        order(link, "delay 0.1 0.05")
        print(f"delay: on after {run.goes_on(60.0):.1f} s")
        order(link, "delay 0 0")
        order(link, "reset")
        print(f"reset: on after {run.goes_on(30.0):.1f} s")
        order(link, "cut 1")
        before = run.counts()
        time.sleep(QUERY_S + 2.0)
        after = run.counts()
        assert after[0] - before[0] < 1000  # what was on its way
        order(link, "cut 0")
        print(f"cut for {QUERY_S + 2:g} s: on after {run.goes_on(30.0):.1f} s")
        run.finish()


def connections(service: Process) -> int:
    """Sessions' TCP connections to the service, over the link that may be cut."""
    ours = f"{socket.inet_aton(ADDRESSES[0])[::-1].hex().upper()}:{PORT:04X}"
    lines = Path(f"/proc/{service.pid}/net/tcp").read_text().splitlines()[1:]
    words = [line.split() for line in lines]
    return sum(w[1] == ours and w[3] == "01" for w in words)  # established


def test_a_link_that_is_cut_for_longer_than_its_lease(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The service gives its clients up; they come back, every row is there once.

    The lease is 5 s here; to try the minute that it is in a run, set LONG_LEASE_S=60.
    """
    lease = float(os.environ.get("LONG_LEASE_S", "5"))
    monkeypatch.setenv("LEASE_S", str(lease))
    with contextlib.ExitStack() as stack:
        names = stack.enter_context(namespaces())
        link = stack.enter_context(module("replay_link", *names))
        assert told(link) == "ready"
        run = stack.enter_context(
            run_of(
                serving=f"tcp/{ADDRESSES[0]}:{PORT}",
                watched=f"tcp/{WATCHED[1]}:{PORT}",
                inside=names,
            )
        )
        run.goes_on(20.0)
        assert connections(run.service) == 3
        order(link, "cut 1")
        assert eventually(lambda: connections(run.service) == 0, 3 * lease + 10.0)
        before = run.counts()
        time.sleep(2.0)
        assert run.counts() == before
        order(link, "cut 0")
        print(f"cut for longer than {lease:g} s: on after {run.goes_on(60.0):.1f} s")
        run.finish()


def resident(*processes: Process) -> int:
    """Bytes of memory."""
    return sum(psutil.Process(process.pid).memory_info().rss for process in processes)


@contextlib.contextmanager
def stalled(process: Process) -> Iterator[None]:
    """SIGSTOP, and SIGCONT at the end."""
    process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        process.send_signal(signal.SIGCONT)


def test_a_reader_a_writer_and_a_service_that_stall() -> None:
    endpoint = free_endpoint()
    with run_of(serving=endpoint, watched=endpoint, inside=("", "")) as run:
        # The reader: inserts stop once nothing more is owed, and nothing grows.
        with stalled(run.reader):
            begun = run.counts()
            time.sleep(3.0)
            held, memory = run.counts(), resident(run.service, *run.writers)
            assert held[0] - begun[0] <= 2 * LOADED.limiter().tolerance + 200
            time.sleep(18.0)  # three times what a query may take
            assert run.counts()[0] == held[0]
            grown = resident(run.service, *run.writers) - memory
            assert grown < 8 << 20
        print(f"reader stalled 21 s: on after {run.goes_on(30.0):.1f} s")
        # A writer: the other one goes on, and the reader with it.
        with stalled(run.writers[0]):
            begun = run.counts()
            time.sleep(QUERY_S + 1.0)
            now = run.counts()
            assert now[0] > begun[0] + 100 and now[1] > begun[1] + 100
        print(f"writer stalled: on after {run.goes_on(30.0):.1f} s")
        with stalled(run.service):
            time.sleep(QUERY_S + 1.0)
        print(f"service stalled: on after {run.goes_on(30.0):.1f} s")
        run.finish()
