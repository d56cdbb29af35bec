"""Section `banks` of `slipstream bench sim`: what the number of scenes costs.

Banks of procedural scenes are generated (on all cores, not timed), then each is opened
in a fresh process of one core, which says: how long opening and handing the arrays to
JAX take, how long the first reset after compilation; how much memory that took and how
many of the file's pages were in use in the end; and what resets of random scenes and
whole steps of 512 environments cost, for they touch pages all over the file. The file
has just been written, so it is in the page cache: a disk's speed is not part of it.
"""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import psutil

from launch import bench_child, bench_steps
from launch.bench_programs import compiled, resets, waited
from launch.bench_table6 import configuration
from launch.bench_timing import timed
from launch.scenes import write_procedural
from sim import episodes
from sim.bank import Bank, open_bank
from sim.environment import EnvironmentConfig

BATCH: Final = 512  # scenes reset at a time
DRAWN: Final = 16  # batches of random scenes, used in turns


def banks(
    counts: tuple[int, ...],
    seconds: float,
    folder: Path,
    say: Callable[[str], None],
) -> Iterator[dict[str, Any]]:
    """Generates each bank and has it measured in a process of its own."""
    for count in counts:
        say(f"banks: generates {count} scenes")
        began = time.perf_counter()
        path = folder / f"procedural-{count}.bank"
        write_procedural(path, count=count, seed=1)
        took = time.perf_counter() - began
        request = {"path": str(path), "sizes": {"seconds": seconds}}
        for row in bench_child.run("bank", request, one_core=True):
            yield {**row, "generated_s": took}
        path.unlink()


def bank(request: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Opens one bank and measures; in a fresh process."""
    waited(jnp.zeros(1))  # JAX itself is up
    process = psutil.Process()
    before = process.memory_info()
    began = time.perf_counter()
    file = open_bank(Path(request["path"]))
    opened = time.perf_counter()
    arrays = waited(file.bank)
    loaded = time.perf_counter()
    grown = process.memory_info().rss - before.rss
    config = configuration(file.dt)
    first_ms, random_us = _resets(arrays, config, request["sizes"]["seconds"])
    stepped = bench_steps.measured(file, 1, BATCH, request["sizes"]["seconds"])
    yield {
        "scenes": file.scenes,
        "file_bytes": file.path.stat().st_size,
        "open_ms": (opened - began) * 1e3,
        "load_ms": (loaded - opened) * 1e3,
        "first_reset_ms": first_ms,
        "random_reset_us": random_us,
        "starts_ms": _starts(arrays, config),
        "us_per_agent_step": stepped["us_per_agent_step"],
        "loaded_bytes": grown,
        # Pages of the file alone: the rest is the compiler's and the programs'.
        "mapped_bytes": process.memory_info().shared - before.shared,
    }


def _resets(
    bank: Bank, config: EnvironmentConfig, seconds: float
) -> tuple[float, float]:
    """The first reset [ms], and the cost of one of a random scene [us]."""

    def one(bank: Bank, scene: jax.Array) -> Any:  # noqa: ANN401 - the start
        return resets(bank, scene, config)

    first = compiled(one, bank, jnp.int32(bank.sdc.shape[0] - 1))
    began = time.perf_counter()
    first.call()
    first_ms = (time.perf_counter() - began) * 1e3
    rng = np.random.default_rng(0)
    drawn = rng.integers(bank.sdc.shape[0], size=(DRAWN, BATCH)).astype(np.int32)
    turns = itertools.cycle([jnp.asarray(scenes) for scenes in drawn])
    program = jax.jit(jax.vmap(one, (None, 0))).lower(bank, next(turns)).compile()
    found = timed(
        lambda: waited(program(bank, next(turns))),
        seconds=seconds,
    )
    return first_ms, found.median_ms * 1e3 / BATCH


def _starts(bank: Bank, config: EnvironmentConfig) -> float:
    """Making the starts of all scenes, once per run [ms]."""
    function = jax.jit(lambda bank: episodes.starts(bank, episodes.sdc_only, config))
    program = function.lower(bank).compile()
    began = time.perf_counter()
    waited(program(bank))
    return (time.perf_counter() - began) * 1e3
