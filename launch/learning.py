"""The learner's role: samples in, weights and checkpoints out, until the budget ends.

A learner that is started again resumes from its newest checkpoint: the same network,
target network, optimiser and counters; the time it may still take goes on from there.
"""

import dataclasses
import functools
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import jax
import msgspec
import numpy as np

from actors.network import layout_hash
from actors.rows import columns_of, render
from launch.config import ExperimentConfig, rows_of_run
from launch.join import JoinConfig, Joined, joined, train_bank
from launch.status import STATUS_S, actor_rates
from learner.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint
from learner.curves import CurvesWriter
from learner.learner import Learner, LearnStep, learn
from replay.channels import StatusPublisher, StatusSubscriber
from replay.client import ReplayTimeout
from replay.shards_sampler import ShardedSampler
from replay.shards_tools import fetch_all_stats, sync_all, total
from replay.spec import Sample
from replay.weights import WeightsPublisher
from sim.bank import Bank
from sim.observation import Observation, observation_sizes

CHECKPOINTS: Final = "checkpoints"
CURVES: Final = "curves.csv"
TENSORBOARD: Final = "tensorboard"
_SAMPLE_S: Final = 0.5  # between two looks at the reasons to stop
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

Render = Callable[[np.ndarray], tuple[Observation, Observation]]


def make_learner(config: ExperimentConfig) -> Learner:
    """The learner of a run, with the run's seed."""
    return Learner(
        config=dataclasses.replace(config.learner, seed=config.seed),
        network=config.network,
        sizes=observation_sizes(config.environment.observation),
        actions=config.environment.action.count,
    )


def make_render(bank: Bank, config: ExperimentConfig) -> Render:
    """Rows to observations, compiled."""
    compiled = jax.jit(functools.partial(render, config=config.environment.observation))
    return lambda rows: compiled(bank, columns_of(rows))


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
    waited_s: float = 0.0  # for the replay
    rendered_s: float = 0.0  # rows to observations
    updated_s: float = 0.0  # the updates themselves

    def plus(self, step: LearnStep) -> "_Sums":
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
        self._last: LearnStep | None = None
        self._losses: list[float] = []
        self._sums = _Sums()
        self._reported, self._reported_at = _Sums(), time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Since the first update, over all restarts."""
        running = 0.0 if self._began is None else time.monotonic() - self._began
        return self._before_s + running

    def add(self, step: LearnStep) -> None:
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
            "mean_q": self._last.result.mean_q,
            "max_q": self._last.result.max_q,
            "updates_per_s": updates / wall,
            "waited_share": (self._sums.waited_s - before.waited_s) / wall,
        }
        self._losses = []
        self._reported, self._reported_at = self._sums, now
        return values


@final
class Reporter:
    """Status every second, curves every few, a checkpoint now and then."""

    def __init__(
        self,
        *,
        learner: Learner,
        config: ExperimentConfig,
        folder: Path,
        progress: Progress,
        tell: Callable[[dict[str, float | int | str]], object],
        outside: Callable[[], dict[str, float]],
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
        self._curves = CurvesWriter(
            csv_path=folder / CURVES,
            tensorboard=folder / TENSORBOARD if report.tensorboard else None,
            columns=COLUMNS,
            resume_from=learner.updates,
        )
        now = time.monotonic()
        self._curves_due = now + report.curves_s
        self._checkpoint_due = now + report.checkpoint_s
        self._status_due = now
        self._seen: dict[str, float] = {}

    def look(self) -> None:
        """Writes what is due."""
        now = time.monotonic()
        if now >= self._status_due:
            self._status_due = now + STATUS_S
            self.tell()
        if now >= self._curves_due and self._seen:
            self._curves_due = now + self._config.report.curves_s
            self.write_curves()
        if now >= self._checkpoint_due:
            self._checkpoint_due = now + self._config.report.checkpoint_s
            self.save()

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
        known = {name: values[name] for name in COLUMNS if name in values}
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


def resume(learner: Learner, folder: Path) -> float:
    """Restores the run's newest checkpoint, if any; the seconds it had taken."""
    if latest_checkpoint(folder / CHECKPOINTS) is None:
        return 0.0
    meta = load_checkpoint(folder / CHECKPOINTS, learner=learner)
    return float(meta["extra"]["elapsed_s"])


def spent(config: ExperimentConfig, updates: int, elapsed_s: float) -> bool:
    """Whether the budget is used up."""
    minutes = config.budget.minutes
    return updates >= config.budget.updates or (0 < minutes <= elapsed_s / 60)


def learner_role(join: JoinConfig, stop: threading.Event) -> None:
    """Learns until the budget is spent or it is asked to stop."""
    with joined(join, stop) as place:
        config = place.run.config
        if place.run.algorithm == "bc":
            from launch.cloning import clone_from_replay

            return clone_from_replay(place, stop)
        learner = make_learner(config)
        progress = Progress(resume(learner, place.folder))
        statuses = StatusSubscriber(place.session, place.keys)
        reporter = Reporter(
            learner=learner,
            config=config,
            folder=place.folder,
            progress=progress,
            tell=StatusPublisher(place.session, place.keys, "learner").put,
            outside=lambda: actor_rates(statuses.latest()) | _replay_rates(place),
            sync=lambda: _synced(place),
        )
        publisher = WeightsPublisher(session=place.session, keys=place.keys)
        layout = layout_hash(learner.layout)
        spec = rows_of_run(config)
        directory = place.directory(spec)
        sampler = ShardedSampler(
            directory=directory,
            spec=spec,
            batch_size=config.learner.batch_size,
            # With so many shards, as many rows are under way in all as with one.
            batches_per_reply=max(1, config.learner.batches_per_reply // config.shards),
            in_flight=2,
            seed=config.seed,
        )
        steps = learn(
            learner=learner,
            sample=functools.partial(_sample, sampler),
            update_priorities=sampler.update_priorities,
            render=make_render(train_bank(place).bank, config),
            publish=lambda version, vector: publisher.publish(version, layout, vector),
        )
        for step in steps:
            if step is not None:
                progress.add(step)
            reporter.look()
            over = spent(config, learner.updates, progress.elapsed_s)
            if over or stop.is_set():
                break
        reporter.close()
        publisher.publish(learner.updates, layout, learner.vector())
        directory.close()


def _sample(sampler: ShardedSampler) -> Sample | None:
    """The next batch; None where none came in time."""
    try:
        return sampler.sample(_SAMPLE_S)
    except ReplayTimeout:
        return None


def _synced(place: Joined) -> dict[str, int]:
    """What the replay has on the disk; nothing if it does not say so in time."""
    if not place.run.config.replay.durable:
        return {}
    try:
        stats = total(sync_all(place.session, place.keys, timeout=10.0))
    except ReplayTimeout:
        return {}
    return {name: int(stats[name]) for name in ("inserts", "samples", "deletes")}


def _replay_rates(place: Joined) -> dict[str, float]:
    """The service's counters for the curves; none while it does not answer."""
    try:
        stats = total(fetch_all_stats(place.session, place.keys, timeout=0.2))
    except ReplayTimeout:
        return {}
    return {name: float(stats[name]) for name in ("inserts", "samples_per_insert")}
