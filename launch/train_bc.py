"""`slipstream train bc`: behaviour cloning, from scenes to a scored agent.

    RUN/config.json          the resolved configuration      scenes/*.bank
        curves.csv, .png     loss, held-out log-likelihood   tensorboard/
        checkpoints/         the newest                      best/  of the held-out
        evaluation.json .md .rrd   scores and a recording of the best

One process: a bank pass makes the expert's rows (`actors.cloning`), batches of them are
drawn uniformly, rendered and learnt. No actor is needed, for nobody drives. Held-out
log-likelihoods are of the SDCs' rows of the held-out scenes. A resumed run draws other
batches than one that was not interrupted.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, Literal, final

import jax
import numpy as np
import tyro

from actors.cloning import expert_rows, moving_vehicles, sdc_only
from actors.policy import BEST
from actors.rows import columns_of, render_before
from launch.config import (
    ExperimentConfig,
    RunFile,
    quick_cloning,
    with_space,
)
from launch.converting import say
from launch.errors import LaunchError
from launch.join import HELD_OUT, SCENES, TRAIN
from launch.learning import CHECKPOINTS, CURVES, TENSORBOARD, checkpoint_extra, spent
from launch.scenes import PROCEDURAL
from launch.train import TrainConfig, finish, prepare
from learner.checkpoint import (
    latest_checkpoint,
    load_checkpoint,
    read_meta,
    save_checkpoint,
)
from learner.cloning import (
    CloneStep,
    CloningBatch,
    CloningLearner,
    clone,
    cloning_batch,
    held_out,
)
from learner.curves import CurvesWriter
from sim.bank import BankFile, open_bank
from sim.observation import Observation, observation_sizes

COLUMNS: Final = (
    "loss",
    "log_likelihood",
    "updates_per_s",
    "rendered_share",
    "seconds",
)
HELD_OUT_ROWS: Final = 2048  # at most, drawn once
_HELD_OUT_BATCH: Final = 256
Render = Callable[[np.ndarray], Observation]


@dataclass(frozen=True, kw_only=True)
class TrainBcConfig:
    """Clones what was recorded, on this machine."""

    preset: Literal["quick", "laptop", "paper"] = "quick"
    """The settings that all others start from."""
    space: Literal["bicycle", "delta", "bicycle-discrete", "delta-discrete"] = "bicycle"
    """The action space: a mixture over continuous actions, or a softmax over a grid."""
    objects: Literal["sdc", "vehicles"] = "vehicles"
    """Whose actions are cloned: the SDC's, or all vehicles' that the log moves."""
    scenes: tuple[str, ...] = (PROCEDURAL,)
    """Files or folders of recorded scenes, one or two banks, or `procedural`."""
    run: Path | None = None
    """The run's folder; runs/bc-SPACE-TIME unless given."""
    resume: bool = False
    """Goes on with an existing run, from its newest checkpoint."""
    config: Annotated[ExperimentConfig, tyro.conf.arg(name="")] = field(
        default_factory=quick_cloning
    )
    """Everything else."""


def train_bc_command(options: TrainBcConfig) -> int:
    """`slipstream train bc`; the exit code."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder, run = prepare(
        TrainConfig(
            scenes=options.scenes,
            run=options.run or Path("runs") / f"bc-{options.space}-{stamp}",
            resume=options.resume,
            config=with_space(options.config, options.space),
        )
    )
    say(f"run: {folder}  ({', '.join(run.scenes)}, {options.preset}, {options.space})")
    train_bc(folder, run, everyone=options.objects == "vehicles")
    finish(folder, run)
    return 0


def train_bc(folder: Path, run: RunFile, *, everyone: bool) -> None:
    """Clones until the budget is spent."""
    config = run.config
    learner = make_cloner(config)
    before_s = resume_cloning(learner, folder)
    train = open_bank(folder / SCENES / TRAIN)
    controlled = moving_vehicles(train.bank) if everyone else sdc_only(train.bank)
    rows = expert_rows(train.bank, controlled, config.environment)
    if not len(rows):
        raise LaunchError(f"{folder / SCENES / TRAIN}: nobody is recorded to clone")
    say(f"{len(rows)} expert actions of {len(np.unique(rows['scene']))} scenes")
    rng = np.random.default_rng([config.seed, learner.updates])
    batch_size = config.cloning.batch_size
    steps = clone(
        learner=learner,
        sample=lambda: rows[rng.integers(0, len(rows), batch_size)],
        render=make_render_before(train, config),
    )
    reporter = BcReporter(
        learner=learner,
        config=config,
        folder=folder,
        before_s=before_s,
        unseen=held_out_batches(open_bank(folder / SCENES / HELD_OUT), config),
    )
    for step in steps:
        if step is None:
            continue
        reporter.add(step)
        if spent(config, learner.updates, reporter.elapsed_s):
            break
    reporter.close()


def make_cloner(config: ExperimentConfig) -> CloningLearner:
    """The learner of a run, with the run's seed."""
    return CloningLearner(
        config=dataclasses.replace(config.cloning, seed=config.seed),
        network=config.network,
        sizes=observation_sizes(config.environment.observation),
        action=config.environment.action,
    )


