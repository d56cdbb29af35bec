"""Roles of a run, a process each: actor, viewer.

The others: `launch.replay_role`, `launch.learning`, `launch.evaluator`.

A role ends when its process is asked to or when the run is called off, and says how
it fares about once a second.
"""

import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import jax
import numpy as np

from actors.acting import ActingConfig, choice_of
from actors.actor import Tick, exploration, run_actor
from actors.frames import FrameBatch, encode_frames
from actors.network import layout_hash, parameter_layout
from launch.config import ExperimentConfig, rows_of_run
from launch.errors import LaunchError
from launch.join import JoinConfig, Joined, joined, train_bank
from launch.status import STATUS_S
from replay.channels import FramePublisher, StatusPublisher
from replay.shards_writer import ShardedWriter
from replay.weights import WeightsSubscriber
from replay.wire import Weights
from sim.observation import observation_sizes

if TYPE_CHECKING:
    from launch.viewer import ViewerConfig

EPISODES: Final = 200  # that the reported rates are over
_WAIT_S: Final = 0.5  # between two looks at the reasons to stop
_FLUSH_S: Final = 0.5  # for the last rows, when the run may be gone already


@dataclass(frozen=True)
class ActorStatus:
    """What an actor says of itself: rates over its last episodes."""

    failed: deque[bool]
    scores: deque[float]
    progress: deque[float]
    began: float  # s, of `time.monotonic`

    @staticmethod
    def begin() -> "ActorStatus":
        """Nothing ended yet."""
        return ActorStatus(
            deque(maxlen=EPISODES),
            deque(maxlen=EPISODES),
            deque(maxlen=EPISODES),
            time.monotonic(),
        )

    def add(self, tick: Tick) -> None:
        """Counts the episodes that ended in a scan."""
        self.failed.extend(tick.failed.tolist())
        self.scores.extend(tick.scores.tolist())
        self.progress.extend(tick.progress[np.isfinite(tick.progress)].tolist())

    def rates(self) -> dict[str, float]:
        """Over the last episodes; nothing of what none has told yet."""
        rates: dict[str, float] = {}
        for name, kept in (
            ("failure_rate", self.failed),
            ("return", self.scores),
            ("progress", self.progress),
        ):
            if kept:
                rates[name] = float(np.mean(kept))
        return rates


def acting_config(config: ExperimentConfig) -> ActingConfig:
    """What the actors compile."""
    return ActingConfig(
        environment=config.environment,
        network=config.network,
        scan_steps=config.actor.scan_steps,
        watched=config.actor.watched,
        choose=choice_of(config.actor.objects, config.actor.slots),
        n_step=config.learner.n_step,
        discount=config.learner.discount,
    )


def policy_layout_hash(config: ExperimentConfig) -> str:
    """Of the weights that fit the run's network."""
    sizes = observation_sizes(config.environment.observation)
    layout = parameter_layout(config.network, sizes, config.environment.action.count)
    return layout_hash(layout)


def actor_role(join: JoinConfig, actor: int, stop: threading.Event) -> None:
    """Acts until asked to stop."""
    with joined(join, stop) as place:
        config = place.run.config
        if not 0 <= actor < config.actors:
            raise LaunchError(
                f"--actor {actor}: the run has actors 0 to {config.actors - 1}"
            )
        _act(place, actor, stop)


def _act(place: Joined, actor: int, stop: threading.Event) -> None:
    config = place.run.config
    # In milliseconds: it grows from one start of this actor to the next.
    epoch = time.time_ns() // 1_000_000
    spec = rows_of_run(config)
    bank = train_bank(place).bank
    subscriber = WeightsSubscriber(session=place.session, keys=place.keys)
    first = _first_weights(subscriber, policy_layout_hash(config), stop)
    if first is None:
        return
    directory = place.directory(spec, wanted=())
    writer = ShardedWriter(
        directory=directory,
        spec=spec,
        writer=actor,
        epoch=epoch,
        shards=config.shards,
        durable=config.replay.durable,
        window=config.actor.window,
        batch_rows=config.actor.environments * config.actor.scan_steps,
    )
    frames = FramePublisher(place.session, place.keys, actor)
    status = StatusPublisher(place.session, place.keys, f"actor-{actor}")

    def write(rows: np.ndarray) -> None:
        # They are one batch, so what did not fit is whole and offered again.
        while not writer.append(rows, _WAIT_S) and not stop.is_set():
            rows = rows[:0]

    def show(batch: FrameBatch) -> None:
        if frames.wanted:
            frames.put(encode_frames(batch))

    key = jax.random.fold_in(jax.random.key(config.seed), actor)
    ticks = run_actor(
        key=jax.random.fold_in(key, epoch % 2**31),
        bank=bank,
        config=acting_config(config),
        epsilon=exploration(config.actor, actor=actor, actors=config.actors),
        actor=actor,
        latest=lambda: subscriber.latest() or first,
        write=write,
        show=show,
    )
    _report_actor(ticks, status, writer, stop)
    writer.close(_FLUSH_S)
    directory.close()


def _first_weights(
    subscriber: WeightsSubscriber, expected: str, stop: threading.Event
) -> Weights | None:
    """Waits for the learner's first publication; None when asked to stop before."""
    while not stop.is_set():
        weights = subscriber.wait(_WAIT_S)
        if weights is None:
            continue
        if weights.layout_hash != expected:
            raise LaunchError(
                f"the learner's network has the layout {weights.layout_hash}, this "
                f"actor's {expected}: start both with one config.json"
            )
        return weights
    return None


def _report_actor(
    ticks: Iterator[Tick],
    status: StatusPublisher,
    writer: ShardedWriter,
    stop: threading.Event,
) -> None:
    """Drives the loop and publishes its counters."""
    counters = ActorStatus.begin()
    acted_s, due = 0.0, 0.0
    for tick in ticks:
        counters.add(tick)
        acted_s += tick.acted_s
        now = time.monotonic()
        if now >= due:
            due = now + STATUS_S
            status.put(
                {
                    "steps": tick.steps,
                    "acknowledged": writer.acknowledged,
                    "version": tick.version,
                    "uptime_s": now - counters.began,
                    "acted_s": acted_s,
                    "waited_s": writer.waited_s,
                    "resent": writer.resent,
                    **counters.rates(),
                }
            )
        if stop.is_set():
            return


def viewer_role(
    join: JoinConfig, viewer: "ViewerConfig", stop: threading.Event
) -> None:
    """Shows a run in progress in the browser until asked to stop."""
    from launch.bank_view import bank_scenes, labels_of
    from launch.viewer import Viewer
    from replay.channels import FrameSubscriber

    with joined(join, stop) as place:
        role = Viewer(
            source=FrameSubscriber(place.session, place.keys),
            scene_of=bank_scenes(train_bank(place)),
            actions=labels_of(place.run.config.environment.action),
            config=viewer,
            name=join.run_id,
        )
        print(f"open {role.url}", flush=True)
        role.run(stop, threading.Event())
