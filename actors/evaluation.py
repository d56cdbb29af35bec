"""Evaluation: agents against scenes, in one batch, judged by the benchmark's metrics.

A scenario is driven to its end whatever happens in it; a failure is an overlap or
off-road at some step within it (Gulino et al., 2023). Steps at which an object was not
recorded do not count. Playback (`log`) is judged from the scene's first step, agents
from the first step that they decided. Wrong-way and off-route count from
`Bank.current_step` on, where an object's lane paths begin.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from actors.controlled import ControlledSet, sdc_of
from actors.results import RATES, Figure, SceneResult, figures_of
from sim import metrics, route_metrics
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
from sim.world import row_of

MANY = 8  # controlled objects of a scene from which on fewer scenes are driven at once
Slots = TypeVar("Slots")
Family = Callable[[Float[Array, " parameters"]], Agent]  # an agent for each vector


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
    progress: Float[Array, "*axes controlled"]  # of the logged route, NaN: has none
    wrong_way: Bool[Array, "*axes controlled"]
    off_route: Bool[Array, "*axes controlled"]
    progression: Float[Array, "*axes controlled"]  # of the lane path, NaN: has none
    counts: Bool[Array, "*axes controlled"]  # recorded, and within the scene
    step: Int[Array, "*axes"]  # t of s_t


@dataclass(frozen=True)
class Evaluation:
    """An agent's results on a bank."""

    agent: str
    scenes: list[SceneResult]
    trace: Trace | None  # axes: scenes, steps

    @property
    def figures(self) -> dict[str, Figure]:
        """Every figure of `results.figures_of`, by name."""
        return figures_of(self.scenes)

    @property
    def failure_rate(self) -> float:
        """Share of the scenes with an overlap or off-road."""
        return self.rate("failure")

    def rate(self, name: str) -> float:
        """Share of the scenes in which one of `results.RATES` happened."""
        return self.figures[f"{name}_rate"].value

    @property
    def progress(self) -> float:
        """Mean over the scenes that have one."""
        return self.figures["progress"].value

    @property
    def log_displacement(self) -> float:
        """Mean over the scenes [m]."""
        return self.figures["log_displacement"].value

    @property
    def infeasible(self) -> float:
        """Share of the counted pairs that are kinematically infeasible."""
        return self.figures["kinematic_infeasibility"].value


@final
class Judge:
    """Drives the scenes of a bank and judges them, by one compiled program.

    The agent's parameters are an argument of the program: all checkpoints of a run
    are driven by the same one.
    """

    def __init__(
        self,
        file: BankFile,
        family: Family,
        *,
        config: EnvironmentConfig,
        controlled: ControlledSet | None = None,
        from_first_step: bool = False,
    ) -> None:
        """Compiles when it first drives.

        Args:
            file: the scenes.
            family: the agent of each parameter vector; it decides for all controlled
                objects of a scene.
            config: dynamics, observation and reward.
            controlled: whom the agent decides for and who of them is judged; by
                default each scene's SDC.
            from_first_step: start at step 0 and judge it too (playback).
        """
        self._file = file
        self._chosen = controlled or sdc_of(file)
        self._rollout = _rollout(family, config, self._chosen.judged, from_first_step)

    @property
    def compilations(self) -> int:
        """Programs compiled so far: one for each number of scenes driven at once."""
        return int(self._rollout._cache_size())  # type: ignore[attr-defined]

    def evaluate(
        self,
        parameters: Float[Array | np.ndarray, " parameters"],
        *,
        name: str,
        key: PRNGKeyArray,
        keep_trace: bool = False,
        most: int | None = None,
    ) -> Evaluation:
        """Drives every scene by one member of the family and judges it.

        Args:
            parameters: which member.
            name: its name, for the results.
            key: for agents that draw.
            keep_trace: keep the states for a recording.
            most: the first so many scenes; None is all.
        """
        file = self._file
        driven = min(file.scenes, most or file.scenes)
        few = 64 if self._chosen.slots.shape[1] < MANY else 8
        chunk = min(few, driven)
        # A copy of its own: `device_put` may alias a buffer that is used again.
        vector = jnp.array(np.array(parameters, np.float32, copy=True))
        results: list[SceneResult] = []
        traces: list[Trace] = []
        for first in range(0, driven, chunk):
            # The last chunk repeats its last scene: one shape, one compilation.
            scenes = np.minimum(np.arange(first, first + chunk), driven - 1)
            keys = jax.vmap(lambda index: jax.random.fold_in(key, index))(scenes)
            slots = jnp.asarray(self._chosen.slots[scenes])
            trace = jax.device_get(
                self._rollout(keys, file.bank, jnp.asarray(scenes), slots, vector)
            )
            kept = min(chunk, driven - first)
            trace = jax.tree.map(lambda values, kept=kept: values[:kept], trace)
            results += [
                _result(file.scenario_ids[first + row], trace, row)
                for row in range(kept)
            ]
            if keep_trace:
                traces.append(trace)
        joined = (
            jax.tree.map(lambda *parts: np.concatenate(parts), *traces)
            if traces
            else None
        )
        return Evaluation(agent=name, scenes=results, trace=joined)


