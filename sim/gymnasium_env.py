"""The simulator as Gymnasium environments, for users who bring their own learner.

`DrivingEnv` is one scene with its recording vehicle (the SDC) controlled and all others
replayed; `DrivingVectorEnv` is a batch of them stepped by one compiled call, which is
how to be fast. Both draw scenes from a bank; their reward, observation, termination and
truncation are `sim.environment`'s.

An observation is a dictionary of `sim.observation.Observation`'s fields: float32
arrays, and int8 masks of 0 and 1 that say which rows of them hold something
(`gymnasium.wrappers.FlattenObservation` makes one vector of it). An action is an index
into the grid of `EnvironmentConfig.action`, or with `continuous=True` a vector in that
grid's space and limits: (a [m/s^2], kappa [1/m]) for Bicycle, (dx ahead [m], dy to the
left [m], dyaw [rad]) in the vehicle's own frame for Delta. What is beyond the limits is
clipped to them.
"""

import functools
from typing import Any, NamedTuple, final

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Array, Bool, Float, Int

from sim import metrics
from sim.bank import Bank, BankError, BankFile
from sim.dynamics import ObjectState, action_table, apply_continuous, apply_discrete
from sim.environment import (
    EnvironmentConfig,
    State,
    advance,
    logged_states,
)
from sim.episodes import sdc_only, starts
from sim.observation import Observation, observation_sizes, observe_batch

Observed = dict[str, np.ndarray]


class StepInfo(NamedTuple):
    """What a step says beside its reward; Gymnasium's `info`, one entry a field."""

    scene: Int[Array, " environments"]  # row of the bank
    step: Int[Array, " environments"]  # of the recording
    overlap: Bool[Array, " environments"]
    offroad: Bool[Array, " environments"]
    log_divergence: Float[Array, " environments"]  # m, NaN where not recorded
    progress: Float[Array, " environments"]  # of the logged route, NaN: it has none


class _Stepped(NamedTuple):
    """What comes back from the compiled step."""

    state: State
    observation: Observation
    reward: Float[Array, " environments"]
    terminated: Bool[Array, " environments"]
    truncated: Bool[Array, " environments"]
    info: StepInfo


@functools.partial(jax.jit, static_argnames="config")
def _start(
    bank: Bank,
    begin: State,
    scene: Int[Array, " environments"],
    before: State | None,
    mask: Bool[Array, " environments"],
    config: EnvironmentConfig,
) -> tuple[State, Observation, StepInfo]:
    """The masked environments at the start of these scenes, the others as before.

    Without a `before` all of them start.
    """
    state = jax.tree.map(lambda values: values[scene], begin)
    if before is not None:
        state = _chosen(mask, state, before)
    nothing = jnp.zeros(scene.shape, bool)
    return state, _seen(bank, state, config), _info(bank, state, nothing, nothing)


@functools.partial(jax.jit, static_argnames="config")
def _step(
    bank: Bank,
    begin: State,
    scene: Int[Array, " environments"],
    state: State,
    over: Bool[Array, " environments"],
    action: Array,
    config: EnvironmentConfig,
) -> _Stepped:
    """Steps those that go on; those that are over start in their `scene` instead."""

    def move(
        now: Float[Array, "5"], chosen: Int[Array, ""] | Float[Array, " components"]
    ) -> Float[Array, "5"]:
        apply = apply_continuous if chosen.ndim else apply_discrete
        moved = apply(ObjectState(*now), chosen, config.action, config.dt)
        return jnp.stack(moved)

    moved = jax.vmap(move)(state.history[:, 0, -1], action)
    stepped, outcome = jax.vmap(advance, in_axes=(None, 0, 0, None))(
        bank, state, moved[:, None], config
    )
    fresh = jax.tree.map(lambda values: values[scene], begin)
    following = _chosen(over, fresh, stepped)
    overlap, offroad = outcome.overlap[:, 0] & ~over, outcome.offroad[:, 0] & ~over
    return _Stepped(
        state=following,
        observation=_seen(bank, following, config),
        reward=jnp.where(over, 0.0, outcome.reward[:, 0]),
        terminated=outcome.terminated[:, 0] & ~over,
        truncated=outcome.truncated & ~over,
        info=_info(bank, following, overlap, offroad),
    )


def _chosen(mask: Bool[Array, " environments"], new: State, old: State) -> State:
    """The new state where the mask is set."""

    def choose(one: Array, other: Array) -> Array:
        return jnp.where(mask.reshape(-1, *[1] * (one.ndim - 1)), one, other)

    return jax.tree.map(choose, new, old)


