"""`slipstream sweep`: the paper's grid, a training run for each of its points.

    RUN/sweep.json           what is swept                   sweep.db   the ledger
        scenes/*.bank        the scenes of all runs          logs/*.log
        scenes/without-N/    with `rotate`: of the turns
        trials/NAME/         a run as `slipstream train` makes it
        baselines.json       the benchmark's agents on the held-out scenes
        table.md, .json      the table                       curves.png

With `rotate` each recorded scene is held out in turn and every point is trained once on
all others; its figures are those of all turns together. No checkpoint is chosen there:
the scene that is held out would choose it.

The grid is the paper's (appendix A.2, the agents of its Table 3): behaviour cloning at
three learning rates in four action spaces, double DQN in the two discrete ones. What
follows `--` on the command line is given to each run.

A point's run is a process group of its own that ends with the sweep. The same command
again goes on: finished points are not run again, one that was killed goes on from its
newest checkpoint. A run that fails is started again `RETRIES` times; a mistake of the
user's (exit code 2), which all would share, ends the sweep.
"""

import asyncio
import contextlib
import json
import os
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, final

from launch.budget import ScenesConfig
from launch.config import CLONING_PRESETS, PRESETS, write_atomically
from launch.converting import say
from launch.errors import INTERRUPTED, USER_ERROR, LaunchError
from launch.supervisor import die_with_parent, signal_group
from launch.sweep_ledger import Ledger, Point, lock
from launch.sweep_results import read_evaluation
from launch.sweep_scenes import banks_of, make_rotation, make_scenes
from launch.sweep_table import baselines_of, write_table

SWEEP: Final = "sweep.json"
TRIALS: Final = "trials"
BASELINES: Final = "baselines.json"
RETRIES: Final = 1
GRACE_S: Final = 30.0  # for a run that was asked to end
GRIDS: Final = {"bc": ("bc",), "dqn": ("dqn",), "all": ("bc", "dqn")}
SPACES: Final = {
    "bc": ("bicycle", "delta", "bicycle-discrete", "delta-discrete"),
    "dqn": ("bicycle-discrete", "delta-discrete"),
}
LAUNCH: Final = (sys.executable, "-m", "launch")


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """Runs the paper's grid and tells the results in its table."""

    run: Path
    """The sweep's folder; the same command again goes on with it."""
    preset: str = "quick"
    """Of every run."""
    scenes: tuple[str, ...] = ("procedural",)
    """Of every run: as for train."""
    spaces: tuple[str, ...] = ()
    """Only these action spaces; all unless given."""
    learning_rates: tuple[float, ...] = (3e-5, 1e-4, 3e-4)
    """Of behaviour cloning; DQN's is the preset's."""
    seed: int = 0
    """Of every run."""
    train_scenes: int = 0
    """Procedural scenes to train on; 0 is the preset's number."""
    held_out_scenes: int = 0
    """Procedural scenes to evaluate on; 0 is the preset's number."""
    rotate: bool = False
    """Holds out each of the recorded scenes in turn, and trains on all others."""
    jobs: int = 1
    """Runs at a time; each has several processes, and they share the cores."""


def sweep_command(grid: str, options: SweepConfig, passed_on: Sequence[str]) -> int:
    """`slipstream sweep bc|dqn|all`; the exit code."""
    points = points_of(grid, options)
    folder = options.run
    _settle(folder, grid, options, passed_on)
    with lock(folder):
        if options.rotate:
            scenes = range(make_rotation(folder, options.scenes))
            points = [replace(point, held_out=n) for point in points for n in scenes]
        else:
            make_scenes(folder, options.scenes, _scenes_of(grid, options))
        return run_sweep(
            folder=folder,
            points=points,
            options=options,
            passed_on=tuple(passed_on),
            launch=LAUNCH,
            command=command_of(grid, options, passed_on),
        )


def command_of(grid: str, options: SweepConfig, passed_on: Sequence[str]) -> str:
    """The command of a sweep, its settings in the order of their definition."""
    words = ["slipstream", "sweep", grid]
    for field in fields(options):
        value = getattr(options, field.name)
        if value == field.default:
            continue
        words.append(f"--{field.name.replace('_', '-')}")
        if value is not True:
            words += map(str, value if isinstance(value, tuple) else [value])
    return shlex.join([*words, *(["--", *passed_on] if passed_on else [])])


