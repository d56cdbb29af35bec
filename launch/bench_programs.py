"""The compiled programs that `slipstream bench sim` times: table 6's four columns.

    Reset          the scene at its first step to act at, with its history
    Transition     a continuous Bicycle action for every object, one step on
    Metrics        overlap, off-road, log divergence and kinematic infeasibility
    RolloutExpert  80 steps of the inverse bicycle, metrics and reward at every step

All objects of the scene are controlled. `oracle` computes the last two with
`launch.bench_oracle` in the place of the simulator's metrics, the reward included:
dynamics and all else stay the same. A batch holds the one scene several times.

Everything is compiled ahead of time, so that no figure holds a compilation and every
program can say how much memory it takes.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from launch import bench_oracle
from launch.bench_oracle import RoadPoints
from sim import dynamics
from sim.agents import ExpertSpace, expert
from sim.bank import Bank
from sim.dynamics import ActionSpace, ObjectState
from sim.environment import (
    EnvironmentConfig,
    Judgement,
    State,
    advance,
    judge,
    reset,
)

ROLLOUT_STEPS: Final = 80
COLUMNS: Final = ("reset", "transition", "metrics", "rollout")


class Step(NamedTuple):
    """What a rollout hands out for each step and object."""

    reward: Float[Array, "*steps objects"]
    overlap: Bool[Array, "*steps objects"]
    offroad: Bool[Array, "*steps objects"]
    log_divergence: Float[Array, "*steps objects"]  # m
    kinematic_infeasibility: Bool[Array, "*steps objects"]
    valid: Bool[Array, "*steps objects"]


def resets(bank: Bank, scene: Int[Array, ""], config: EnvironmentConfig) -> State:
    """Reset with every object controlled."""
    return reset(bank, scene, jnp.arange(bank.log.shape[2], dtype=jnp.int32), config)


def transition(
    bank: Bank,
    state: State,
    action: Float[Array, "objects 2"],
    config: EnvironmentConfig,
) -> State:
    """Moves every object by its Bicycle action (a [m/s^2], kappa [1/m])."""
    now = ObjectState(*state.history[:, -1].T)
    moved = jax.vmap(dynamics.bicycle, in_axes=(0, 0, None))(now, action, config.dt)
    # What `advance` judges is not used here, and XLA leaves out what is not used.
    return advance(bank, state, jnp.stack(moved, -1), config)[0]


def rollout(
    bank: Bank,
    road: RoadPoints | None,
    scene: Int[Array, ""],
    config: EnvironmentConfig,
    *,
    rows: bool = False,
) -> Step:
    """RolloutExpert; with the oracle's metrics where `road` is given."""
    agent = expert(config, ExpertSpace(ActionSpace.BICYCLE, on_grid=False))
    unused = jax.random.key(0)  # the expert draws nothing

    def one(state: State, _: None) -> tuple[State, Step]:
        decision = agent(unused, bank, state)
        following, outcome = advance(bank, state, decision.moved, config)
        if road is None:
            judged = judge(bank, state, following, config.dt, outcome)
            reward = outcome.reward
        else:
            judged = bench_oracle.judge(
                bank, road, state, following, config.dt, rows=rows
            )
            failed = judged.overlap.astype(jnp.float32)
            reward = -failed - judged.offroad.astype(jnp.float32)
        return following, Step(
            reward,
            judged.overlap,
            judged.offroad,
            judged.log_divergence,
            judged.kinematic_infeasibility,
            outcome.valid,
        )

    start = resets(bank, scene, config)
    return jax.lax.scan(one, start, None, length=ROLLOUT_STEPS)[1]


@dataclass(frozen=True)
class Program:
    """A compiled program with its arguments."""

    call: Callable[[], Any]  # runs it and waits
    peak_bytes: int  # arguments, results and temporaries together
    temporary_bytes: int


def compiled(function: Callable[..., Any], *arguments: Any) -> Program:  # noqa: ANN401
    """Compiles a function for these arguments."""
    program = jax.jit(function).lower(*arguments).compile()
    memory = program.memory_analysis()
    if memory is None:  # a backend that does not say
        peak, temporary = 0, 0
    else:
        temporary = int(memory.temp_size_in_bytes)
        peak = int(memory.argument_size_in_bytes + memory.output_size_in_bytes)
        peak += temporary - int(memory.alias_size_in_bytes)
    return Program(lambda: waited(program(*arguments)), peak, temporary)


def waited(result: Any) -> Any:  # noqa: ANN401 - any tree of arrays
    """The result, once it is there."""
    return jax.block_until_ready(result)  # type: ignore[no-untyped-call]


def many(
    function: Callable[..., Any], batch: int, *axes: int | None
) -> Callable[..., Any]:
    """The function over a batch; of a batch of one, the function as it is."""
    return function if batch == 1 else jax.vmap(function, in_axes=axes)


def at_work(
    bank: Bank, batch: int, config: EnvironmentConfig
) -> tuple[Int[Array, "*batch"], State, State, Float[Array, "*batch objects 2"]]:
    """Arguments for the programs: scenes, the first two states, actions."""
    scene = jnp.zeros(() if batch == 1 else batch, jnp.int32)
    resetting = many(functools.partial(resets, config=config), batch, None, 0)
    state = jax.jit(resetting)(bank, scene)
    action = jnp.zeros((*state.controlled.shape, 2)).at[..., 0].set(0.5)
    moving = many(functools.partial(transition, config=config), batch, None, 0, 0)
    return scene, state, jax.jit(moving)(bank, state, action), action


def ours(
    bank: Bank, batch: int, config: EnvironmentConfig, names: tuple[str, ...] = COLUMNS
) -> dict[str, Program]:
    """The columns of table 6; no rollout of a batch, as in the paper."""
    scene, state, following, action = at_work(bank, batch, config)

    def rolling(bank: Bank, scene: Int[Array, ""]) -> Step:
        return rollout(bank, None, scene, config)

    resetting = functools.partial(resets, config=config)
    moving = functools.partial(transition, config=config)
    judging = functools.partial(judge, dt=config.dt)
    whole: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        "reset": (many(resetting, batch, None, 0), (bank, scene)),
        "transition": (many(moving, batch, None, 0, 0), (bank, state, action)),
        "metrics": (many(judging, batch, None, 0, 0), (bank, state, following)),
        "rollout": (rolling, (bank, scene)),
    }
    return {
        name: compiled(function, *arguments)
        for name, (function, arguments) in whole.items()
        if name in names and (name != "rollout" or batch == 1)
    }


def oracle(
    bank: Bank, road: RoadPoints, config: EnvironmentConfig, *, rows: bool = False
) -> dict[str, Program]:
    """Metrics and RolloutExpert by the definitions, batch 1."""
    scene, state, following, _ = at_work(bank, 1, config)

    def judging(bank: Bank, road: RoadPoints, before: State, now: State) -> Judgement:
        return bench_oracle.judge(bank, road, before, now, config.dt, rows=rows)

    def rolling(bank: Bank, road: RoadPoints, scene: Int[Array, ""]) -> Step:
        return rollout(bank, road, scene, config, rows=rows)

    return {
        "metrics": compiled(judging, bank, road, state, following),
        "rollout": compiled(rolling, bank, road, scene),
    }