def _seen(bank: Bank, state: State, config: EnvironmentConfig) -> Observation:
    """What the one controlled object of each environment sees."""
    seen = observe_batch(bank, state.view, config.observation)
    return jax.tree.map(lambda values: values[:, 0], seen)


def _info(
    bank: Bank,
    state: State,
    overlap: Bool[Array, " environments"],
    offroad: Bool[Array, " environments"],
) -> StepInfo:
    def one(state: State) -> tuple[Float[Array, ""], Float[Array, ""]]:
        now = state.history[0, -1]
        logged = logged_states(bank, state.scene, state.step, state.controlled)[0]
        away = metrics.log_divergence(now[0], now[1], logged[0], logged[1])
        away = jnp.where(state.history_valid[0, -1], away, jnp.nan)
        share = metrics.progress(bank, state.scene, state.controlled[0], state.along[0])
        return away, share

    away, share = jax.vmap(one)(state)
    return StepInfo(state.scene, state.step, overlap, offroad, away, share)


def _action_space(config: EnvironmentConfig, continuous: bool) -> spaces.Space[Any]:
    if not continuous:
        return spaces.Discrete(config.action.count)
    table = action_table(config.action)
    return spaces.Box(table.min(0), table.max(0), dtype=np.float32)


def _observation_space(config: EnvironmentConfig) -> spaces.Space[Any]:
    sizes = observation_sizes(config.observation)
    rows = {
        "agents": (sizes.neighbours, sizes.agent),
        "road": (sizes.rows, sizes.road),
        "lights": (sizes.lights, sizes.light),
    }
    parts: dict[str, spaces.Space[Any]] = {
        "ego": spaces.Box(-np.inf, np.inf, (sizes.ego,), np.float32)
    }
    for name, shape in rows.items():
        parts[name] = spaces.Box(-np.inf, np.inf, shape, np.float32)
        parts[f"{name}_valid"] = spaces.MultiBinary(shape[0])
    return spaces.Dict(parts)


def _as_numpy(observation: Observation) -> Observed:
    """Copies that the user may keep and write to."""
    return {
        name: np.array(value, np.int8 if value.dtype == jnp.bool_ else np.float32)
        for name, value in observation._asdict().items()
    }