def make_render_before(file: BankFile, config: ExperimentConfig) -> Render:
    """Rows to the observations where actions were chosen, compiled."""
    observation = config.environment.observation
    compiled = jax.jit(functools.partial(render_before, config=observation))
    return lambda rows: compiled(file.bank, columns_of(rows))


def held_out_batches(file: BankFile, config: ExperimentConfig) -> list[CloningBatch]:
    """The SDCs' rows of the held-out scenes, at most `HELD_OUT_ROWS` of them."""
    rows = expert_rows(file.bank, sdc_only(file.bank), config.environment)
    rng = np.random.default_rng(config.seed)
    rows = rows[rng.permutation(len(rows))[:HELD_OUT_ROWS]]
    look = make_render_before(file, config)
    size = min(_HELD_OUT_BATCH, len(rows))
    whole = range(0, len(rows) - size + 1, size)  # of one shape: one compilation
    parts = [rows[first : first + size] for first in whole]
    return [cloning_batch(part, look(part)) for part in parts]


def resume_cloning(learner: CloningLearner, folder: Path) -> float:
    """Restores the run's newest checkpoint, if any; the seconds it had taken."""
    if latest_checkpoint(folder / CHECKPOINTS) is None:
        return 0.0
    meta = load_checkpoint(folder / CHECKPOINTS, learner=learner)
    return float(meta["extra"]["elapsed_s"])


@final
class BcReporter:
    """Curves every few seconds; held-out likelihood and checkpoint now and then."""

    def __init__(
        self,
        *,
        learner: CloningLearner,
        config: ExperimentConfig,
        folder: Path,
        before_s: float,
        unseen: list[CloningBatch],
    ) -> None:
        """Opens the curves; `before_s` was spent before this process began."""
        report = config.report
        self._learner = learner
        self._config = config
        self._folder = folder
        self._unseen = unseen
        self._best = best_so_far(folder)
        self._steps: list[CloneStep] = []
        self._curves = CurvesWriter(
            csv_path=folder / CURVES,
            tensorboard=folder / TENSORBOARD if report.tensorboard else None,
            columns=COLUMNS,
            resume_from=learner.updates,
        )
        now = time.monotonic()
        self._began, self._written = now - before_s, now
        self._checkpoint_due = now + report.checkpoint_s

    @property
    def elapsed_s(self) -> float:
        """Over all restarts."""
        return time.monotonic() - self._began

    def add(self, step: CloneStep) -> None:
        """Counts one update, and writes what is due."""
        self._steps.append(step)
        now = time.monotonic()
        if now >= self._checkpoint_due:
            self.save()
            self._checkpoint_due = time.monotonic() + self._config.report.checkpoint_s
        elif now >= self._written + self._config.report.curves_s:
            self.write({})

    def write(self, more: dict[str, float]) -> None:
        """One row of the averages since the last, where there was an update since."""
        wall = max(time.monotonic() - self._written, 1e-9)
        values = {"seconds": self.elapsed_s, **more}
        if self._steps:
            values["loss"] = float(np.mean([step.result.loss for step in self._steps]))
            values["updates_per_s"] = len(self._steps) / wall
            values["rendered_share"] = sum(s.rendered_s for s in self._steps) / wall
        self._curves.write(self._learner.updates, values)
        self._steps, self._written = [], time.monotonic()

    def save(self) -> None:
        """Judges the policy by the held-out rows; keeps it, aside too if it is best."""
        likelihood = held_out(self._learner, self._unseen)
        self.write({"log_likelihood": likelihood})
        extra = checkpoint_extra(self._config, self.elapsed_s, {})
        extra["log_likelihood"] = likelihood
        save_checkpoint(
            self._folder / CHECKPOINTS,
            learner=self._learner,
            extra=extra,
            keep=self._config.report.checkpoints,
        )
        if likelihood > self._best:
            self._best = likelihood
            save_checkpoint(
                self._folder / BEST, learner=self._learner, extra=extra, keep=1
            )
        say(
            f"{self.elapsed_s / 60:5.1f} min  {self._learner.updates} updates  "
            f"held-out log-likelihood {likelihood:.3f}, best {self._best:.3f}"
        )

    def close(self) -> None:
        """The last judgement, row and checkpoint."""
        self.save()
        self._curves.close()


def best_so_far(folder: Path) -> float:
    """The held-out log-likelihood of the best checkpoint."""
    path = latest_checkpoint(folder / BEST)
    return (
        -np.inf if path is None else float(read_meta(path)["extra"]["log_likelihood"])
    )
