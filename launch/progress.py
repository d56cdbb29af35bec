"""How far a learner of either kind is: what it says, writes down and goes on from.

RUN/curves.csv           averages over the updates since the row before
    checkpoints/         the newest
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import msgspec
import numpy as np

from launch.config import ExperimentConfig
from launch.status import STATUS_S
from learner.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint
from learner.cloning import CloneStep, CloningLearner, CloningResult
from learner.curves import CurvesWriter
from learner.learner import Learner, LearnStep

CHECKPOINTS: Final = "checkpoints"
CURVES: Final = "curves.csv"
TENSORBOARD: Final = "tensorboard"
COLUMNS: Final[tuple[str, ...]] = (
    "loss",
    "mean_q",
    "max_q",
    "failure_rate",
    "return",
    "progress",
    "inserts",
    "samples_per_insert",
    "updates_per_s",
    "waited_share",
    "seconds",
)
CLONING_COLUMNS: Final[tuple[str, ...]] = (
    "loss",
    "updates_per_s",
    "waited_share",
    "rendered_share",
    "seconds",
)

Step = LearnStep | CloneStep


def checkpoint_extra(
    config: ExperimentConfig, elapsed_s: float, replay: Mapping[str, int]
) -> dict[str, Any]:
    """What is kept beside the weights.

    Enough to act by them, the time spent, and what the replay had on the disk.
    """
    builtins: dict[str, Any] = msgspec.to_builtins(config)
    return {"config": builtins, "elapsed_s": elapsed_s, "replay": dict(replay)}


@dataclass(frozen=True)
class _Sums:
    """What the updates so far cost, in seconds of this process."""

    updates: int = 0
    waited_s: float = 0.0  # for rows
    rendered_s: float = 0.0  # rows to observations
    updated_s: float = 0.0  # the updates themselves

    def plus(self, step: Step) -> "_Sums":
        """With one more update."""
        return _Sums(
            self.updates + 1,
            self.waited_s + step.waited_s,
            self.rendered_s + step.rendered_s,
            self.updated_s + step.updated_s,
        )


@final
class Progress:
    """How far a learner is: what it cost, and the averages since the last report."""

    def __init__(self, elapsed_s: float) -> None:
        """`elapsed_s` was spent before this process began."""
        self._before_s = elapsed_s
        self._began: float | None = None
        self._last: Step | None = None
        self._losses: list[float] = []
        self._sums = _Sums()
        self._reported, self._reported_at = _Sums(), time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Since the first update, over all restarts."""
        running = 0.0 if self._began is None else time.monotonic() - self._began
        return self._before_s + running

    def add(self, step: Step) -> None:
        """Counts one update."""
        if self._began is None:
            # Waiting for the replay to fill is no part of the budget, nor compiling.
            self._began = self._reported_at = time.monotonic()
            return
        self._sums = self._sums.plus(step)
        self._losses.append(step.result.loss)
        self._last = step

    def totals(self) -> dict[str, float]:
        """What this process has spent its time on since its first update."""
        spent = self.elapsed_s - self._before_s
        return {
            "updating_s": spent,
            "waited_s": self._sums.waited_s,
            "rendered_s": self._sums.rendered_s,
            "updated_s": self._sums.updated_s,
        }

    def take(self) -> dict[str, float]:
        """The averages since the last call; empty when nothing was updated."""
        now, before = time.monotonic(), self._reported
        updates = self._sums.updates - before.updates
        if not updates or self._last is None:
            return {}
        wall = max(now - self._reported_at, 1e-9)
        values = {
            "loss": float(np.mean(self._losses)),
            **_values_of(self._last),
            "updates_per_s": updates / wall,
            "waited_share": (self._sums.waited_s - before.waited_s) / wall,
            "rendered_share": (self._sums.rendered_s - before.rendered_s) / wall,
        }
        self._losses = []
        self._reported, self._reported_at = self._sums, now
        return values


def _values_of(step: Step) -> dict[str, float]:
    """What the last update of double DQN says of its values; nothing of cloning."""
    result = step.result
    if isinstance(result, CloningResult):
        return {}
    return {"mean_q": result.mean_q, "max_q": result.max_q}


@final
class Reporter:
    """Status every second, curves every few, a checkpoint now and then."""

    def __init__(
        self,
        *,
        learner: Learner | CloningLearner,
        config: ExperimentConfig,
        folder: Path,
        progress: Progress,
        tell: Callable[[dict[str, float | int | str]], object] = lambda told: None,
        outside: Callable[[], dict[str, float]] = dict,
        sync: Callable[[], Mapping[str, int]] = dict,
    ) -> None:
        """Opens the curves; `outside` gives what others count, for the curves.

        `sync` has the replay written to the disk and gives its counters: it comes
        before the checkpoint, so that a replay is never behind the checkpoint that a
        run goes on from.
        """
        self._learner = learner
        self._config = config
        self._folder = folder
        self._progress = progress
        self._tell = tell
        self._outside = outside
        self._sync = sync
        report = config.report
        cloning = isinstance(learner, CloningLearner)
        self._columns = CLONING_COLUMNS if cloning else COLUMNS
        self._curves = CurvesWriter(
            csv_path=folder / CURVES,
            tensorboard=folder / TENSORBOARD if report.tensorboard else None,
            columns=self._columns,
            resume_from=learner.updates,
        )
        now = time.monotonic()
        self._curves_due = now + report.curves_s
        self._checkpoint_due = now + report.checkpoint_s
        self._status_due = now
        self._seen: dict[str, float] = {}

    def look(self) -> bool:
        """Writes what is due; whether a checkpoint was."""
        now = time.monotonic()
        if now >= self._status_due:
            self._status_due = now + STATUS_S
            self.tell()
        if now >= self._curves_due and self._seen:
            self._curves_due = now + self._config.report.curves_s
            self.write_curves()
        if now < self._checkpoint_due:
            return False
        self._checkpoint_due = now + self._config.report.checkpoint_s
        self.save()
        return True

    def tell(self) -> None:
        """Says how far it is."""
        self._seen |= self._progress.take()
        self._tell(
            {
                "updates": self._learner.updates,
                "elapsed_s": self._progress.elapsed_s,
                **self._progress.totals(),
                **self._seen,
            }
        )

    def write_curves(self) -> None:
        """One row of what is known now."""
        values = self._seen | self._outside() | {"seconds": self._progress.elapsed_s}
        known = {name: values[name] for name in self._columns if name in values}
        self._curves.write(self._learner.updates, known)

    def save(self) -> None:
        """Writes a checkpoint."""
        save_checkpoint(
            self._folder / CHECKPOINTS,
            learner=self._learner,
            extra=checkpoint_extra(
                self._config, self._progress.elapsed_s, self._sync()
            ),
            keep=self._config.report.checkpoints,
        )

    def close(self) -> None:
        """The last word, the last row and the last checkpoint."""
        self.tell()
        if self._seen:
            self.write_curves()
        self.save()
        self._curves.close()


def resume(learner: Learner | CloningLearner, folder: Path) -> float:
    """Restores the run's newest checkpoint, if any; the seconds it had taken."""
    if latest_checkpoint(folder / CHECKPOINTS) is None:
        return 0.0
    meta = load_checkpoint(folder / CHECKPOINTS, learner=learner)
    return float(meta["extra"]["elapsed_s"])


def spent(config: ExperimentConfig, updates: int, elapsed_s: float) -> bool:
    """Whether the budget is used up."""
    minutes = config.budget.minutes
    return updates >= config.budget.updates or (0 < minutes <= elapsed_s / 60)
