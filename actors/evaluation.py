"""Evaluation: agents against scenes, in one batch, judged by the benchmark's metrics.

A scenario is driven to its end whatever happens in it; a failure is an overlap or
off-road at some step within it (Gulino et al., 2023). Steps at which an object was not
recorded do not count. Playback (`log`) is judged from the scene's first step, agents
from the first step that they decided.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from sim import metrics
from sim.agents import Agent
from sim.bank import Bank, BankFile
from sim.dynamics import ObjectState
from sim.environment import (
    EnvironmentConfig,
    State,
    advance,
    failures,
    logged_states,
    start_at,
)


class Trace(NamedTuple):
    """What happened at each step; leading axes: steps, then scenes where batched."""

    states: Float[Array, "*axes controlled 5"]  # s_t
    action: Int[Array, "*axes controlled"]  # a_tm1, -1 where there is no index
    q_values: Float[Array, "*axes controlled actions"]
    reward: Float[Array, "*axes controlled"]
    overlap: Bool[Array, "*axes controlled"]
    offroad: Bool[Array, "*axes controlled"]
    infeasible: Bool[Array, "*axes controlled"]
    displacement: Float[Array, "*axes controlled"]  # m from the log
    progress: Float[Array, "*axes controlled"]
    counts: Bool[Array, "*axes controlled"]  # recorded, and within the scene
    step: Int[Array, "*axes"]  # t of s_t


@dataclass(frozen=True)
class SceneResult:
    """One scene's row of an evaluation."""

    id: str
    objects: int  # controlled objects with at least one counted step
    valid: int  # (object, step) pairs that count
    overlap: int  # of them with an overlap
    offroad: int
    kinematic_infeasibility: int
    failed: bool  # any overlap or off-road
    log_displacement: float  # m, mean over the pairs
    progress: float | None  # mean over objects that the log moves 1 m or more


@dataclass(frozen=True)
class Evaluation:
    """An agent's results on a bank."""

    agent: str
    scenes: list[SceneResult]
    trace: Trace | None  # axes: scenes, steps

    @property
    def failure_rate(self) -> float:
        """Share of the scenes with an overlap or off-road."""
        return float(np.mean([scene.failed for scene in self.scenes]))

    def rate(self, name: str) -> float:
        """Share of the scenes in which `overlap` or `offroad` happened."""
        return float(np.mean([getattr(scene, name) > 0 for scene in self.scenes]))

    @property
    def progress(self) -> float:
        """Mean over the scenes that have one."""
        values = [s.progress for s in self.scenes if s.progress is not None]
        return float(np.mean(values)) if values else float("nan")

    @property
    def log_displacement(self) -> float:
        """Mean over the scenes [m]."""
        return float(np.mean([scene.log_displacement for scene in self.scenes]))

    @property
    def infeasible(self) -> float:
        """Share of the counted pairs that are kinematically infeasible."""
        pairs = sum(scene.valid for scene in self.scenes)
        total = sum(scene.kinematic_infeasibility for scene in self.scenes)
        return total / max(pairs, 1)


def evaluate(
    file: BankFile,
    agent: Agent,
    *,
    name: str,
    key: PRNGKeyArray,
    config: EnvironmentConfig,
    all_objects: bool = False,
    from_first_step: bool = False,
    keep_trace: bool = False,
) -> Evaluation:
    """Drives every scene of the bank and judges it.

    Args:
        file: the scenes.
        agent: decides for all controlled objects of a scene.
        name: the agent's, for the results.
        key: for agents that draw.
        config: dynamics, observation and reward.
        all_objects: control every object instead of the SDC alone.
        from_first_step: start at step 0 and judge it too (playback).
        keep_trace: keep the states for a recording.
    """
    bank = file.bank
    chunk = 8 if all_objects else 64
    rollout = _rollout(agent, config, all_objects, from_first_step)
    results: list[SceneResult] = []
    traces: list[Trace] = []
    for first in range(0, file.scenes, chunk):
        # The last chunk repeats its last scene: one shape, one compilation.
        scenes = np.minimum(np.arange(first, first + chunk), file.scenes - 1)
        keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(scenes)
        trace = jax.device_get(rollout(keys, bank, jnp.asarray(scenes)))
        kept = min(chunk, file.scenes - first)
        trace = jax.tree.map(lambda values, kept=kept: values[:kept], trace)
        results += [
            _result(file.scenario_ids[first + row], trace, row) for row in range(kept)
        ]
        if keep_trace:
            traces.append(trace)
    joined = (
        jax.tree.map(lambda *parts: np.concatenate(parts), *traces) if traces else None
    )
    return Evaluation(agent=name, scenes=results, trace=joined)


