"""The acting loop: scan, hand the transitions over, take the latest weights, repeat.

A generator, so that stopping, logging and status belong to the caller. Writing blocks
while the window of unacknowledged batches is full: that is how the replay's rate
limiter slows its actors down. Weights change between two scans only, and every
transition carries the version that it was made with.
"""

import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from actors import acting
from actors.acting import ActingConfig, Objects, Transitions
from actors.frames import FrameBatch, make_frames
from actors.windows import Windows
from sim.bank import Bank


@dataclass(frozen=True)
class ActorConfig:
    """How an actor acts."""

    environments: int = 32
    """Environments stepped at once (M)."""
    objects: Objects = "sdc"
    """Whom an environment controls: the recording vehicle, it and other vehicles that
    move, or all; further ones the nearest first. The paper's is the first."""
    slots: int = 6
    """Objects that an environment controls at most; not read where it is the SDC.
    Every row holds the states of them all: 576 bytes for 6, 768 for 8."""
    scan_steps: int = 8
    """Steps per compiled call, and per batch of rows sent (K)."""
    epsilon_lowest: float = 0.01
    """Probability of a random action in the least exploring environment."""
    epsilon_highest: float = 0.4
    """And in the most exploring one; log-spaced between, over all actors."""
    window: int = 4
    """Batches that may be under way to the replay without an acknowledgement."""
    watched: int = 1
    """Environments whose frames a viewer can see."""

    def __post_init__(self) -> None:
        """Refuses what makes no environment or no exploration schedule."""
        for name in ("environments", "scan_steps", "window", "slots"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if not 0 <= self.watched <= self.environments:
            raise ValueError(
                f"watched={self.watched} must be 0 to {self.environments} environments"
            )
        if not 0 < self.epsilon_lowest <= self.epsilon_highest <= 1:
            raise ValueError(
                f"epsilon_lowest={self.epsilon_lowest} and epsilon_highest="
                f"{self.epsilon_highest} must satisfy 0 < lowest <= highest <= 1"
            )


def exploration(
    config: ActorConfig, *, actor: int, actors: int
) -> Float[np.ndarray, " environments"]:
    """The epsilons of one of the run's actors."""
    return acting.epsilons(
        actor=actor,
        actors=actors,
        environments=config.environments,
        lowest=config.epsilon_lowest,
        highest=config.epsilon_highest,
    )


@runtime_checkable
class Weights(Protocol):
    """What the weights channel hands over."""

    @property
    def version(self) -> int:
        """The number of updates behind them."""

    @property
    def vector(self) -> Float[np.ndarray, " parameters"]:
        """The weights."""


class Tick(NamedTuple):
    """One scan, as the caller sees it."""

    steps: int  # transitions of controlled objects so far
    version: int  # of the weights acted with
    scores: Float[np.ndarray, " ended"]  # returns of the episodes that ended
    failed: np.ndarray  # [ended] bool: an overlap or off-road within it
    progress: Float[np.ndarray, " ended"]  # of the log's route; NaN: the log stood
    acted_s: float  # in the scan
    waited_s: float  # handing over the rows


def run_actor(
    *,
    key: PRNGKeyArray,
    bank: Bank,
    config: ActingConfig,
    epsilon: Float[np.ndarray, " environments"],
    actor: int,
    latest: Callable[[], Weights],
    write: Callable[[np.ndarray], object],
    show: Callable[[FrameBatch], object] | None = None,
) -> Iterator[Tick]:
    """Acts for ever.

    Args:
        key: of this actor and of this start of it.
        bank: the scenes.
        config: what is compiled.
        epsilon: probability of a random action per environment (`acting.epsilons`).
        actor: this actor's number, from 0.
        latest: the newest weights; called between scans.
        write: takes a batch of as many rows as a scan has steps of environments;
            blocks while the replay holds back. Several, one or none after a scan
            where rows are of n steps or of several objects.
        show: takes the watched environments' frames, where somebody watches.
    """
    start_key, key = jax.random.split(key)
    act = jax.jit(functools.partial(acting.act, config=config))
    begin = acting.begin_of(bank, config)
    running = jax.jit(acting.start, static_argnums=2)(start_key, begin, len(epsilon))
    windows = Windows(n_step=config.n_step, discount=config.discount, actor=actor)
    batch_rows = len(epsilon) * config.scan_steps
    version, vector, chances = -1, jnp.zeros(0), jnp.asarray(epsilon)
    steps = 0
    while True:
        weights = latest()
        if weights.version != version:
            version, vector = weights.version, _on_device(weights.vector)
        began = time.perf_counter()
        key, scan_key = jax.random.split(key)
        running, batch = act(scan_key, bank, begin, vector, running, chances)
        # The one wait for the device, and the one transfer, of a scan.
        transitions: Transitions = jax.device_get(batch)
        acted = time.perf_counter()
        steps += int(transitions.present.sum())
        for rows in windows.batches(transitions, version, batch_rows):
            write(rows)
        if show is not None:
            for environment in range(config.watched):
                show(frames_of(transitions, environment, actor, steps, version))
        ended = np.asarray(transitions.over)
        yield Tick(
            steps=steps,
            version=version,
            scores=np.asarray(transitions.score)[ended],
            failed=np.asarray(transitions.failed)[ended],
            progress=np.asarray(transitions.progress)[ended],
            acted_s=acted - began,
            waited_s=time.perf_counter() - acted,
        )


def _on_device(vector: Float[np.ndarray, " n"]) -> Float[Array, " n"]:
    # A copy of its own: `device_put` may alias a receive buffer that is used again.
    return jnp.array(np.array(vector, np.float32, copy=True))


def frames_of(
    transitions: Transitions, environment: int, actor: int, steps: int, version: int
) -> FrameBatch:
    """What a viewer needs of one watched environment: its first object."""
    column = jax.tree.map(
        lambda values: np.asarray(values)[:, environment], transitions
    )
    return FrameBatch(
        actor=actor,
        environment=environment,
        actor_steps=steps,
        weights_version=version,
        frames=make_frames(
            len(column.scene),
            scene=column.scene,
            step=column.step,
            controlled=column.controlled[:, 0],
            state=column.states[:, 0, -1],
            action=column.action[:, 0],
            reward=column.reward[:, 0],
            progress=np.nan_to_num(column.progress[:, 0]),
            overlap=column.overlap[:, 0],
            offroad=column.offroad[:, 0],
        ),
        q_values=column.q_values,
    )
