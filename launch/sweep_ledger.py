"""The sweep's ledger: which points of the grid were run, in Optuna's tables.

`RUN/sweep.db` is an ordinary Optuna study (SQLite): a trial is one run of a point of
the grid, waiting, running, complete with its failure rate, or failed. Optuna's own
tools read it.

The grid is put into the study's queue when it is made, in place of `GridSampler`: that
takes a failed trial for a visited point, and hands a point that is being run to a
second worker when no other is left. Nor are heartbeats and the retry callback (which
Optuna 5 deprecates) needed to find what a killed sweep left running: one sweep at a
time has the folder (`lock`), so whatever is running when it begins is dead, and is
queued again without waiting for a heartbeat to be missed.
"""

import fcntl
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from launch.errors import LaunchError

try:
    import optuna
    from optuna.storages import RDBStorage
    from optuna.trial import FrozenTrial, TrialState
except ImportError as error:
    raise LaunchError(
        "a sweep needs optuna: pip install 'slipstream[sweep]'"
    ) from error

LEDGER: Final = "sweep.db"
LOCK: Final = ".lock"
POINT: Final = "point"  # a trial's attribute: the index in the grid
STUDY: Final = "sweep"


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of the grid."""

    algorithm: str  # bc or dqn
    space: str
    learning_rate: float  # 0: the preset's
    held_out: int = -1  # the scene that is, where each is in turn; -1: a bank of them

    @property
    def name(self) -> str:
        """Names its folder."""
        rate = f"-{self.learning_rate:g}" if self.learning_rate else ""
        turn = f"-without-{self.held_out}" if self.held_out >= 0 else ""
        return f"{self.algorithm}-{self.space}{rate}{turn}"


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Holds the folder; it is let go of when the process ends, however it does."""
    descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise LaunchError(f"{folder}: another sweep is at work there") from None
    try:
        yield
    finally:
        os.close(descriptor)


@final
class Ledger:
    """The study; belongs to whoever holds the lock, and to one thread."""

    def __init__(self, folder: Path, points: Sequence[Point]) -> None:
        """Takes up the study: what was running is dead, and waits again."""
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._points = tuple(points)
        self._study = optuna.create_study(
            storage=RDBStorage(f"sqlite:///{folder.resolve() / LEDGER}"),
            study_name=STUDY,
            direction="minimize",
            load_if_exists=True,
        )
        self._trials: dict[int, optuna.Trial] = {}  # running, by point
        for trial in self._of(TrialState.RUNNING):
            self._study.tell(trial.number, state=TrialState.FAIL)
        self._queue_missing()

    def _queue_missing(self) -> None:
        """Every point is queued that was never run, or whose runs have all failed."""
        waiting = self._of(TrialState.WAITING, TrialState.COMPLETE)
        known = {trial.user_attrs[POINT] for trial in waiting}
        for index in range(len(self._points)):
            if index not in known:
                self._queue(index)

    def _queue(self, index: int) -> None:
        self._study.enqueue_trial(
            _params(self._points[index]), user_attrs={POINT: index}
        )

    def _of(self, *states: TrialState) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=states)

    @property
    def complete(self) -> dict[int, float]:
        """Failure rates of the points that have one."""
        return {
            trial.user_attrs[POINT]: trial.values[0]
            for trial in self._of(TrialState.COMPLETE)
        }

    def take(self) -> int | None:
        """The next point to run, which is running now; None: none waits."""
        if not self._of(TrialState.WAITING):
            return None
        trial = self._study.ask()
        index = int(trial.user_attrs[POINT])
        every = [_params(point) for point in self._points]
        for name in every[index]:
            # What is queued is taken; the choices are for those who read the study.
            choices = dict.fromkeys(params[name] for params in every)
            trial.suggest_categorical(name, list(choices))
        self._trials[index] = trial
        return index

    def finish(self, index: int, failure_rate: float) -> None:
        """The point's run is complete."""
        self._study.tell(self._trials.pop(index), failure_rate)

    def fail(self, index: int, reason: str, *, again: bool) -> None:
        """The point's run failed; `again` queues it once more."""
        trial = self._trials.pop(index)
        trial.set_user_attr("reason", reason)
        self._study.tell(trial, state=TrialState.FAIL)
        if again:
            self._queue(index)


def _params(point: Point) -> dict[str, str | float]:
    return {
        "algorithm": point.algorithm,
        "space": point.space,
        "learning_rate": point.learning_rate,
        "held_out": point.held_out,
    }