def points_of(grid: str, options: SweepConfig) -> list[Point]:
    """The grid's points, or the reason why it is none."""
    algorithms = GRIDS[grid]
    presets = {"bc": CLONING_PRESETS, "dqn": PRESETS}
    for algorithm in algorithms:
        if options.preset not in presets[algorithm]:
            known = ", ".join(presets[algorithm])
            raise LaunchError(
                f"--preset {options.preset}: train {algorithm} has {known}"
            )
    every = [space for algorithm in algorithms for space in SPACES[algorithm]]
    for space in options.spaces:
        if space not in every:
            known = ", ".join(dict.fromkeys(every))
            raise LaunchError(f"--spaces {space}: not in the grid; choose of {known}")
    rates = options.learning_rates
    if not rates or min(rates) <= 0 or len(set(rates)) < len(rates):
        raise LaunchError("--learning-rates: name some above 0, each once")
    if options.jobs < 1:
        raise LaunchError(f"--jobs {options.jobs} must be at least 1")
    return [
        Point(algorithm=algorithm, space=space, learning_rate=rate)
        for algorithm in algorithms
        for space in SPACES[algorithm]
        if space in (options.spaces or every)
        for rate in (rates if algorithm == "bc" else (0.0,))
    ]


def _scenes_of(grid: str, options: SweepConfig) -> ScenesConfig:
    """How many procedural scenes; the same for both algorithms."""
    preset = (CLONING_PRESETS if "bc" in GRIDS[grid] else PRESETS)[options.preset]
    config = preset().scenes
    return replace(
        config,
        train=options.train_scenes or config.train,
        held_out=options.held_out_scenes or config.held_out,
    )


def _settle(
    folder: Path, grid: str, options: SweepConfig, passed_on: Sequence[str]
) -> None:
    """Writes down what is swept, or checks that it is what the folder was made for."""
    wanted: dict[str, Any] = json.loads(
        json.dumps(
            {"grid": grid, **asdict(options), "passed_on": passed_on}, default=str
        )
    )
    for unimportant in ("run", "jobs"):
        del wanted[unimportant]
    path = folder / SWEEP
    if path.exists():
        try:
            found = json.loads(path.read_text())
        except ValueError as error:
            raise LaunchError(f"{path}: cannot be read ({error})") from error
        differs = sorted(
            name
            for name in wanted.keys() | found.keys()
            if wanted.get(name) != found.get(name)
        )
        if differs:
            name = differs[0]
            raise LaunchError(
                f"{folder}: holds another sweep ({name} {found.get(name)}, now "
                f"{wanted.get(name)}); choose another --run"
            )
        return
    if folder.exists() and any(folder.iterdir()):
        raise LaunchError(f"{folder}: is not empty and holds no sweep; choose another")
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(wanted, indent=1) + "\n").encode())


def run_sweep(
    *,
    folder: Path,
    points: Sequence[Point],
    options: SweepConfig,
    passed_on: tuple[str, ...],
    launch: tuple[str, ...],
    command: str,
) -> int:
    """Runs what is left of the grid, then makes the table; the exit code.

    `command` is what the user typed, for the table.
    """
    sweep = Sweep(
        folder=folder,
        points=points,
        options=options,
        passed_on=passed_on,
        launch=launch,
    )
    if not asyncio.run(sweep.run()):
        say(f"interrupted; the same command goes on with {folder}")
        return INTERRUPTED
    write_table(
        folder,
        points,
        sweep.folders,
        baselines_of(folder / BASELINES),
        command,
    )
    return 0


