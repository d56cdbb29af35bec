"""Reset, step and observe: one scene with some objects controlled, the rest replayed.

Written for one scene; `jax.vmap` over scenes outside. A scene starts at the bank's
`current_step` from the log's states; every later step moves the controlled objects by
the action space's dynamics and all others to where they were recorded.

Reward of the step from t-1 to t (Gulino et al., 2023, main text): minus overlap minus
off-road at t. `progress` (off in the paper's preset) adds the metres gained along the
logged route, since the paper's reward alone is satisfied by standing still. Metres
ahead of where the log was at that step count against it, or speeding, tailgating and
running red lights would pay. All count 1 - (aside / `progress_width`)^2, not below 0,
where `aside` is the distance from the route. `comfort` (off, too) takes from the reward
the size of the acceleration, the change of the velocity's vector over the step's
length, of objects that do not follow the log: braking, throttle and turning alike.

Terminated is what ends the return (a failure, where `terminate` says so); truncated is
the recording's end, after which there was more to come: only the first has discount 0.
The paper does not say whether a failure ends an episode.

Heights are not simulated: an object has its log's height of the same step. Where the
controlled object was not recorded at t-1 and t it follows the log. Controlled objects
are seen and judged where they are simulated, also by one another. Slots of `controlled`
may be empty (`sim.world`): they are never valid and never fail.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim import metrics
from sim.bank import Bank
from sim.dynamics import ActionConfig, ObjectState, apply_discrete
from sim.observation import Observation, ObservationConfig, observe
from sim.world import View, exists, row_of


@dataclass(frozen=True)
class EnvironmentConfig:
    """What a controlled object does, sees and is rewarded for."""

    action: ActionConfig = field(default_factory=ActionConfig)
    """The grid of actions."""
    observation: ObservationConfig = field(default_factory=ObservationConfig)
    """What it sees."""
    overlap_penalty: float = 1.0
    """Subtracted from the reward at a step with an overlap."""
    offroad_penalty: float = 1.0
    """Subtracted from the reward at a step off the road."""
    progress: float = 0.0
    """Reward per metre gained along the logged route; 0 is the paper's."""
    progress_width: float = 4.0
    """Distance aside from the route [m] at which progress counts for nothing."""
    comfort: float = 0.0
    """Subtracted from the reward per m/s^2 of acceleration; 0 is the paper's."""
    terminate: bool = False
    """Whether a failure (overlap or off-road) ends the episode."""
    dt: float = 0.1
    """Length of a step [s]; a bank of another step length is refused."""


class State(NamedTuple):
    """One scene; batch with `jax.vmap`."""

    scene: Int[Array, ""]  # row of the bank
    step: Int[Array, ""]  # of the recording
    controlled: Int[Array, " controlled"]  # rows of the log's objects, or its length
    history: Float[Array, "controlled history 5"]  # x, y, yaw, v_x, v_y; oldest first
    history_valid: Bool[Array, "controlled history"]
    along: Float[Array, " controlled"]  # m, arc length on the logged route

    @property
    def view(self) -> View:
        """What is observed of it."""
        return View(
            self.scene, self.step, self.controlled, self.history, self.history_valid
        )


class Outcome(NamedTuple):
    """What a step led to, for each controlled object."""

    reward: Float[Array, " controlled"]
    overlap: Bool[Array, " controlled"]
    offroad: Bool[Array, " controlled"]
    terminated: Bool[Array, " controlled"]
    truncated: Bool[Array, ""]
    valid: Bool[Array, " controlled"]  # recorded at this step: it counts


class Judgement(NamedTuple):
    """The benchmark's metrics of the controlled objects at one step.

    Where an object was not recorded at this step they are False and 0; infeasible is
    only what was recorded at the step before, too.
    """

    overlap: Bool[Array, " controlled"]
    offroad: Bool[Array, " controlled"]
    log_divergence: Float[Array, " controlled"]  # m
    kinematic_infeasibility: Bool[Array, " controlled"]


