"""The whole system in one process: actors, replay and learner take turns.

Same seed, same losses: the rate limiter decides who is next, from the counters alone,
so no clock has a say (but for the budget's minutes, which should be 0 where runs are
to be compared). Rows, table, limiter, update and rendering are those of the processes;
only the network between them is left out.
"""

import itertools
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from actors.actor import Tick, Weights, exploration, run_actor
from actors.network import layout_hash
from launch.config import ExperimentConfig, RunFile, rows_of_run
from launch.console import Status, line_of, snapshot
from launch.join import REPLAY, SCENES, TRAIN
from launch.learning import make_learner, make_render
from launch.progress import Progress, Reporter, resume, spent
from launch.roles import ActorStatus, acting_config
from learner.learner import Learner, LearnStep, learn
from replay.local import LocalReplay
from replay.spec import Sample
from replay.wire import Weights as WireWeights
from sim.bank import Bank, open_bank

_LINE_S = 10.0


def serial_replay(config: ExperimentConfig, folder: Path | None = None) -> LocalReplay:
    """The run's replay: the one in `folder` if it is durable, else an empty one."""
    return LocalReplay(
        spec=rows_of_run(config),
        config=config.replay,
        seed=config.seed,
        folder=folder,
    )


def serial_steps(
    config: ExperimentConfig,
    bank: Bank,
    learner: Learner,
    status: ActorStatus,
    replay: LocalReplay | None = None,
) -> Iterator[tuple[LearnStep, LocalReplay]]:
    """Updates for ever, actors taking their turns in between."""
    replay = replay or serial_replay(config)
    weights: list[Weights] = []
    made: deque[np.ndarray] = deque()  # a scan of several objects makes many batches
    layout = layout_hash(learner.layout)

    def publish(version: int, vector: np.ndarray) -> None:
        weights[:] = [WireWeights(version=version, layout_hash=layout, vector=vector)]

    def sample() -> Sample:
        while not replay.may_sample(config.learner.batch_size):
            # The limiter's check of batch sizes: one of the two sides may go on.
            if made:
                replay.insert(made.popleft())
            else:
                status.add(next(next(order)))
        return replay.sample(config.learner.batch_size)

    order = itertools.cycle(_actors(config, bank, made, weights))
    steps = learn(
        learner=learner,
        sample=sample,
        update_priorities=replay.update_priorities,
        render=make_render(bank, config),
        publish=publish,
    )
    for step in steps:
        if step is not None:
            yield step, replay


def _actors(
    config: ExperimentConfig,
    bank: Bank,
    made: deque[np.ndarray],
    weights: list[Weights],
) -> list[Iterator[Tick]]:
    """The acting loops; a turn of one makes the rows of a scan."""
    key = jax.random.key(config.seed)
    return [
        run_actor(
            key=jax.random.fold_in(key, actor),
            bank=bank,
            config=acting_config(config),
            epsilon=exploration(config.actor, actor=actor, actors=config.actors),
            actor=actor,
            latest=lambda: weights[0],
            write=made.append,
        )
        for actor in range(config.actors)
    ]


def run_serial(folder: Path, run: RunFile) -> None:
    """Trains in this process until the budget is spent."""
    config = run.config
    learner = make_learner(config)
    progress = Progress(resume(learner, folder))
    replay = serial_replay(config, folder / REPLAY / "0")
    status = ActorStatus.begin()
    told: dict[str, float | int | str] = {}
    counters: dict[str, float] = {}
    reporter = Reporter(
        learner=learner,
        config=config,
        folder=folder,
        progress=progress,
        tell=told.update,
        outside=lambda: status.rates() | counters,
        sync=lambda: synced(replay),
    )
    bank = open_bank(folder / SCENES / TRAIN).bank
    due = time.monotonic() + _LINE_S
    for step, _ in serial_steps(config, bank, learner, status, replay):
        progress.add(step)
        counters["inserts"] = replay.inserts
        counters["samples_per_insert"] = replay.samples_per_insert
        reporter.look()
        if time.monotonic() >= due:
            due = time.monotonic() + _LINE_S
            now = time.monotonic()
            roles: dict[str, tuple[float, Status]] = {
                "learner": (now, told),
                "actor-0": (now, status.rates()),
            }
            print(line_of(snapshot(config, roles, counters, now)), flush=True)
        if spent(config, learner.updates, progress.elapsed_s):
            break
    reporter.close()
    replay.close()


def synced(replay: LocalReplay) -> dict[str, int]:
    """What a durable replay has on the disk, once it has all of now."""
    if replay.durable is None:
        return {}
    replay.durable.sync()
    return {
        "inserts": replay.inserts,
        "samples": replay.samples,
        "deletes": replay.table.deletes,
    }