def evaluate(
    file: BankFile,
    agent: Agent,
    *,
    name: str,
    key: PRNGKeyArray,
    config: EnvironmentConfig,
    controlled: ControlledSet | None = None,
    from_first_step: bool = False,
    keep_trace: bool = False,
) -> Evaluation:
    """Drives every scene of the bank by an agent without parameters; see `Judge`."""
    judge = Judge(
        file,
        lambda _: agent,
        config=config,
        controlled=controlled,
        from_first_step=from_first_step,
    )
    nothing = jnp.zeros(0, jnp.float32)
    return judge.evaluate(nothing, name=name, key=key, keep_trace=keep_trace)


def _rollout(
    family: Family, config: EnvironmentConfig, judged: int, from_first_step: bool
) -> Callable[..., Trace]:
    """The compiled rollout of a batch of scenes; axes of its trace: scenes, steps.

    The trace holds the first `judged` of the controlled objects.
    """

    def one(
        key: PRNGKeyArray,
        bank: Bank,
        scene: Int[Array, ""],
        controlled: Int[Array, " controlled"],
        parameters: Float[Array, " parameters"],
    ) -> Trace:
        agent = family(parameters)
        first = jnp.int32(0) if from_first_step else bank.current_step[scene]
        state = start_at(bank, scene, first, controlled, config)

        def step(carry: State, step_key: PRNGKeyArray) -> tuple[State, Trace]:
            following, trace = _step(step_key, bank, carry, agent, config)
            return following, _first_slots(trace, judged)

        steps = bank.log.shape[1] - 1
        _, trace = jax.lax.scan(step, state, jax.random.split(key, steps))
        if from_first_step:
            initial = _first(bank, _first_slots(state, judged), trace)
            trace = jax.tree.map(
                lambda head, tail: jnp.concatenate([head[None], tail]), initial, trace
            )
        return trace

    return jax.jit(jax.vmap(one, in_axes=(0, None, 0, 0, None)))


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
    wrong_way, off_route, progression = _on_route(bank, following)
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
            bank, state.scene, row_of(bank, state.controlled), following.along
        ),
        wrong_way=wrong_way & counts,
        off_route=off_route & counts,
        progression=progression,
        counts=counts,
        step=following.step,
    )
    return following, trace


def _first(bank: Bank, state: State, trace: Trace) -> Trace:
    """The trace of the first step itself, where nothing was decided yet."""
    now = state.history[:, -1]
    counts = state.history_valid[:, -1]
    overlap, offroad = failures(bank, state.scene, state.step, state.controlled, now)
    wrong_way, off_route, progression = _on_route(bank, state)
    empty = jax.tree.map(lambda values: jnp.zeros_like(values[0]), trace)
    return empty._replace(
        states=now,
        action=jnp.full_like(empty.action, -1),
        overlap=overlap & counts,
        offroad=offroad & counts,
        wrong_way=wrong_way & counts,
        off_route=off_route & counts,
        progression=progression,
        counts=counts,
        step=state.step,
    )


def _on_route(
    bank: Bank, state: State
) -> tuple[
    Bool[Array, " controlled"], Bool[Array, " controlled"], Float[Array, " controlled"]
]:
    """Wrong-way, off-route and progression of the controlled objects now."""
    now, rows = state.history[:, -1], row_of(bank, state.controlled)
    begun = state.step >= bank.current_step[state.scene]

    def one(
        row: Int[Array, ""], x: Float[Array, ""], y: Float[Array, ""]
    ) -> tuple[Bool[Array, ""], Bool[Array, ""], Float[Array, ""]]:
        place = route_metrics.lane_position(bank, state.scene, row, x, y)
        return (
            begun & (route_metrics.wrong_way(place) > 0),
            begun & (route_metrics.off_route(place) > 0),
            route_metrics.progression(bank, state.scene, row, place.along),
        )

    return jax.vmap(one)(rows, now[:, 0], now[:, 1])


def _first_slots(values: Slots, count: int) -> Slots:
    """The first of the controlled objects; every array with axes has them in front."""
    return jax.tree.map(lambda value: value[:count] if value.ndim else value, values)


def _result(scene_id: str, trace: Trace, row: int) -> SceneResult:
    counts = trace.counts[row]
    pairs = int(counts.sum())
    happened = {
        "failure": trace.overlap[row] | trace.offroad[row],
        **{name: getattr(trace, name)[row] for name in RATES[1:]},
    }
    return SceneResult(
        id=scene_id,
        objects=int(counts.any(0).sum()),
        valid=pairs,
        kinematic_infeasibility=int(trace.infeasible[row].sum()),
        failed=bool(happened["failure"].any()),
        **{name: int(happened[name].sum()) for name in RATES[1:]},
        **{
            f"{name}_objects": int(seen.any(0).sum()) for name, seen in happened.items()
        },
        log_displacement=float(trace.displacement[row].sum()) / max(pairs, 1),
        progress=_final(np.asarray(trace.progress[row]), np.asarray(counts)),
        progression=_final(np.asarray(trace.progression[row]), np.asarray(counts)),
    )


def _final(
    values: Float[np.ndarray, "steps controlled"],
    counts: Bool[np.ndarray, "steps controlled"],
) -> float | None:
    """Mean of what every object had reached where its recording ended; None: nobody."""
    last = counts.shape[0] - 1 - counts[::-1].argmax(0)
    final = values[last, np.arange(counts.shape[1])]
    final = final[counts.any(0) & np.isfinite(final)]
    return float(final.mean()) if len(final) else None