def logged_states(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, " controlled"],
) -> Float[Array, "controlled 5"]:
    """States (x, y, yaw, v_x, v_y) of the log; 0 in an empty slot."""
    row = bank.log[scene, step, row_of(bank, controlled)]
    state = jnp.stack([row[:, 0], row[:, 1], row[:, 3], row[:, 4], row[:, 5]], -1)
    return jnp.where(exists(bank, controlled)[:, None], state, 0.0)


def recorded(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, " controlled"],
) -> Bool[Array, " controlled"]:
    """Whether the log has the objects at this step."""
    valid = bank.log_valid[scene, step, row_of(bank, controlled)]
    return valid & exists(bank, controlled)


def current_objects(
    bank: Bank, state: State
) -> tuple[Float[Array, "objects 5"], Bool[Array, " objects"]]:
    """All objects' states now, and which are there: simulated where controlled."""
    row = bank.log[state.scene, state.step]
    logged = jnp.stack([row[:, 0], row[:, 1], row[:, 3], row[:, 4], row[:, 5]], -1)
    now = logged.at[state.controlled].set(state.history[:, -1], mode="drop")
    return now, bank.log_valid[state.scene, state.step]


def reset(
    bank: Bank,
    scene: Int[Array, ""],
    controlled: Int[Array, " controlled"],
    config: EnvironmentConfig,
) -> State:
    """The scene at its `current_step`, with the recorded history."""
    return start_at(bank, scene, bank.current_step[scene], controlled, config)


def start_at(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, " controlled"],
    config: EnvironmentConfig,
) -> State:
    """The scene at any recorded step; history before step 0 is not valid."""
    wanted = step - jnp.arange(config.observation.history - 1, -1, -1)
    steps = jnp.maximum(wanted, 0)
    axes = (None, None, 0, None)
    history = jax.vmap(logged_states, axes, 1)(bank, scene, steps, controlled)
    valid = jax.vmap(recorded, axes, 1)(bank, scene, steps, controlled)
    now = history[:, -1]
    return State(
        scene=scene,
        step=step,
        controlled=controlled,
        history=history,
        history_valid=valid & (wanted >= 0)[None],
        along=_position(bank, scene, controlled, now).along,
    )


def step(
    bank: Bank,
    state: State,
    action: Int[Array, " controlled"],
    config: EnvironmentConfig,
) -> tuple[State, Outcome]:
    """Applies one discrete action to each controlled object."""
    moved = jax.vmap(apply_discrete, in_axes=(0, 0, None, None))(
        ObjectState(*state.history[:, -1].T), action, config.action, config.dt
    )
    return advance(bank, state, jnp.stack(moved, -1), config)


def advance(
    bank: Bank,
    state: State,
    moved: Float[Array, "controlled 5"],
    config: EnvironmentConfig,
) -> tuple[State, Outcome]:
    """Puts the controlled objects where their dynamics (any) say, and judges it."""
    step_t = jnp.minimum(state.step + 1, bank.log.shape[1] - 1)
    valid = recorded(bank, state.scene, step_t, state.controlled)
    follows = state.history_valid[:, -1] & valid
    now = jnp.where(
        follows[:, None],
        moved,
        logged_states(bank, state.scene, step_t, state.controlled),
    )
    overlap, offroad = failures(bank, state.scene, step_t, state.controlled, now)
    position = _position(bank, state.scene, state.controlled, now)
    reward = jnp.where(overlap, -config.overlap_penalty, 0.0)
    reward += jnp.where(offroad, -config.offroad_penalty, 0.0)
    if config.progress:  # two searches of every route, of no use to the paper's reward
        gained = _credit(bank, state.scene, step_t, state.controlled, position.along)
        gained -= _credit(bank, state.scene, state.step, state.controlled, state.along)
        near = jnp.maximum(1.0 - (position.aside / config.progress_width) ** 2, 0.0)
        reward += config.progress * gained * near
    if config.comfort:
        changed = now[:, 3:] - state.history[:, -1, 3:]
        acceleration = jnp.hypot(changed[:, 0], changed[:, 1]) / config.dt
        reward -= config.comfort * jnp.where(follows, acceleration, 0.0)
    last = step_t >= bank.steps[state.scene] - 1
    following = State(
        scene=state.scene,
        step=step_t,
        controlled=state.controlled,
        history=jnp.concatenate([state.history[:, 1:], now[:, None]], 1),
        history_valid=jnp.concatenate([state.history_valid[:, 1:], valid[:, None]], 1),
        along=position.along,
    )
    return following, Outcome(
        reward=reward,
        overlap=overlap,
        offroad=offroad,
        terminated=(overlap | offroad) & config.terminate,
        truncated=last | ~valid.any(),
        valid=valid,
    )


