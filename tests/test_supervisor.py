"""The supervisor against real processes, real signals and a real kill -9."""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from launch.supervisor import Outcome, Result, Role, Supervisor

ROOT = Path(__file__).resolve().parent.parent
PATIENCE_S = 20.0


def python(code: str) -> tuple[str, ...]:
    """A role's command that runs a few lines."""
    return (sys.executable, "-S", "-u", "-c", textwrap.dedent(code))


SLEEPER = python("import time; time.sleep(600)")
STUBBORN = python(
    """
    import signal, subprocess, sys, time
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
    print("ready", flush=True)
    time.sleep(600)
    """
)


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Waits for a condition; fails where it does not come."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.01)


async def until(condition: Callable[[], bool], what: str) -> None:
    """Like `wait_for`, beside a supervisor."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        await asyncio.sleep(0.01)


def alive(pid: int) -> bool:
    """Whether a process runs (a zombie does not)."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


def supervise(roles: list[Role], logs: Path, **settings: float) -> Result:
    """Runs roles to the end of the run."""

    async def main() -> Result:
        supervisor = Supervisor(
            roles=roles, log_folder=logs, on_event=lambda _: None, **settings
        )
        return await asyncio.wait_for(supervisor.run(), PATIENCE_S)

    return asyncio.run(main())


def test_a_killed_role_comes_back(tmp_path: Path) -> None:
    async def main() -> None:
        events: list[str] = []
        supervisor = Supervisor(
            roles=[Role(name="actor", command=SLEEPER)],
            log_folder=tmp_path,
            backoff_s=0.01,
            on_event=events.append,
        )
        running = asyncio.create_task(supervisor.run())
        await until(lambda: "actor" in supervisor.pids, "a start")
        first = supervisor.pids["actor"]
        os.kill(first, signal.SIGKILL)
        await until(
            lambda: supervisor.pids.get("actor", first) != first, "a second start"
        )
        second = supervisor.pids["actor"]
        assert supervisor.restarts == {"actor": 1}
        assert alive(second)
        assert "SIGKILL" in events[0]
        supervisor.stop(Result(Outcome.FINISHED, "seen enough"))
        assert (await running).outcome is Outcome.FINISHED
        assert not alive(second)

    asyncio.run(main())


def test_a_critical_role_ends_the_run(tmp_path: Path) -> None:
    failing = python("print('the table is gone'); raise SystemExit(3)")
    result = supervise(
        [
            Role(name="actor", command=SLEEPER),
            Role(name="replay", command=failing, critical=True),
        ],
        tmp_path,
    )
    assert result.outcome is Outcome.FAILED
    assert result.reason.startswith("replay ended with exit code 3: the table is gone")
    assert (tmp_path / "replay.log").read_text() == "the table is gone\n"  # once


def test_a_users_mistake_is_not_repeated(tmp_path: Path) -> None:
    role = Role(name="actor", command=python("raise SystemExit(2)"))
    result = supervise([role], tmp_path)
    assert result.outcome is Outcome.FAILED
    assert "exit code 2" in result.reason


def test_a_role_that_always_fails_ends_the_run(tmp_path: Path) -> None:
    role = Role(name="actor", command=python("print('x'); raise SystemExit(1)"))
    result = supervise([role], tmp_path, backoff_s=0.001, max_failures=3)
    assert result.outcome is Outcome.FAILED
    assert (tmp_path / "actor.log").read_text() == "x\n" * 3


def test_the_finishing_role_ends_the_run(tmp_path: Path) -> None:
    result = supervise(
        [
            Role(name="replay", command=SLEEPER, critical=True),
            Role(name="learner", command=python("print('all')"), finishes=True),
        ],
        tmp_path,
    )
    assert result == Result(Outcome.FINISHED, "learner finished")
    assert (tmp_path / "learner.log").read_text() == "all\n"