def _rollout(
    agent: Agent, config: EnvironmentConfig, all_objects: bool, from_first_step: bool
) -> Callable[[PRNGKeyArray, Bank, Int[Array, " scenes"]], Trace]:
    """The compiled rollout of a batch of scenes; axes of its trace: scenes, steps."""

    def one(key: PRNGKeyArray, bank: Bank, scene: Int[Array, ""]) -> Trace:
        if all_objects:
            controlled = jnp.arange(bank.log.shape[2])
        else:
            controlled = bank.sdc[scene][None]
        first = jnp.int32(0) if from_first_step else bank.current_step[scene]
        state = start_at(bank, scene, first, controlled, config)

        def step(carry: State, step_key: PRNGKeyArray) -> tuple[State, Trace]:
            following, trace = _step(step_key, bank, carry, agent, config)
            return following, trace

        steps = bank.log.shape[1] - 1
        _, trace = jax.lax.scan(step, state, jax.random.split(key, steps))
        if from_first_step:
            initial = _first(bank, state, trace)
            trace = jax.tree.map(
                lambda head, tail: jnp.concatenate([head[None], tail]), initial, trace
            )
        return trace

    return jax.jit(jax.vmap(one, in_axes=(0, None, 0)))


def _step(
    key: PRNGKeyArray,
    bank: Bank,
    state: State,
    agent: Agent,
    config: EnvironmentConfig,
) -> tuple[State, Trace]:
    decision = agent(key, bank, state)
    following, outcome = advance(bank, state, decision.moved, config)
    within = state.step < bank.steps[state.scene] - 1
    counts = outcome.valid & within
    now = following.history[:, -1]
    logged = logged_states(bank, state.scene, following.step, state.controlled)
    infeasible = jax.vmap(metrics.kinematic_infeasibility, in_axes=(0, 0, None))(
        ObjectState(*state.history[:, -1].T), ObjectState(*now.T), config.dt
    )
    trace = Trace(
        states=now,
        action=decision.action,
        q_values=decision.q_values,
        reward=outcome.reward,
        overlap=outcome.overlap & counts,
        offroad=outcome.offroad & counts,
        infeasible=infeasible & counts & state.history_valid[:, -1],
        displacement=jnp.where(
            counts,
            jax.vmap(metrics.log_divergence)(
                now[:, 0], now[:, 1], logged[:, 0], logged[:, 1]
            ),
            0.0,
        ),
        progress=jax.vmap(metrics.progress, in_axes=(None, None, 0, 0))(
            bank, state.scene, state.controlled, following.along
        ),
        counts=counts,
        step=following.step,
    )
    return following, trace


def _first(bank: Bank, state: State, trace: Trace) -> Trace:
    """The trace of the first step itself, where nothing was decided yet."""
    now = state.history[:, -1]
    counts = state.history_valid[:, -1]
    overlap, offroad = failures(bank, state.scene, state.step, state.controlled, now)
    empty = jax.tree.map(lambda values: jnp.zeros_like(values[0]), trace)
    return empty._replace(
        states=now,
        action=jnp.full_like(empty.action, -1),
        overlap=overlap & counts,
        offroad=offroad & counts,
        progress=jnp.zeros_like(empty.progress),
        counts=counts,
        step=state.step,
    )


def _result(scene_id: str, trace: Trace, row: int) -> SceneResult:
    counts = trace.counts[row]
    pairs = int(counts.sum())
    # Of every object, the progress where its recording ended.
    last = counts.shape[0] - 1 - counts[::-1].argmax(0)
    final = trace.progress[row][last, np.arange(counts.shape[1])]
    final = final[counts.any(0) & np.isfinite(final)]
    return SceneResult(
        id=scene_id,
        objects=int(counts.any(0).sum()),
        valid=pairs,
        overlap=int(trace.overlap[row].sum()),
        offroad=int(trace.offroad[row].sum()),
        kinematic_infeasibility=int(trace.infeasible[row].sum()),
        failed=bool((trace.overlap[row] | trace.offroad[row]).any()),
        log_displacement=float(trace.displacement[row].sum()) / max(pairs, 1),
        progress=float(final.mean()) if len(final) else None,
    )
