"""Feeds broken files to every loader and says what came of it.

    python -m tests.fuzz_loaders --cases 1000 --seed 0

Each case must end, within a limit of time and memory, in a clear one-line `SceneError`
(`BankError` for banks) or in a sound scene: one that passes `check_scene`, that
converts to finite tables (or is refused in one line there) and, for a sample of a
format's scenes, that an environment steps without NaN. A crash, a hang, any other
exception or a NaN is a violation: the program lists those with their seeds and exits
with 1. A case runs in a process of its own kind, which is replaced when it dies.
"""

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests import fuzz_cases, fuzz_stress
from tests.fuzz_checks import Checker, Verdict

CASE_SECONDS = 30.0  # of wall time, on a machine that others use too
BIG_SECONDS = 900.0
CASE_MEMORY = 1e9  # bytes by which a case may raise the process's peak
BIG_MEMORY = 6e9
ADDRESS_SPACE = 12 * 2**30  # bytes more than at the start, so that none takes all

STRESS = "stress"
REAL = "real"


class Task(NamedTuple):
    """One case."""

    format: str
    seed: int
    index: int
    data: str  # folder of real files, "" for none


@dataclass
class Tally:
    """What came of the cases of one format."""

    cases: int = 0
    errors: int = 0
    scenes: int = 0
    refused: int = 0  # sound scenes that are too large to convert
    stepped: int = 0
    slowest: float = 0.0  # s of process time
    slowest_case: str = ""
    violations: list[str] = field(default_factory=list)


def main() -> int:
    """Parses the command line, runs the cases and prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=200, help="of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--formats", nargs="*", default=list(fuzz_cases.MAKERS))
    parser.add_argument("--data", default="", help="a folder of real scenes to break")
    parser.add_argument("--stress", action="store_true", help="large scenes too")
    options = parser.parse_args()
    tallies = fuzz(
        options.formats,
        cases=options.cases,
        seed=options.seed,
        data=options.data,
        stress=list(fuzz_stress.STRESS) if options.stress else (),
    )
    print(f"{'':14} cases errors scenes refused stepped slowest")
    for name, tally in tallies.items():
        print(
            f"{name:14} {tally.cases:5} {tally.errors:6} {tally.scenes:6} "
            f"{tally.refused:7} {tally.stepped:7} {tally.slowest:6.2f}s "
            f"{tally.slowest_case}"
        )
    violations = [line for tally in tallies.values() for line in tally.violations]
    for line in violations:
        print(line)
    print(f"{len(violations)} violations")
    return 1 if violations else 0


def fuzz(
    formats: Sequence[str],
    *,
    cases: int,
    seed: int,
    data: str = "",
    stress: Sequence[str] = (),
    step: bool = True,
) -> dict[str, Tally]:
    """Runs `cases` cases of each format and the large scenes of these names."""
    tallies: dict[str, Tally] = {}
    runner = Runner()
    try:
        for name in [*formats, *([REAL] if data else [])]:
            tasks = [Task(name, seed, index, data) for index in range(cases)]
            tallies[name] = run_tasks(runner, tasks, step)
        for name in stress:
            # Made here, so that the other process's memory is the loader's alone.
            with tempfile.TemporaryDirectory() as folder:
                path = fuzz_stress.STRESS[name](Path(folder))
                task = Task(STRESS, seed, 0, str(path))
                tallies[name] = run_tasks(runner, [task], step)
    finally:
        runner.close()
    return tallies


def run_tasks(runner: "Runner", tasks: list[Task], step: bool) -> Tally:
    """Runs the cases of one format, and an environment on a sample of the scenes."""
    tally = Tally()
    big = tasks[0].format == STRESS if tasks else False
    for task in tasks:
        verdict = runner.run(task, BIG_SECONDS if big else CASE_SECONDS)
        where = f"{task.format} --seed {task.seed} case {task.index} {task.data}"
        tally.cases += 1
        tally.errors += verdict.errors
        tally.scenes += verdict.scenes
        tally.refused += verdict.refused
        tally.violations += [f"{where}: {line}" for line in verdict.violations]
        if verdict.memory > (BIG_MEMORY if big else CASE_MEMORY):
            tally.violations.append(f"{where}: took {verdict.memory / 1e9:.1f} GB")
        if verdict.seconds > tally.slowest:
            tally.slowest = verdict.seconds
            tally.slowest_case = f"case {task.index}"
            if big:
                tally.slowest_case = f"{verdict.memory / 1e9:.2f} GB, {verdict.detail}"
    if step and tally.scenes:
        verdict = runner.run(None, BIG_SECONDS)
        tally.stepped = verdict.scenes
        tally.violations += [f"environment: {line}" for line in verdict.violations]
    return tally


class Runner:
    """Runs cases in another process, which is replaced when it dies or hangs."""

    def __init__(self) -> None:
        """Starts with no process."""
        self._process: Any = None
        self._connection: Any = None

    def run(self, task: Task | None, seconds: float) -> Verdict:
        """What came of one case; None steps an environment on the sample."""
        if self._process is None:
            self._start()
        try:
            self._connection.send(task)
            if self._connection.poll(seconds):
                return self._connection.recv()
            problem = f"no end after {seconds:.0f} s"
        except (EOFError, OSError):
            self._process.join(5)
            problem = f"the process died with {self._process.exitcode}"
        self.close()
        return Verdict(violations=[problem])

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other,), daemon=True)
        self._process.start()
        other.close()
        if not self._connection.poll(120):
            raise RuntimeError("the process that runs the cases does not start")
        self._connection.recv()

    def close(self) -> None:
        """Ends the process, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._connection.close()
            self._process = None


def serve(connection: Connection) -> None:
    """Runs cases for another process until that goes away."""
    # Broken frames may claim any size: better refused here than taken from others.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = used + ADDRESS_SPACE
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    checker = Checker()
    connection.send("ready")
    while True:
        try:
            task: Task | None = connection.recv()
        except EOFError:
            return
        peak, begun = peak_memory(), time.process_time()
        try:
            verdict = checker.step() if task is None else run_case(checker, task)
        except BaseException as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            verdict = Verdict(
                violations=[
                    f"{type(error).__name__}: {str(error)[:300]!r} at "
                    f"{Path(place.filename).name}:{place.lineno}"
                ]
            )
        verdict.seconds = time.process_time() - begun
        verdict.memory = peak_memory() - peak
        connection.send(verdict)


def peak_memory() -> float:
    """The most that this process has held at a time, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0


def run_case(checker: Checker, task: Task) -> Verdict:
    """Makes the case's files and checks what the loader makes of them."""
    if task.format == STRESS:
        return checker.check_large(Path(task.data))
    number = [*fuzz_cases.MAKERS, REAL].index(task.format)
    rng = np.random.default_rng([task.seed, number, task.index])
    with tempfile.TemporaryDirectory() as name:
        if task.format == REAL:
            path = fuzz_cases.real(rng, Path(name), Path(task.data))
        else:
            path = fuzz_cases.MAKERS[task.format](rng, Path(name))
        return checker.check(path, is_bank=task.format == "bank")


if __name__ == "__main__":
    sys.exit(main())