def test_the_next_role_waits_for_the_port(tmp_path: Path) -> None:
    """The learner connects at its first try, so the service was there before."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    service = f"""
        import socket, time
        time.sleep(0.3)
        server = socket.create_server(("127.0.0.1", {port}))
        while True: server.accept()
        """
    client = f'import socket; socket.create_connection(("127.0.0.1", {port}), 1)'
    result = supervise(
        [
            Role(name="replay", command=python(service), critical=True, port=port),
            Role(name="learner", command=python(client), critical=True, finishes=True),
        ],
        tmp_path,
    )
    assert result.outcome is Outcome.FINISHED


def test_what_ignores_a_request_is_killed_with_its_children(tmp_path: Path) -> None:
    async def main() -> None:
        supervisor = Supervisor(
            roles=[Role(name="viewer", command=STUBBORN)],
            log_folder=tmp_path,
            grace_s=0.1,
            on_event=lambda _: None,
        )
        running = asyncio.create_task(supervisor.run())
        log = tmp_path / "viewer.log"
        await until(lambda: log.exists() and log.read_text() != "", "its first line")
        tree = psutil.Process(supervisor.pids["viewer"])
        pids = [tree.pid, *(child.pid for child in tree.children(recursive=True))]
        assert len(pids) == 2
        supervisor.stop(Result(Outcome.FINISHED, ""))
        await running
        await until(lambda: not any(map(alive, pids)), "their end")

    asyncio.run(main())


HOST = f"""
import asyncio, json, signal, sys
from pathlib import Path
# What a shell's background job or nohup ignores, its children ignore too.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
sys.path.insert(0, {str(ROOT)!r})
from launch.supervisor import Role, Supervisor

async def main():
    folder, stubborn = Path(sys.argv[1]), json.loads(sys.argv[2])
    roles = [Role(name=f"role{{i}}", command=tuple(stubborn)) for i in range(3)]
    supervisor = Supervisor(
        roles=roles, log_folder=folder, grace_s=float(sys.argv[3])
    )
    result = await supervisor.run()
    print(result.outcome.value)

asyncio.run(main())
"""


@contextlib.contextmanager
def hosted(folder: Path, grace_s: float) -> Iterator[tuple[psutil.Process, list[int]]]:
    """A supervisor in a process, its three roles and their three children up."""
    process = psutil.Popen(
        [sys.executable, "-c", HOST, str(folder), json.dumps(STUBBORN), str(grace_s)],
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    logs = [folder / f"role{index}.log" for index in range(3)]
    try:
        wait_for(
            lambda: all(log.exists() and "ready" in log.read_text() for log in logs),
            "the roles",
        )
        # Three roles, three children of theirs and the reaper.
        pids = [child.pid for child in process.children(recursive=True)]
        assert len(pids) == 7
        yield process, pids
    finally:
        for pid in (process.pid, *psutil.pids()):
            if pid in {process.pid, *pids} and alive(pid):
                os.kill(pid, signal.SIGKILL)
        process.wait()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    with hosted(tmp_path, grace_s=0.2) as (host, pids):
        host.send_signal(number)
        assert host.communicate(timeout=PATIENCE_S)[0].strip().endswith(b"interrupted")
        wait_for(lambda: not any(map(alive, pids)), "the end of all")


def test_a_second_interrupt_does_not_wait(tmp_path: Path) -> None:
    with hosted(tmp_path, grace_s=600.0) as (host, pids):
        host.send_signal(signal.SIGINT)
        # The roles ignore SIGTERM; only the second Ctrl-C can end this in time.
        with pytest.raises(psutil.TimeoutExpired):
            host.wait(timeout=0.5)
        host.send_signal(signal.SIGINT)
        host.wait(timeout=PATIENCE_S)
        wait_for(lambda: not any(map(alive, pids)), "the end of all")


def test_a_killed_supervisor_leaves_nothing(tmp_path: Path) -> None:
    with hosted(tmp_path, grace_s=600.0) as (host, pids):
        host.kill()
        host.wait(timeout=PATIENCE_S)
        wait_for(lambda: not any(map(alive, pids)), "the end of all")
