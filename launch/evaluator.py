"""Evaluation while a run goes on: a process beside it that drives each new checkpoint.

    RUN/evaluation.csv       a row for every checkpoint judged
        tensorboard/evaluation   the same
        best/                the best of them (`launch.evaluator_best`)

The newest checkpoint is driven on the first `evaluator.scenes` of the held-out scenes
with the same key each time, so that two checkpoints differ by their weights alone; of a
cloned policy the held-out log-likelihood is judged too. The parameters are an argument
of the compiled rollout: it compiles once for a run. The best is the one with the lowest
failure rate, ties broken by log displacement and then by log-likelihood.

Checkpoints in the folder, not the weights channel: they are the policy that is kept
(averaged, where that is configured), they outlive the process that judges them, and
the best one can be gone on with. An evaluator that is started again takes up its rows
and its best. It runs at nice 10, where a core that others want leaves it a tenth.

What the best scores on the scenes that it was chosen by flatters it: the report that a
run ends with has the others apart.
"""

import os
import threading
import time
from pathlib import Path
from typing import Final, final

import jax
import numpy as np

from actors.cloning import cloned
from actors.evaluation import Evaluation, Judge
from actors.likelihood import HeldOutLikelihood
from actors.policy import Policy, read_policy
from launch.config import RunFile
from launch.errors import LaunchError
from launch.evaluator_best import BestCheckpoint, Judgement
from launch.join import HELD_OUT, SCENES, JoinConfig, check_bank, joined
from launch.progress import CHECKPOINTS, TENSORBOARD
from launch.status import STATUS_S
from learner.checkpoint import latest_checkpoint
from learner.curves import STEP, CurvesWriter, read_curves
from replay.channels import StatusPublisher
from sim.bank import BankFile, open_bank

CURVE: Final = "evaluation.csv"
NICE: Final = 10
FIGURES: Final = (
    "failure_rate",
    "overlap_rate",
    "offroad_rate",
    "log_displacement",
    "progression",
    "kinematic_infeasibility",
    "wrong_way_rate",
    "off_route_rate",
)
COLUMNS: Final = (
    *FIGURES,
    "failure_rate_low",
    "failure_rate_high",
    "log_likelihood",
    "is_best",
    "evaluated_s",
)


@final
class CheckpointJudge:
    """Judges a run's checkpoints, one after the other, by one compiled program."""

    def __init__(self, folder: Path, run: RunFile) -> None:
        """Takes up what was judged before; compiles with the first checkpoint."""
        path = folder / SCENES / HELD_OUT
        self.bank: BankFile = check_bank(open_bank(path), run.held_out_hash)
        self._folder = folder
        self._run = run
        self.best = BestCheckpoint(folder)
        newest = latest_checkpoint(folder / CHECKPOINTS)
        self._curves = CurvesWriter(
            csv_path=folder / CURVE,
            tensorboard=folder / TENSORBOARD / "evaluation"
            if run.config.report.tensorboard
            else None,
            columns=COLUMNS,
            # A run that went back to an older checkpoint is judged from there on.
            resume_from=int(newest.name) if newest else 0,
        )
        judged = read_curves(folder / CURVE)[STEP]
        self.judged = int(judged[-1]) if len(judged) else -1
        """Updates of the checkpoint judged last; -1: none."""
        self.judge = Judge(
            self.bank,
            lambda vector: cloned(
                vector,
                run.config.network,
                run.config.environment,
                components=run.mixture,
            ),
            config=run.config.environment,
        )
        self._likelihood: HeldOutLikelihood | None = None

    def look(self, least_updates: int = 0) -> Judgement | None:
        """Judges the newest checkpoint; None where it was, or is about to be removed.

        `least_updates`: from the last one on.
        """
        newest = latest_checkpoint(self._folder / CHECKPOINTS)
        if newest is None:
            return None
        updates = int(newest.name)
        if updates <= self.judged or updates < self.judged + least_updates:
            return None
        aside = self.best.take_aside(newest)
        if aside is None:
            return None
        began = time.monotonic()
        policy = read_policy(aside)
        policy.check(self._run.config.environment, newest)
        evaluation = self.judge.evaluate(
            policy.vector,
            name="trained",
            key=jax.random.key(self._run.config.seed),
            most=self._run.config.evaluator.scenes or None,
        )
        judgement = Judgement(
            updates=updates,
            scenes=len(evaluation.scenes),
            failure_rate=_known(evaluation.failure_rate),
            log_displacement=_known(evaluation.log_displacement),
            log_likelihood=self._log_likelihood(policy),
        )
        self._write(evaluation, judgement, self.best.offer(aside, judgement), began)
        self.judged = updates
        return judgement

    def _write(
        self, evaluation: Evaluation, judgement: Judgement, is_best: bool, began: float
    ) -> None:
        figures = evaluation.figures
        values = {name: figures[name].value for name in FIGURES}
        values["failure_rate_low"] = figures["failure_rate"].low
        values["failure_rate_high"] = figures["failure_rate"].high
        if judgement.log_likelihood is not None:
            values["log_likelihood"] = judgement.log_likelihood
        values["is_best"] = float(is_best)
        values["evaluated_s"] = time.monotonic() - began
        self._curves.write(judgement.updates, values)

    def _log_likelihood(self, policy: Policy) -> float | None:
        if self._run.algorithm != "bc":
            return None
        if self._likelihood is None:
            self._likelihood = HeldOutLikelihood(
                self.bank,
                config=self._run.config.environment,
                network=self._run.config.network,
                components=self._run.mixture,
                seed=self._run.config.seed,
            )
        value = self._likelihood.mean(policy.vector)
        return value if np.isfinite(value) else None

    def close(self) -> None:
        """Closes the curve."""
        self._curves.close()


def _known(value: float) -> float:
    """A figure to compare by: what is not known is worst, and finite for JSON."""
    return value if np.isfinite(value) else 1e9


def evaluator_role(join: JoinConfig, stop: threading.Event) -> None:
    """Judges new checkpoints until asked to stop."""
    if join.run is None:
        raise LaunchError("the evaluator reads a run's folder: name it by --run")
    os.nice(NICE)  # before any thread is started: it is each thread's own
    with joined(join, stop) as place:
        config = place.run.config.evaluator
        judge = CheckpointJudge(place.folder, place.run)
        status = StatusPublisher(place.session, place.keys, "evaluator")
        told: dict[str, float | int | str] = {}
        due = 0.0
        while not stop.is_set():
            if time.monotonic() >= due:
                began = time.monotonic()
                judgement = judge.look(config.updates)
                if judgement is not None:
                    due = began + config.seconds
                    told = figures_told(judgement, judge.best.judgement)
            status.put(told)
            stop.wait(STATUS_S)
        judge.close()


def figures_told(
    judgement: Judgement, best: Judgement | None
) -> dict[str, float | int | str]:
    """What the console shows: the last checkpoint and the best one."""
    told: dict[str, float | int | str] = {
        "evaluated_updates": judgement.updates,
        "held_out_failure_rate": judgement.failure_rate,
        "held_out_log_displacement": judgement.log_displacement,
    }
    if judgement.log_likelihood is not None:
        told["held_out_log_likelihood"] = judgement.log_likelihood
    if best is not None:
        told["best_updates"] = best.updates
        told["best_failure_rate"] = best.failure_rate
    return told
