"""Starts the roles of a run as processes, restarts them, and leaves none behind.

Each role is the leader of a session of its own, so a signal reaches its whole group
and a terminal's Ctrl-C reaches the supervisor alone. How a role's end is taken:

    exit code 0 of a role that finishes the run   the run is over, and well
    exit code 2 (a user's mistake)                the run fails, quoting the last line
    any other end of a critical role              the run fails
    any other end of another role                 it is started again, after a delay
                                                  that doubles while it keeps failing

Stopping is SIGTERM to every group, then SIGKILL after `grace_s`. Two things hold
when the supervisor itself is killed: the kernel kills each role (PR_SET_PDEATHSIG),
and a reaper process, which sees the end of its standard input, kills what the roles
have started. A killed reaper leaves the first.
"""

import asyncio
import contextlib
import ctypes
import enum
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

_PR_SET_PDEATHSIG: Final = 1
_REAPER: Final = """
import os, signal, sys
groups = set()
for line in sys.stdin:
    (groups.add if line[0] == "+" else groups.discard)(int(line[1:]))
for group in groups:
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        pass
"""
USER_ERROR: Final = 2
"""The exit code of a role that was started with something it cannot use."""


class Outcome(enum.Enum):
    """How a run ended."""

    FINISHED = "finished"
    FAILED = "failed"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class Result:
    """How a run ended, and the one line that says why."""

    outcome: Outcome
    reason: str


@dataclass(frozen=True, kw_only=True)
class Role:
    """One process of a run."""

    name: str  # also the name of its log
    command: tuple[str, ...]
    critical: bool = False  # its failure is the run's; others are started again
    finishes: bool = False  # its exit code 0 ends the run
    port: int = 0  # the next role is started once this port of loopback answers