def _credit(
    bank: Bank,
    scene: Int[Array, ""],
    step: Int[Array, ""],
    controlled: Int[Array, " controlled"],
    along: Float[Array, " controlled"],
) -> Float[Array, " controlled"]:
    """Metres along the routes, less those ahead of where the log was at the step."""
    logged = logged_states(bank, scene, step, controlled)
    ahead = along - _position(bank, scene, controlled, logged).along
    return along - 2.0 * jnp.maximum(ahead, 0.0)


def _position(
    bank: Bank,
    scene: Int[Array, ""],
    controlled: Int[Array, " controlled"],
    state: Float[Array, "controlled 5"],
) -> metrics.RoutePosition:
    """Where the objects are on their routes."""
    return jax.vmap(metrics.route_position, in_axes=(None, None, 0, 0, 0))(
        bank, scene, row_of(bank, controlled), state[:, 0], state[:, 1]
    )


def failures(
    bank: Bank,
    scene: Int[Array, ""],
    step_t: Int[Array, ""],
    controlled: Int[Array, " controlled"],
    now: Float[Array, "controlled 5"],
) -> tuple[Bool[Array, " controlled"], Bool[Array, " controlled"]]:
    """Overlap and off-road of the controlled objects, the others where the log is."""
    row = bank.log[scene, step_t]
    own = row_of(bank, controlled)
    boxes = metrics.Box(
        x=row[:, 0].at[controlled].set(now[:, 0], mode="drop"),
        y=row[:, 1].at[controlled].set(now[:, 1], mode="drop"),
        yaw=row[:, 3].at[controlled].set(now[:, 2], mode="drop"),
        length=row[:, 6],
        width=row[:, 7],
    )
    valid = bank.log_valid[scene, step_t]
    overlap = jax.vmap(metrics.overlap, in_axes=(0, None, None))(own, boxes, valid)
    offroad = jax.vmap(metrics.offroad, in_axes=(None, None, 0, 0))(
        bank, scene, metrics.Box(*(value[own] for value in boxes)), row[own, 2]
    )
    there = recorded(bank, scene, step_t, controlled)
    return overlap & there, offroad & there


def judge(
    bank: Bank,
    state_tm1: State,
    state_t: State,
    dt: float,
    outcome: Outcome | None = None,
) -> Judgement:
    """All metrics of the step that led from one state to the next, `dt` seconds.

    `outcome`, where `advance` gave it for this very step, spares looking for overlap
    and off-road again.
    """
    before, now = state_tm1.history[:, -1], state_t.history[:, -1]
    place = (bank, state_t.scene, state_t.step, state_t.controlled)
    valid = recorded(*place)
    if outcome is None:
        overlap, offroad = failures(*place, now)
    else:
        overlap, offroad = outcome.overlap, outcome.offroad
    logged = logged_states(*place)
    divergence = jax.vmap(metrics.log_divergence)(
        now[:, 0], now[:, 1], logged[:, 0], logged[:, 1]
    )
    infeasible = jax.vmap(metrics.kinematic_infeasibility, in_axes=(0, 0, None))(
        ObjectState(*before.T), ObjectState(*now.T), dt
    )
    return Judgement(
        overlap=overlap,
        offroad=offroad,
        log_divergence=jnp.where(valid, divergence, 0.0),
        kinematic_infeasibility=infeasible & valid & state_tm1.history_valid[:, -1],
    )


def observe_state(bank: Bank, state: State, config: EnvironmentConfig) -> Observation:
    """What each controlled object sees; axis `controlled` in front."""
    return observe(bank, state.view, config.observation)
