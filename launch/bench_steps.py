"""Sections `steps` and `scale` of `slipstream bench sim`: whole environment steps.

A step is dynamics, reward, termination, auto-reset and the next observation (64 road
rows and all else, of every controlled object) of a batch of environments: one compiled
call of `sim.episodes.step`, as a learner would make it, on one core. Actions are drawn
from the grid beforehand: choosing them is the policy's work. An agent-step is one
controlled object's part of it; a slot whose object was not recorded at a step costs
the same and counts, the share that was is reported.
"""

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from launch.bench_scenes import sized
from launch.bench_table6 import Work, configuration
from launch.bench_timing import Timing, timed
from sim import episodes
from sim.bank import Bank, BankFile
from sim.environment import EnvironmentConfig

STEPS: Final = ((32, 16), (1, 512))  # controlled objects a scene, environments
SLOTS: Final = 64  # of the second bank that `steps` runs on, and of its memory
TOGETHER: Final = 16  # environments where the number of objects is varied
DRAWN: Final = 16  # batches of actions, used in turns


def every_object(bank: Bank, scene: Int[Array, ""]) -> Int[Array, " objects"]:
    """A choice of `sim.episodes`: all rows are controlled."""
    return jnp.arange(bank.log.shape[2], dtype=jnp.int32)


@dataclass(frozen=True)
class Running:
    """A batch of environments that goes on by a step with every call."""

    step: Callable[[], Any]
    begin: Any  # starts, one per scene
    temporary_bytes: int
    observation_bytes: int


def running(
    bank: Bank, environments: int, choose: episodes.Choice, config: EnvironmentConfig
) -> Running:
    """Compiles the step and starts the environments at random scenes."""
    begin = episodes.starts(bank, choose, config)
    state = episodes.draw(jax.random.key(0), begin, environments)
    rng = np.random.default_rng(0)
    shape = (DRAWN, *state.controlled.shape)
    drawn = rng.integers(config.action.count, size=shape).astype(np.int32)
    inputs = [
        (jax.random.key(index), jnp.asarray(action))
        for index, action in enumerate(drawn)
    ]
    stepping = functools.partial(episodes.step, config=config)
    key, action = inputs[0]
    program = jax.jit(stepping).lower(key, bank, begin, state, action).compile()
    memory = program.memory_analysis()
    turns = itertools.cycle(inputs)

    def step() -> Any:  # noqa: ANN401 - what `episodes.step` returns
        nonlocal state
        key, action = next(turns)
        result = program(key, bank, begin, state, action)
        state = jax.block_until_ready(result)[0]  # type: ignore[no-untyped-call]
        return result

    seen = jax.eval_shape(stepping, key, bank, begin, state, action)[2]
    return Running(
        step=step,
        begin=begin,
        temporary_bytes=int(memory.temp_size_in_bytes) if memory else 0,
        observation_bytes=bytes_of(seen) // max(state.controlled.size, 1),
    )


def bytes_of(tree: Any) -> int:  # noqa: ANN401 - any tree of arrays or shapes
    """Memory of all arrays."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def state_bytes(bank: Bank, choose: episodes.Choice, config: EnvironmentConfig) -> int:
    """What an environment holds from step to step, bank excluded."""
    begin = jax.eval_shape(lambda bank: episodes.starts(bank, choose, config), bank)
    return bytes_of(begin) // bank.sdc.shape[0]


def chosen(slots: int, controlled: int) -> episodes.Choice:
    """All objects, or the SDC and those nearest to it."""
    return every_object if controlled >= slots else episodes.NearestToSdc(controlled)


def recorded_share(file: BankFile, controlled: int) -> float:
    """Share of the controlled slots whose object was recorded, over an episode."""
    valid = file.arrays["log_valid"]
    choose = chosen(valid.shape[2], controlled)
    begin = episodes.starts(file.bank, choose, configuration(file.dt))
    shares = []
    for scene, rows in enumerate(np.asarray(begin.controlled)):
        first, last = (int(file.arrays[n][scene]) for n in ("current_step", "steps"))
        held = valid[scene, first + 1 : last][:, rows[rows < valid.shape[2]]]
        shares.append(held.sum() / (held.shape[0] * len(rows)))
    return float(np.mean(shares))


def measured(
    file: BankFile, controlled: int, environments: int, seconds: float
) -> dict[str, Any]:
    """A row of agent-steps per second."""
    bank, config = file.bank, configuration(file.dt)
    slots = int(bank.log.shape[2])
    choose = every_object if controlled >= slots else episodes.NearestToSdc(controlled)
    batch = running(bank, environments, choose, config)
    found: Timing = timed(batch.step, seconds=seconds)
    agents = min(controlled, slots) * environments
    return {
        "slots": slots,
        "scenes": file.scenes,
        "controlled": min(controlled, slots),
        "environments": environments,
        **found.json(),
        "agent_steps_per_s": agents / found.median_ms * 1e3,
        "best_agent_steps_per_s": agents / found.least_ms * 1e3,
        "us_per_agent_step": found.median_ms * 1e3 / agents,
        "state_bytes_per_environment": state_bytes(bank, choose, config),
        "temporary_bytes_per_environment": batch.temporary_bytes // environments,
        "observation_bytes_per_agent": batch.observation_bytes,
    }


def steps(work: Work) -> Iterator[dict[str, Any]]:
    """The scene with all its objects, and cut to the nearest 64.

    The last row drives all of those: what an environment of 64 objects takes.
    """
    whole = work.scene.objects
    rows = [(n, *size) for n in dict.fromkeys((whole, SLOTS)) for size in work.steps]
    for slots, controlled, environments in [*rows, (SLOTS, SLOTS, TOGETHER)]:
        work.say(
            f"steps: {controlled} controlled of {slots}, {environments} environments"
        )
        file = sized(work.scene, slots, work.folder).file
        row = measured(file, controlled, environments, 2 * work.seconds)
        share = recorded_share(file, controlled)
        yield {"recorded_share": share, **row}


def scale(work: Work) -> Iterator[dict[str, Any]]:
    """One axis at a time; scenes of more objects than there are hold copies."""
    whole = sized(work.scene, work.scene.objects, work.folder)
    for environments in work.environments:
        work.say(f"scale: {environments} environments")
        row = measured(whole.file, 1, environments, work.seconds)
        yield {"axis": "environments", **row}
    for slots in work.scale_objects:
        work.say(f"scale: {slots} objects")
        tiled = sized(work.scene, slots, work.folder, tile=True)
        row = measured(tiled.file, slots, TOGETHER, work.seconds)
        yield {"axis": "objects", "objects": tiled.objects, **row}