@final
class Supervisor:
    """Runs roles until one finishes or fails the run, or `stop` is called."""

    def __init__(
        self,
        *,
        roles: Sequence[Role],
        log_folder: Path,
        grace_s: float = 10.0,
        backoff_s: float = 0.5,
        max_failures: int = 6,
        on_event: Callable[[str], None] = print,
        before_stop: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        """Takes the roles in the order in which they start.

        `before_stop` is awaited when a run has finished, all other roles still up.
        A role that fails `max_failures` times in a row, each within a minute of its
        start, fails the run: starting it once more would not cure it.
        """
        self._roles = tuple(roles)
        self._log_folder = log_folder
        self._grace_s = grace_s
        self._backoff_s = backoff_s
        self._max_failures = max_failures
        self._on_event = on_event
        self._before_stop = before_stop
        self._processes: dict[str, asyncio.subprocess.Process] = {}
        self._keepers: list[asyncio.Task[None]] = []
        self._reaper: asyncio.subprocess.Process | None = None
        self._result: Result | None = None
        self._over = asyncio.Event()
        self._hurry = asyncio.Event()  # a second Ctrl-C
        self.restarts: dict[str, int] = {role.name: 0 for role in self._roles}

    @property
    def pids(self) -> dict[str, int]:
        """The processes that run now, by role."""
        return {name: process.pid for name, process in self._processes.items()}

    def stop(self, result: Result) -> None:
        """Ends the run; the first call decides how."""
        if self._result is None:
            self._result = result
            self._over.set()

    async def run(self) -> Result:
        """Starts every role, waits for the run's end, and stops every role."""
        self._log_folder.mkdir(parents=True, exist_ok=True)
        self._reaper = await asyncio.create_subprocess_exec(
            *(sys.executable, "-I", "-S", "-c", _REAPER),
            stdin=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        with self._signals():
            starter = asyncio.create_task(self._start_all())
            try:
                await self._over.wait()
                assert self._result is not None
                if self._result.outcome is Outcome.FINISHED and self._before_stop:
                    await self._before_stop()
            finally:
                starter.cancel()
                await self._stop_all()
        return self._result

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        """Ctrl-C, a termination or a closed terminal end the run."""
        loop = asyncio.get_running_loop()
        numbers = [
            number
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
            # `nohup` has its hang-ups ignored, and a shell's background job its ^C.
            if signal.getsignal(number) is not signal.SIG_IGN
        ]
        for number in numbers:
            loop.add_signal_handler(number, self._interrupt)
        try:
            yield
        finally:
            for number in numbers:
                loop.remove_signal_handler(number)

    def _interrupt(self) -> None:
        if self._over.is_set():
            self._hurry.set()
        self.stop(Result(Outcome.INTERRUPTED, "interrupted"))

    async def _start_all(self) -> None:
        for role in self._roles:
            self._keepers.append(asyncio.create_task(self._keep(role)))
            while role.port and not await _answers(role.port):
                await asyncio.sleep(0.02)

    async def _keep(self, role: Role) -> None:
        """Runs a role, again and again if it may be, until the run is over."""
        failures = 0
        while True:
            started = time.monotonic()
            code = await self._run_once(role)
            if code == 0 and role.finishes:
                return self.stop(Result(Outcome.FINISHED, f"{role.name} finished"))
            failures = failures + 1 if time.monotonic() - started < 60 else 1
            ended = f"{role.name} {_describe(code)}"
            if role.critical or code == USER_ERROR or failures >= self._max_failures:
                return self.stop(Result(Outcome.FAILED, f"{ended}: {self._last(role)}"))
            delay = min(self._backoff_s * 2 ** (failures - 1), 30.0)
            self._on_event(f"{ended}; starting it again in {delay:.1f} s")
            await asyncio.sleep(delay)
            self.restarts[role.name] += 1

    async def _run_once(self, role: Role) -> int:
        with (self._log_folder / f"{role.name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *role.command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=die_with_parent(),
            )
        self._processes[role.name] = process
        self._tell_reaper(f"+{process.pid}")
        code = await process.wait()
        del self._processes[role.name]
        signal_group(process.pid, signal.SIGKILL)  # what it may have left
        self._tell_reaper(f"-{process.pid}")
        return code

    async def _stop_all(self) -> None:
        """SIGTERM to all, then SIGKILL to what remains."""
        for task in self._keepers:
            task.cancel()
        await asyncio.gather(*self._keepers, return_exceptions=True)
        waits = [asyncio.create_task(p.wait()) for p in self._processes.values()]
        for process in self._processes.values():
            signal_group(process.pid, signal.SIGTERM)
        ended = asyncio.gather(*waits)
        hurry = asyncio.create_task(self._hurry.wait())
        either: list[asyncio.Future[Any]] = [ended, hurry]
        await asyncio.wait(
            either, timeout=self._grace_s, return_when=asyncio.FIRST_COMPLETED
        )
        hurry.cancel()
        for name, process in self._processes.items():
            if process.returncode is None:
                self._on_event(f"{name} did not end when asked to: killed")
            signal_group(process.pid, signal.SIGKILL)
        await ended
        self._processes.clear()
        assert self._reaper is not None and self._reaper.stdin is not None
        # Its groups have ended; one whose number is in use again must not be hit.
        with contextlib.suppress(ProcessLookupError):
            self._reaper.kill()
        await self._reaper.wait()

    def _tell_reaper(self, line: str) -> None:
        assert self._reaper is not None and self._reaper.stdin is not None
        if not self._reaper.stdin.is_closing():
            self._reaper.stdin.write(f"{line}\n".encode())

    def _last(self, role: Role) -> str:
        """The last line that a role wrote, and where the others are."""
        log = self._log_folder / f"{role.name}.log"
        lines = log.read_text(errors="replace").split("\n")[-200:]
        last = next((line for line in reversed(lines) if line.strip()), "no message")
        return f"{last.strip()} (log: {log})"


def _describe(code: int) -> str:
    """An exit code in words."""
    if code >= 0:
        return f"ended with exit code {code}"
    return f"was ended by {signal.Signals(-code).name}"


def signal_group(group: int, number: signal.Signals) -> None:
    """Signals a process group that may be gone."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(group, number)


async def _answers(port: int) -> bool:
    """Whether something listens on a port of loopback."""
    try:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        return False
    writer.close()
    return True


_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


def die_with_parent() -> Callable[[], None]:
    """A `preexec_fn`: the child is killed when the process that calls this ends."""
    parent = os.getpid()

    def prepare() -> None:
        if _prctl is not None:
            _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it ended before the line above
            os._exit(1)

    return prepare
