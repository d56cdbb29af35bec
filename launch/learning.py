"""The learner's role: samples in, weights and checkpoints out, until the budget ends.

A learner that is started again resumes from its newest checkpoint: the same network,
target network, optimiser and counters; the time it may still take goes on from there.
"""

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import Final

import jax
import numpy as np

from actors.network import layout_hash
from actors.rows import columns_of, render
from launch.config import ExperimentConfig, rows_of_run
from launch.join import JoinConfig, Joined, joined, train_bank
from launch.progress import Progress, Reporter, resume, spent
from launch.status import actor_rates
from learner.learner import Learner, learn
from learner.training import keep_memory
from replay.channels import StatusPublisher, StatusSubscriber
from replay.client import ReplayTimeout
from replay.shards_sampler import ShardedSampler
from replay.shards_tools import fetch_all_stats, sync_all, total
from replay.spec import Sample
from replay.weights import WeightsPublisher
from sim.bank import Bank
from sim.observation import Observation, observation_sizes

_SAMPLE_S: Final = 0.5  # between two looks at the reasons to stop
Render = Callable[[np.ndarray], tuple[Observation, Observation]]


def make_learner(config: ExperimentConfig) -> Learner:
    """The learner of a run, with the run's seed."""
    keep_memory()
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
