"""`slipstream train bc`: behaviour cloning, from scenes to a scored agent.

    RUN/config.json          the resolved configuration      scenes/*.bank
        logs/ROLE.log        what each process printed       curves.csv, .png
        tensorboard/         the same curves                 checkpoints/
        evaluation.csv       how checkpoints drove, and their held-out log-likelihood
        best/                the best of them
        evaluation.json .md .png .rrd   scores and a recording    status.json

The processes are those of `train dqn` but for the actors: nobody drives. A filler
replays the expert (`launch.cloning`), the replay is drawn uniformly, the learner
clones, and the evaluator judges the checkpoints; each is started again when it is
killed. With `serial` there is one process and no replay: batches are drawn from the
bank pass, and checkpoints judged in turn with learning. A resumed run draws other
batches than one that was not interrupted.
"""

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import tyro

from launch.cloning import (
    count_rows,
    make_cloner,
    make_render_before,
    rows_to_clone,
    with_straying,
)
from launch.config import (
    ExperimentConfig,
    RunFile,
    quick_cloning,
    with_filled_replay,
    with_space,
)
from launch.converting import say
from launch.errors import INTERRUPTED, LaunchError
from launch.evaluator import CheckpointJudge
from launch.evaluator_best import Judgement
from launch.join import SCENES, TRAIN
from launch.placement import Placement
from launch.progress import Progress, Reporter, resume, spent
from launch.scenes import PROCEDURAL
from launch.train import TrainConfig, finish, prepare, supervised
from learner.cloning import clone
from sim.bank import open_bank

Space = Literal["bicycle", "delta", "bicycle-discrete", "delta-discrete"]
SPACES: Final = ("bicycle", "delta", "bicycle-discrete", "delta-discrete")


@dataclass(frozen=True, kw_only=True)
class TrainBcConfig:
    """Clones what was recorded, on this machine."""

    preset: Literal["quick", "laptop", "paper"] = "quick"
    """The settings that all others start from."""
    space: Space = "bicycle"
    """The action space: a mixture over continuous actions, or a softmax over a grid."""
    objects: Literal["sdc", "vehicles"] = "vehicles"
    """Whose actions are cloned: the SDC's, or all vehicles' that the log moves."""
    scenes: tuple[str, ...] = (PROCEDURAL,)
    """Files or folders of recorded scenes, one or two banks, or `procedural`."""
    run: Path | None = None
    """The run's folder; runs/bc-SPACE-TIME unless given."""
    resume: bool = False
    """Goes on with an existing run, from its newest checkpoint."""
    serial: bool = False
    """Runs in this process, without a replay: same seed, same losses."""
    config: Annotated[ExperimentConfig, tyro.conf.arg(name="")] = field(
        default_factory=quick_cloning
    )
    """Everything else."""


def train_bc_command(options: TrainBcConfig) -> int:
    """`slipstream train bc`; the exit code."""
    folder, run = prepare_cloning(options)
    say(f"run: {folder}  ({', '.join(run.scenes)}, {options.preset}, {options.space})")
    say(f"{run.config.replay.capacity} expert actions")
    if options.serial:
        clone_serially(folder, run)
    elif not supervised(folder, run, Placement()):
        return INTERRUPTED
    finish(folder, run)
    return 0


def prepare_cloning(options: TrainBcConfig) -> tuple[Path, RunFile]:
    """The run's folder; its replay has room for the bank pass and no more."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    folder, run = prepare(
        TrainConfig(
            scenes=options.scenes,
            run=options.run or Path("runs") / f"bc-{options.space}-{stamp}",
            resume=options.resume,
            config=with_space(options.config, options.space),
        ),
        algorithm="bc",
        objects=options.objects,
    )
    if run.objects != options.objects:
        raise LaunchError(
            f"{folder}: this run clones --objects {run.objects}; give that to resume it"
        )
    path = folder / SCENES / TRAIN
    rows = count_rows(run, open_bank(path))
    if not rows:
        raise LaunchError(f"{path}: nobody is recorded to clone")
    run = dataclasses.replace(run, config=with_filled_replay(run.config, rows))
    run.write(folder)
    return folder, run


def clone_serially(folder: Path, run: RunFile) -> None:
    """Clones in this process until the budget is spent."""
    config = run.config
    learner = make_cloner(config)
    progress = Progress(resume(learner, folder))
    train = open_bank(folder / SCENES / TRAIN)
    rows = rows_to_clone(run, train.bank)
    rng = np.random.default_rng([config.seed, learner.updates])
    judge = CheckpointJudge(folder, run) if config.evaluator.scenes else None
    reporter = Reporter(
        learner=learner, config=config, folder=folder, progress=progress
    )

    def draw() -> np.ndarray:
        return rows[rng.integers(0, len(rows), config.cloning.batch_size)]

    steps = clone(
        learner=learner,
        sample=with_straying(draw, config, learner.updates),
        render=make_render_before(train, config),
    )
    due = 0.0
    for step in steps:
        if step is not None:
            progress.add(step)
        if reporter.look() and time.monotonic() >= due:
            due = time.monotonic() + config.evaluator.seconds
            _look(judge, progress, config.evaluator.updates)
        if spent(config, learner.updates, progress.elapsed_s):
            break
    reporter.close()
    _look(judge, progress, 0)
    if judge is not None:
        judge.close()


def _look(
    judge: CheckpointJudge | None, progress: Progress, least_updates: int
) -> None:
    """Judges the newest checkpoint if it is to be, and says how it did."""
    judged = judge.look(least_updates) if judge is not None else None
    if judged is not None:
        say(_line(judged, progress.elapsed_s))


def _line(judged: Judgement, elapsed_s: float) -> str:
    return (
        f"{elapsed_s / 60:5.1f} min  {judged.updates} updates  held out: failures "
        f"{judged.failure_rate:.1%}, log ADE {judged.log_displacement:.2f} m, "
        f"log-likelihood {judged.log_likelihood or float('nan'):.3f}"
    )