@final
class Sweep:
    """The runs of a sweep: a few at a time, each a process group."""

    def __init__(
        self,
        *,
        folder: Path,
        points: Sequence[Point],
        options: SweepConfig,
        passed_on: tuple[str, ...],
        launch: tuple[str, ...],
    ) -> None:
        """`launch` is how the command line is called."""
        self._folder = folder
        self._points = points
        self._options = options
        self._passed_on = passed_on
        self._launch = launch
        self._ledger = Ledger(folder, points)
        self._failures = [0] * len(points)
        self._alive: set[asyncio.subprocess.Process] = set()
        self._stop = asyncio.Event()
        self.folders = [folder / TRIALS / point.name for point in points]
        """Each point's run."""

    async def run(self) -> bool:
        """Runs everything that is left; False if a person ended it before."""
        (self._folder / TRIALS).mkdir(exist_ok=True)
        (self._folder / "logs").mkdir(exist_ok=True)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, self._stop.set)
        stopped = asyncio.create_task(self._stop.wait())
        workers = [asyncio.create_task(self._work()) for _ in range(self._options.jobs)]
        finished = asyncio.gather(*workers)
        try:
            either: list[asyncio.Future[Any]] = [stopped, finished]
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if self._stop.is_set():
                return False
            await finished  # raises what a worker raised
            return not await self._baselines()
        finally:
            for task in (stopped, *workers):
                task.cancel()
            await self._end_all()
            await asyncio.gather(stopped, finished, return_exceptions=True)

    async def _work(self) -> None:
        """Takes points until none waits."""
        while (index := self._ledger.take()) is not None:
            await self._run_point(index)

    async def _run_point(self, index: int) -> None:
        point, folder = self._points[index], self.folders[index]
        began = time.monotonic()
        found = read_evaluation(folder)
        if found is None:
            say(f"{point.name}: begins ({len(self._ledger.complete)} are complete)")
            code = await self._call(self._training(point, folder), point.name)
            found = read_evaluation(folder) if code == 0 else None
            if code == USER_ERROR:
                raise LaunchError(f"{point.name}: {self._last_line(point.name)}")
            if found is None:
                return self._failed(index, f"exit code {code}")
        trained = found["trained"]
        self._ledger.finish(index, float(trained["failure_rate"]))
        say(
            f"{point.name}: failures {trained['failure_rate']:.1%}, log ADE "
            f"{trained['log_displacement']:.2f} m "
            f"({(time.monotonic() - began) / 60:.1f} min)"
        )

    def _failed(self, index: int, why: str) -> None:
        self._failures[index] += 1
        name = self._points[index].name
        again = self._failures[index] <= RETRIES
        reason = f"{why}: {self._last_line(name)}"
        self._ledger.fail(index, reason, again=again)
        say(f"{name}: {reason}{'; is started again' if again else '; left out'}")

    def _training(self, point: Point, folder: Path) -> list[str]:
        """The command of a point's run; it goes on where there is a checkpoint."""
        train, held_out = banks_of(self._folder, point.held_out)
        words = ["train", point.algorithm, "--preset", self._options.preset]
        if point.algorithm == "bc":
            words += ["--space", point.space]
            words += ["--cloning.learning-rate", f"{point.learning_rate:g}"]
            words += ["--cloning.torch-threads", str(self._threads())]
        else:
            name = point.space.removesuffix("-discrete").upper()
            words += ["--environment.action.space", name]
        words += ["--scenes", str(train), str(held_out), "--run", str(folder)]
        if point.held_out >= 0:
            words += ["--evaluator.scenes", "0"]
        words += ["--seed", str(self._options.seed), *self._passed_on]
        if (folder / "config.json").exists():
            words.append("--resume")
        else:
            shutil.rmtree(folder, ignore_errors=True)  # it was killed on its first step
        return words

    def _threads(self) -> int:
        """Of a cloning learner: the preset's, unless its neighbours need the cores.

        Two learners of two threads each on two cores wait for one another's threads.
        """
        wanted = CLONING_PRESETS[self._options.preset]().cloning.torch_threads
        share = len(os.sched_getaffinity(0)) // self._options.jobs
        return max(1, min(wanted, share))

    async def _call(self, words: list[str], name: str) -> int:
        """Runs a command to its end; its output goes to its log."""
        with (self._folder / "logs" / f"{name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *(*self._launch, *words),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=die_with_parent(),
            )
        self._alive.add(process)
        code = await process.wait()
        self._alive.discard(process)
        signal_group(process.pid, signal.SIGKILL)  # what it may have left
        return code

    async def _baselines(self) -> bool:
        """The benchmark's agents on the same scenes, once; True if interrupted."""
        path = self._folder / BASELINES
        if path.exists():
            return False
        agents = ["expert", "expert-delta", "expert-bicycle-discrete"]
        agents += ["expert-delta-discrete", "idm", "constant-speed", "random"]
        held_out = str(banks_of(self._folder)[1])
        words = ["evaluate", "--scenes", held_out, "--json", str(path), "--agent"]
        call = asyncio.create_task(self._call([*words, *agents], "baselines"))
        stopped = asyncio.create_task(self._stop.wait())
        await asyncio.wait([call, stopped], return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        if self._stop.is_set():
            call.cancel()
            return True
        if await call:
            raise LaunchError(f"baselines: {self._last_line('baselines')}")
        return False

    async def _end_all(self) -> None:
        """SIGTERM to every run, then SIGKILL to what remains."""
        alive = list(self._alive)
        for process in alive:
            signal_group(process.pid, signal.SIGTERM)
        waits = asyncio.gather(*(process.wait() for process in alive))
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(asyncio.shield(waits), GRACE_S)
        for process in alive:
            signal_group(process.pid, signal.SIGKILL)
        await waits

    def _last_line(self, name: str) -> str:
        path = self._folder / "logs" / f"{name}.log"
        lines = path.read_text(errors="replace").split("\n")[-200:]
        last = next((line for line in reversed(lines) if line.strip()), "no message")
        return f"{last.strip()} (log: {path})"
