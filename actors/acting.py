"""Acting: K steps of M environments in one compiled scan, without return to the host.

Each step observes, evaluates the network's twin once for the whole batch, draws the
epsilon-greedy action, steps, and starts the environments whose episode is over anew.
The transition keeps the state before that restart.

An environment controls up to S objects of its scene, all by the one policy, each with
an episode of its own within the environment's. A transition of an object is there
(`present`) where it was recorded before and after the step, and its episode is over
(`over`)

- with a failure that terminates: the object drives on among the others, but nothing
  of it is learnt until its environment starts anew;
- where its recording ends, for now or for good: truncated;
- with its environment, which starts anew when the recording is at its end or no object
  is left that is recorded and has not failed.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from actors.network import NetworkConfig, batched
from sim import metrics
from sim.bank import Bank
from sim.environment import EnvironmentConfig, State, recorded, step
from sim.episodes import (
    Choice,
    NearestToSdc,
    auto_reset,
    draw,
    episode_over,
    sdc_only,
    starts,
)
from sim.observation import ObservationSizes, observation_sizes, observe_first_batch
from sim.world import View, row_of

Objects = Literal["sdc", "vehicles", "all"]


@dataclass(frozen=True)
class ActingConfig:
    """What an actor does."""

    environment: EnvironmentConfig
    """Simulation, observation and reward."""
    network: NetworkConfig
    """The network's sizes."""
    scan_steps: int
    """Steps per call (K)."""
    watched: int
    """Environments, the first ones, whose Q-values are handed out."""
    choose: Choice = sdc_only
    """The objects that an environment controls."""
    n_step: int = 1
    """Steps that a row spans."""
    discount: float = 1.0
    """Gamma, by which rows of several steps are summed."""

    @property
    def sizes(self) -> ObservationSizes:
        """The network's input sizes."""
        return observation_sizes(self.environment.observation)


class Running(NamedTuple):
    """M environments between two calls; `score` is the return so far, undiscounted."""

    state: State  # batched: every field has the axis `environments` in front
    score: Float[Array, "environments slots"]
    failed: Bool[Array, "environments slots"]  # an overlap or off-road so far
    ended: Bool[Array, "environments slots"]  # by a failure that terminates


class Transitions(NamedTuple):
    """K steps of S objects in M environments; from s_tm1 to s_t."""

    scene: Int[Array, "steps environments"]
    step: Int[Array, "steps environments"]  # t of s_t
    controlled: Int[Array, "steps environments slots"]
    states: Float[Array, "steps environments slots states 5"]
    valid: Bool[Array, "steps environments slots states"]
    action: Int[Array, "steps environments slots"]
    reward: Float[Array, "steps environments slots"]
    discount: Float[Array, "steps environments slots"]
    overlap: Bool[Array, "steps environments slots"]
    offroad: Bool[Array, "steps environments slots"]
    present: Bool[Array, "steps environments slots"]  # False: no transition
    over: Bool[Array, "steps environments slots"]  # its episode ended with s_t
    score: Float[Array, "steps environments slots"]  # return up to s_t
    failed: Bool[Array, "steps environments slots"]  # any failure up to s_t
    progress: Float[Array, "steps environments slots"]  # of the log's route; NaN: none
    q_values: Float[Array, "steps watched actions"]  # of their first objects


def epsilons(
    *, actor: int, actors: int, environments: int, lowest: float, highest: float
) -> Float[np.ndarray, " environments"]:
    """Log-spaced over all actors' environments; this actor has every n-th."""
    total = actors * environments
    if total == 1:
        return np.array([highest], np.float32)
    every = np.geomspace(highest, lowest, total, dtype=np.float64)
    return every[actor::actors].astype(np.float32)


def choice_of(objects: Objects, slots: int) -> Choice:
    """The recording vehicle, or it and the nearest vehicles that move, or all."""
    if objects == "sdc":
        return sdc_only
    vehicles = objects == "vehicles"
    return NearestToSdc(slots, moving=vehicles, vehicles=vehicles)


def own_first(slots: int) -> Int[np.ndarray, "slots slots"]:
    """For each slot the order in which it comes first and the others keep theirs."""
    return np.array(
        [[own, *(slot for slot in range(slots) if slot != own)] for own in range(slots)]
    )


