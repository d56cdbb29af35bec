"""Acting: K steps of M environments in one compiled scan, without return to the host.

Each step observes, evaluates the network's twin once for the whole batch, draws the
epsilon-greedy action, steps, and starts the environments whose episode is over anew.
The transition keeps the state before that restart.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from actors.network import NetworkConfig, batched
from sim import metrics
from sim.bank import Bank
from sim.environment import EnvironmentConfig, State, step
from sim.episodes import auto_reset, draw, episode_over, sdc_only, starts
from sim.observation import ObservationSizes, observation_sizes, observe_batch


@dataclass(frozen=True)
class ActingConfig:
    """What is compiled into the scan."""

    environment: EnvironmentConfig
    """Simulation, observation and reward."""
    network: NetworkConfig
    """The network's sizes."""
    scan_steps: int
    """Steps per call (K)."""
    watched: int
    """Environments, the first ones, whose Q-values are handed out."""

    @property
    def sizes(self) -> ObservationSizes:
        """The network's input sizes."""
        return observation_sizes(self.environment.observation)


class Running(NamedTuple):
    """M environments between two calls; `score` is the return so far, undiscounted."""

    state: State  # batched: every field has the axis `environments` in front
    score: Float[Array, " environments"]
    failed: Bool[Array, " environments"]  # an overlap or off-road so far


class Transitions(NamedTuple):
    """K steps of M environments; `_tm1` is before the step, `_t` after it."""

    scene: Int[Array, "steps environments"]
    step: Int[Array, "steps environments"]  # t of s_t
    controlled: Int[Array, "steps environments"]
    states: Float[Array, "steps environments states 5"]
    valid: Bool[Array, "steps environments states"]
    action: Int[Array, "steps environments"]
    reward: Float[Array, "steps environments"]
    discount: Float[Array, "steps environments"]
    overlap: Bool[Array, "steps environments"]
    offroad: Bool[Array, "steps environments"]
    over: Bool[Array, "steps environments"]  # the episode ended with s_t
    score: Float[Array, "steps environments"]  # return up to s_t
    failed: Bool[Array, "steps environments"]  # any failure up to s_t
    progress: Float[Array, "steps environments"]  # of the log's route; NaN: none
    q_values: Float[Array, "steps watched actions"]  # of the first environments


def epsilons(
    *, actor: int, actors: int, environments: int, lowest: float, highest: float
) -> Float[np.ndarray, " environments"]:
    """Log-spaced over all actors' environments; this actor has every n-th."""
    total = actors * environments
    if total == 1:
        return np.array([highest], np.float32)
    every = np.geomspace(highest, lowest, total, dtype=np.float64)
    return every[actor::actors].astype(np.float32)


def start(
    key: PRNGKeyArray, bank: Bank, environments: int, config: EnvironmentConfig
) -> Running:
    """M random scenes from their starts."""
    return Running(
        state=draw(key, starts(bank, sdc_only, config), environments),
        score=jnp.zeros(environments),
        failed=jnp.zeros(environments, bool),
    )


def act(
    key: PRNGKeyArray,
    bank: Bank,
    vector: Float[Array, " parameters"],
    running: Running,
    epsilon: Float[Array, " environments"],
    config: ActingConfig,
) -> tuple[Running, Transitions]:
    """K steps of all environments. Compile with `config` static."""

    begin = starts(bank, sdc_only, config.environment)

    def one(carry: Running, step_key: PRNGKeyArray) -> tuple[Running, Transitions]:
        return _step(step_key, bank, begin, vector, carry, epsilon, config)

    return jax.lax.scan(one, running, jax.random.split(key, config.scan_steps))


def _step(
    key: PRNGKeyArray,
    bank: Bank,
    begin: State,
    vector: Float[Array, " parameters"],
    running: Running,
    epsilon: Float[Array, " environments"],
    config: ActingConfig,
) -> tuple[Running, Transitions]:
    state, environment = running.state, config.environment
    explore_key, random_key, reset_key = jax.random.split(key, 3)
    observation = observe_batch(bank, state.view, environment.observation)
    observation = jax.tree.map(lambda values: values[:, 0], observation)
    actions = environment.action.count
    q_values = batched(
        vector, observation, config=config.network, sizes=config.sizes, actions=actions
    )
    greedy = jnp.argmax(q_values, -1).astype(jnp.int32)
    drawn = jax.random.randint(random_key, greedy.shape, 0, actions, jnp.int32)
    explore = jax.random.uniform(explore_key, greedy.shape) < epsilon
    action = jnp.where(explore, drawn, greedy)
    state_t, outcome = jax.vmap(step, in_axes=(None, 0, 0, None))(
        bank, state, action[:, None], environment
    )
    score = running.score + outcome.reward[:, 0]
    failed = running.failed | outcome.overlap[:, 0] | outcome.offroad[:, 0]
    over = episode_over(outcome)
    progress = jax.vmap(metrics.progress, in_axes=(None, 0, 0, 0))(
        bank, state_t.scene, state_t.controlled[:, 0], state_t.along[:, 0]
    )
    transitions = Transitions(
        scene=state.scene,
        step=state_t.step,
        controlled=state.controlled[:, 0],
        states=jnp.concatenate([state.history[:, 0], state_t.history[:, 0, -1:]], 1),
        valid=jnp.concatenate(
            [state.history_valid[:, 0], state_t.history_valid[:, 0, -1:]], 1
        ),
        action=action,
        reward=outcome.reward[:, 0],
        discount=1.0 - outcome.terminated[:, 0].astype(jnp.float32),
        overlap=outcome.overlap[:, 0],
        offroad=outcome.offroad[:, 0],
        over=over,
        score=score,
        failed=failed,
        progress=progress,
        q_values=q_values[: config.watched],
    )
    after = Running(
        state=auto_reset(reset_key, begin, state_t, outcome),
        score=jnp.where(over, 0.0, score),
        failed=failed & ~over,
    )
    return after, transitions