@final
class _Simulator:
    """A batch of environments and its random numbers; both classes below have one."""

    def __init__(
        self,
        file: BankFile,
        config: EnvironmentConfig,
        *,
        environments: int,
        continuous: bool,
        restarts: bool,
    ) -> None:
        if abs(file.dt - config.dt) > 1e-6:
            raise BankError(
                f"bank {file.path} has steps of {file.dt} s, the environment of "
                f"{config.dt} s; set EnvironmentConfig.dt to the bank's"
            )
        self.action_space = _action_space(config, continuous)
        self.observation_space = _observation_space(config)
        self._file, self._bank, self._config = file, file.bank, config
        self._environments, self._restarts = environments, restarts
        self._begin = starts(self._bank, sdc_only, config)
        self._random = np.random.default_rng()
        self._state: State | None = None
        self._over = np.zeros(environments, bool)

    def seed(self, seed: int) -> None:
        """Scenes are drawn from here on as this seed has it."""
        self._random = np.random.default_rng(seed)

    def start(self, options: dict[str, Any]) -> tuple[Observed, dict[str, np.ndarray]]:
        """Environments anew: all, or those of the option `reset_mask`.

        In the bank's row that the option `scene` names, or in drawn ones.
        """
        scene = int(options.get("scene", -1))
        mask = np.asarray(options.get("reset_mask", np.ones(self._environments)), bool)
        if not -1 <= scene < self._file.scenes:
            raise ValueError(
                f"scene {scene}: the bank {self._file.path} has scenes 0 to "
                f"{self._file.scenes - 1}"
            )
        scenes = self._drawn() if scene < 0 else np.full(len(mask), scene, np.int32)
        self._over = self._over & ~mask
        before = None if mask.all() else self._state
        self._state, observation, info = _start(
            self._bank, self._begin, scenes, before, mask, self._config
        )
        return _as_numpy(observation), self._named(info)

    def step(
        self, action: np.ndarray
    ) -> tuple[Observed, np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """One step of all; see `_step`."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if isinstance(self.action_space, spaces.Box):
            space = self.action_space
            action = np.clip(np.asarray(action, np.float32), space.low, space.high)
        elif ((action < 0) | (action >= self._config.action.count)).any():
            raise gymnasium.error.InvalidAction(
                f"action {action}: must be 0 to {self._config.action.count - 1}"
            )
        else:
            action = np.asarray(action, np.int32)
        result = _step(
            self._bank,
            self._begin,
            self._drawn(),
            self._state,
            self._over,
            action,
            self._config,
        )
        self._state = result.state
        reward = np.array(result.reward, np.float64)
        terminated = np.array(result.terminated)
        truncated = np.array(result.truncated)
        if self._restarts:
            self._over = terminated | truncated
        observation = _as_numpy(result.observation)
        return observation, reward, terminated, truncated, self._named(result.info)

    def _drawn(self) -> Int[np.ndarray, " environments"]:
        """Scenes to start in."""
        drawn = self._random.integers(self._file.scenes, size=self._environments)
        return drawn.astype(np.int32)

    def _named(self, info: StepInfo) -> dict[str, np.ndarray]:
        return {name: np.array(value) for name, value in info._asdict().items()}


@final
class DrivingEnv(gymnasium.Env[Observed, Any]):
    """One scene, its recording vehicle controlled."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        file: BankFile,
        config: EnvironmentConfig | None = None,
        *,
        continuous: bool = False,
    ) -> None:
        """Environments of the scenes of a bank, `sim.bank.open_bank(path)`.

        Raises BankError where the bank's step length is not `config.dt`.
        """
        self._file = file
        self._simulator = _Simulator(
            file,
            config or EnvironmentConfig(),
            environments=1,
            continuous=continuous,
            restarts=False,
        )
        self.action_space = self._simulator.action_space
        self.observation_space = self._simulator.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Starts a random scene, or the one that `options={"scene": row}` names."""
        gymnasium.Env.reset(self, seed=seed)
        if seed is not None:
            self._simulator.seed(seed)
        observation, info = self._simulator.start(options or {})
        return _only(observation), self._described(info)

    def step(
        self,
        action: Any,  # noqa: ANN401 - Gymnasium's
    ) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """One step of 1/`config.dt` Hz; see `sim.environment.step`."""
        observation, reward, terminated, truncated, info = self._simulator.step(
            np.asarray(action)[None]
        )
        return (
            _only(observation),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            self._described(info),
        )

    def _described(self, info: dict[str, np.ndarray]) -> dict[str, Any]:
        named = {name: value[0].item() for name, value in info.items()}
        return {**named, "scenario_id": self._file.scenario_ids[named["scene"]]}


def _only(observation: Observed) -> Observed:
    return {name: value[0] for name, value in observation.items()}


@final
class DrivingVectorEnv(VectorEnv[Observed, Any, np.ndarray]):
    """Many scenes in one compiled call, each with its recording vehicle controlled.

    Starts anew by itself in the step after an episode's last one (NEXT_STEP): that
    step's action is ignored and its reward is 0. With `AutoresetMode.DISABLED` the
    caller resets with `options={"reset_mask": mask}`, as torchrl's `GymWrapper` does.
    """

    def __init__(
        self,
        file: BankFile,
        num_envs: int,
        config: EnvironmentConfig | None = None,
        *,
        continuous: bool = False,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        """As `DrivingEnv`, `num_envs` times."""
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs} must be at least 1")
        if autoreset_mode is AutoresetMode.SAME_STEP:
            raise ValueError("autoreset_mode: use NEXT_STEP or DISABLED")
        self.autoreset_mode = autoreset_mode
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset_mode}
        self.num_envs = num_envs
        self._simulator = _Simulator(
            file,
            config or EnvironmentConfig(),
            environments=num_envs,
            continuous=continuous,
            restarts=autoreset_mode is AutoresetMode.NEXT_STEP,
        )
        self.single_action_space = self._simulator.action_space
        self.single_observation_space = self._simulator.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Starts random scenes, or all in the one of `options={"scene": row}`."""
        VectorEnv.reset(self, seed=seed)
        if seed is not None:
            self._simulator.seed(seed)
        return self._simulator.start(options or {})

    def step(
        self,
        actions: Any,  # noqa: ANN401 - Gymnasium's
    ) -> tuple[Observed, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of every environment."""
        actions = np.asarray(actions)
        if len(actions) != self.num_envs:
            raise gymnasium.error.InvalidAction(
                f"{len(actions)} actions for {self.num_envs} environments"
            )
        return self._simulator.step(actions)