def begin_of(bank: Bank, config: ActingConfig) -> State:
    """Every scene at its start, with what an environment controls there."""
    return starts(bank, config.choose, config.environment)


def start(key: PRNGKeyArray, begin: State, environments: int) -> Running:
    """M random scenes from their starts; `begin` is `begin_of`."""
    state = draw(key, begin, environments)
    return Running(
        state=state,
        score=jnp.zeros(state.controlled.shape),
        failed=jnp.zeros(state.controlled.shape, bool),
        ended=jnp.zeros(state.controlled.shape, bool),
    )


def act(
    key: PRNGKeyArray,
    bank: Bank,
    begin: State,
    vector: Float[Array, " parameters"],
    running: Running,
    epsilon: Float[Array, " environments"],
    config: ActingConfig,
) -> tuple[Running, Transitions]:
    """K steps of all environments. Compile with `config` static.

    `begin` is made once (`begin_of`): it takes 0.35 ms for 64 scenes and 4.5 for 2,000,
    where a scan of 8 steps of 16 environments takes 5.
    """

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
    q_values = _q_values(bank, vector, state, config)
    greedy = jnp.argmax(q_values, -1).astype(jnp.int32)
    actions = environment.action.count
    drawn = jax.random.randint(random_key, greedy.shape, 0, actions, jnp.int32)
    explore = jax.random.uniform(explore_key, greedy.shape) < epsilon[:, None]
    action = jnp.where(explore, drawn, greedy)
    state_t, outcome = jax.vmap(step, in_axes=(None, 0, 0, None))(
        bank, state, action, environment
    )
    present = state.history_valid[..., -1] & outcome.valid & ~running.ended
    score = running.score + jnp.where(present, outcome.reward, 0.0)
    failed = running.failed | (present & (outcome.overlap | outcome.offroad))
    ended = running.ended | (present & outcome.terminated)
    outcome = outcome._replace(terminated=ended)
    starts_anew = episode_over(outcome)[:, None]
    following = jnp.minimum(state_t.step + 1, bank.log.shape[1] - 1)
    goes_on = jax.vmap(recorded, in_axes=(None, 0, 0, 0))(
        bank, state_t.scene, following, state_t.controlled
    )
    over = present & (ended | starts_anew | ~goes_on)
    transitions = Transitions(
        scene=state.scene,
        step=state_t.step,
        controlled=state.controlled,
        states=jnp.concatenate([state.history, state_t.history[:, :, -1:]], 2),
        valid=jnp.concatenate(
            [state.history_valid, state_t.history_valid[:, :, -1:]], 2
        ),
        action=action,
        reward=outcome.reward,
        discount=1.0 - ended.astype(jnp.float32),
        overlap=outcome.overlap,
        offroad=outcome.offroad,
        present=present,
        over=over,
        score=score,
        failed=failed,
        progress=_progress(bank, state_t),
        q_values=q_values[: config.watched, 0],
    )
    after = Running(
        state=auto_reset(reset_key, begin, state_t, outcome),
        score=jnp.where(over | starts_anew, 0.0, score),
        failed=failed & ~(over | starts_anew),
        ended=ended & ~starts_anew,
    )
    return after, transitions


def _q_values(
    bank: Bank, vector: Float[Array, " parameters"], state: State, config: ActingConfig
) -> Float[Array, "environments slots actions"]:
    """Of all slots; every object is observed on its own, as rows are rendered."""
    environments, slots = state.controlled.shape
    order = own_first(slots)

    def each(values: Array) -> Array:
        return values[:, order].reshape(-1, *values.shape[1:])

    view = View(
        scene=jnp.repeat(state.scene, slots),
        step=jnp.repeat(state.step, slots),
        controlled=each(state.controlled),
        history=each(state.history),
        history_valid=each(state.history_valid),
    )
    values = batched(
        vector,
        observe_first_batch(bank, view, config.environment.observation),
        config=config.network,
        sizes=config.sizes,
        actions=config.environment.action.count,
    )
    return values.reshape(environments, slots, -1)


def _progress(bank: Bank, state: State) -> Float[Array, "environments slots"]:
    of_scene = jax.vmap(metrics.progress, in_axes=(None, None, 0, 0))
    return jax.vmap(of_scene, in_axes=(None, 0, 0, 0))(
        bank, state.scene, row_of(bank, state.controlled), state.along
    )
