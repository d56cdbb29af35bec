"""Behaviour cloning's roles: the filler replays the expert, the learner clones it.

The filler makes a row of every action that the log holds (`actors.cloning`) and inserts
them over Zenoh as an actor does, once; the replay then lets the learner draw uniformly
and without bound (`launch.config.with_filled_replay`). It stays, and fills again a
replay that was killed and has come back empty. A filler that is started again makes
its pass from the beginning: rows of the pass before are pushed out, the oldest first,
and when it ends each row is there once.
"""

import dataclasses
import functools
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import jax
import numpy as np

from actors.cloning import expert_rows, expert_steps, moving_vehicles, sdc_only
from actors.rows import columns_of, render_before
from actors.straying import strayed
from launch.config import FILL_ROWS, ExperimentConfig, RunFile, row_spec_of
from launch.errors import LaunchError
from launch.join import JoinConfig, Joined, joined, train_bank
from launch.progress import Progress, Reporter, resume, spent
from launch.status import STATUS_S
from learner.cloning import CloningLearner, clone
from learner.training import keep_memory
from replay.channels import StatusPublisher
from replay.client import ReplayTimeout, Writer
from replay.shards_directory import ShardDirectory
from replay.shards_sampler import ShardedSampler
from replay.shards_tools import fetch_all_stats
from sim.bank import Bank, BankFile
from sim.observation import Observation, observation_sizes

_WAIT_S: Final = 0.5  # between two looks at the reasons to stop
_FLUSH_S: Final = 30.0
Draw = Callable[[], np.ndarray | None]
Render = Callable[[np.ndarray], Observation]


def controlled_of(run: RunFile, bank: Bank) -> np.ndarray:
    """Whose actions are cloned: [scenes, slots] rows of the log."""
    return moving_vehicles(bank) if run.objects == "vehicles" else sdc_only(bank)


def count_rows(run: RunFile, file: BankFile) -> int:
    """How many actions there are to clone."""
    # On the file's own arrays: the process that counts starts others, and must not
    # have JAX's threads when it does.
    arrays: Any = file.arrays
    bank = Bank(**arrays)
    first = run.config.environment.observation.history - 1
    return len(expert_steps(bank, controlled_of(run, bank), first)[0])


def rows_to_clone(run: RunFile, bank: Bank) -> np.ndarray:
    """The bank pass: a row for each of the expert's actions."""
    return expert_rows(bank, controlled_of(run, bank), run.config.environment)


def make_cloner(config: ExperimentConfig) -> CloningLearner:
    """The learner of a run, with the run's seed."""
    keep_memory()
    return CloningLearner(
        config=dataclasses.replace(config.cloning, seed=config.seed),
        network=config.network,
        sizes=observation_sizes(config.environment.observation),
        action=config.environment.action,
        dt=config.environment.dt,
    )


def make_render_before(file: BankFile, config: ExperimentConfig) -> Render:
    """Rows to the observations where actions were chosen, compiled."""
    observation = config.environment.observation
    compiled = jax.jit(functools.partial(render_before, config=observation))
    return lambda rows: compiled(file.bank, columns_of(rows))


def with_straying(draw: Draw, config: ExperimentConfig, updates: int) -> Draw:
    """Batches of which a share has strayed; other ones at each number of updates."""
    rng = np.random.default_rng([config.seed, 1, updates])

    def drawn() -> np.ndarray | None:
        rows = draw()
        if rows is None:
            return None
        return strayed(rows, rng, config.straying, config.environment)

    return drawn


def clone_from_replay(place: Joined, stop: threading.Event) -> None:
    """The learner's role: clones until the budget is spent or it is asked to stop."""
    config = place.run.config
    learner = make_cloner(config)
    progress = Progress(resume(learner, place.folder))
    reporter = Reporter(
        learner=learner,
        config=config,
        folder=place.folder,
        progress=progress,
        tell=StatusPublisher(place.session, place.keys, "learner").put,
    )
    spec = row_spec_of(place.run)
    directory = place.directory(spec)
    sampler = ShardedSampler(
        directory=directory,
        spec=spec,
        batch_size=config.cloning.batch_size,
        batches_per_reply=max(1, config.learner.batches_per_reply // config.shards),
        in_flight=2,
        seed=config.seed,
    )

    def sample() -> np.ndarray | None:
        try:
            return sampler.sample(_WAIT_S).rows
        except ReplayTimeout:
            return None

    render = make_render_before(train_bank(place), config)
    draw = with_straying(sample, config, learner.updates)
    for step in clone(learner=learner, sample=draw, render=render):
        if step is not None:
            progress.add(step)
        reporter.look()
        over = spent(config, learner.updates, progress.elapsed_s)
        if over or stop.is_set():
            break
    reporter.close()
    directory.close()


def filler_role(join: JoinConfig, stop: threading.Event) -> None:
    """Fills the replay, and again whenever it has lost rows, until asked to stop."""
    with joined(join, stop) as place:
        rows = rows_to_clone(place.run, train_bank(place).bank)
        if len(rows) != place.run.config.replay.capacity:
            raise LaunchError(
                f"{place.folder}: the bank has {len(rows)} actions to clone, the "
                f"replay room for {place.run.config.replay.capacity}; start the run by "
                "slipstream train bc"
            )
        status = StatusPublisher(place.session, place.keys, "filler")
        directory = place.directory(row_spec_of(place.run))
        parts = dealt(rows, place.run.config.shards)
        while not stop.is_set():
            lacking = _lacking(place, parts)
            if lacking:
                _fill(place, directory, lacking, stop)
            status.put({"rows": len(rows) if lacking == {} else 0})
            stop.wait(STATUS_S)
        directory.close()


def dealt(rows: np.ndarray, shards: int) -> dict[int, np.ndarray]:
    """What each shard holds of the pass: as many rows, one scene's in all of them."""
    return {shard: rows[shard::shards] for shard in range(shards)}


def _fill(
    place: Joined,
    directory: ShardDirectory,
    parts: dict[int, np.ndarray],
    stop: threading.Event,
) -> None:
    """Inserts the shards' rows, in turns, so that they are full at the same time."""
    writers = {
        link.shard: Writer(
            session=link.session,
            keys=link.keys,
            spec=row_spec_of(place.run),
            writer=0,
            # In milliseconds: it grows from one pass to the next.
            epoch=time.time_ns() // 1_000_000,
            window=place.run.config.actor.window,
            batch_rows=FILL_ROWS,
        )
        for link in directory.links
        if link.shard in parts
    }
    for first in range(0, max(map(len, parts.values())), FILL_ROWS):
        for shard, writer in writers.items():
            part = parts[shard][first : first + FILL_ROWS]
            # A part is one batch, so what did not fit is whole and offered again.
            while not writer.append(part, _WAIT_S) and not stop.is_set():
                part = part[:0]
        if stop.is_set():
            break
    for writer in writers.values():
        writer.close(_WAIT_S if stop.is_set() else _FLUSH_S)


def _lacking(
    place: Joined, parts: dict[int, np.ndarray]
) -> dict[int, np.ndarray] | None:
    """The parts of which a shard that is up has not every row; None: no answer."""
    try:
        stats = fetch_all_stats(place.session, place.keys)
    except ReplayTimeout:
        return None  # it is being started again: asked once more in a while
    return {
        shard: rows
        for shard, rows in parts.items()
        if shard in stats and stats[shard]["size"] < len(rows)
    }
