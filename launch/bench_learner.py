"""`slipstream bench learner`: updates per second, against plain eager loops.

With the same weights, arrays and number of threads, the contestants take turns: ours in
float32, with the next state's values in bfloat16 (double DQN), and all in bfloat16, and
two plain loops (`launch.bench_learner_peers`), one with
the network in plain form and one with the network in our form. A repetition is one turn
of each, of at least `SAMPLE_S`; a figure is the median over the repetitions, a ratio
the median of each repetition's. On one thread the clock is the process's own CPU time,
which others on the machine disturb less; on more it is the wall's.

`other_share` is the part of our update that is not the network: one minus the time of
its forward passes and its backward pass run alone on tensors that are there already.
All of the network's operators count as its arithmetic: products, attention, norms,
activations.
"""

import copy
import dataclasses
import functools
import json
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from launch.bench import machine
from launch.bench_learner_peers import (
    Apart,
    Lasted,
    Turn,
    lasted,
    plain_cloning,
    plain_network,
    torchrl_dqn,
)
from launch.bench_timing import processor_name
from launch.config import CLONING_PRESETS, ExperimentConfig, paper, write_atomically
from launch.errors import LaunchError
from learner.cloning import CloningBatch, CloningLearner
from learner.learner import Batch, Learner
from learner.network import QNetwork, to_torch
from learner.training import Precision, in_precision, keep_memory
from sim.observation import Observation, ObservationSizes, observation_sizes

SAMPLE_S: Final = 0.3
VALID: Final = 0.8  # of the rows of a random observation
PRECISIONS: Final[tuple[Precision, ...]] = get_args(Precision)
PEERS: Final = ("plain", "plain loop")
Algorithm = Literal["dqn", "bc"]
Row = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class BenchLearnerConfig:
    """Measures the learner's updates against plain eager loops."""

    presets: tuple[Literal["quick", "laptop", "paper"], ...] = (
        "quick",
        "laptop",
        "paper",
    )
    """Networks and observations."""
    algorithms: tuple[Algorithm, ...] = ("dqn", "bc")
    """Double DQN at batch 64, behaviour cloning at batch 256."""
    threads: tuple[int, ...] = (1, 2)
    """Of torch; for everyone the same."""
    repetitions: int = 3
    """Turns of each contestant."""
    json: str = ""
    """Writes the figures to this file, or to standard output by -."""
    plot: Path | None = None
    """Draws the updates per second into learner.png in this folder."""


def random_observation(
    sizes: ObservationSizes, rows: int, rng: np.random.Generator
) -> Observation:
    """Normal features; each mask is True with probability `VALID`."""

    def features(*shape: int) -> jax.Array:
        return jnp.asarray(rng.standard_normal((rows, *shape)), jnp.float32)

    def mask(count: int) -> jax.Array:
        return jnp.asarray(rng.random((rows, count)) < VALID)

    return Observation(
        ego=features(sizes.ego),
        agents=features(sizes.neighbours, sizes.agent),
        agents_valid=mask(sizes.neighbours),
        road=features(sizes.rows, sizes.road),
        road_valid=mask(sizes.rows),
        lights=features(sizes.lights, sizes.light),
        lights_valid=mask(sizes.lights),
    )


def dqn_batch(preset: ExperimentConfig) -> Batch:
    """Random transitions, as many as the paper's update has."""
    sizes = observation_sizes(preset.environment.observation)
    rng = np.random.default_rng(0)
    rows = paper().learner.batch_size
    return Batch(
        observation_tm1=random_observation(sizes, rows, rng),
        a_tm1=rng.integers(0, preset.environment.action.count, rows).astype(np.int32),
        r_t=-rng.integers(0, 2, rows).astype(np.float32),
        discount_t=(rng.random(rows) < 0.95).astype(np.float32),
        observation_t=random_observation(sizes, rows, rng),
        probabilities=rng.random(rows) + 0.01,
    )


def dqn_learner(
    preset: ExperimentConfig, threads: int, precision: Precision = "float32"
) -> Learner:
    """Double DQN with the paper's settings and the preset's network."""
    return Learner(
        config=dataclasses.replace(
            paper().learner, loss="plain", precision=precision, torch_threads=threads
        ),
        network=preset.network,
        sizes=observation_sizes(preset.environment.observation),
        actions=preset.environment.action.count,
    )


def bc_batch(preset: ExperimentConfig) -> CloningBatch:
    """Random observations and actions, as many as the paper's update has."""
    rng = np.random.default_rng(0)
    rows = paper().cloning.batch_size
    sizes = observation_sizes(preset.environment.observation)
    return CloningBatch(
        random_observation(sizes, rows, rng),
        rng.integers(0, preset.environment.action.count, rows).astype(np.int32),
        rng.uniform(-0.1, 0.1, (rows, 2)).astype(np.float32),
    )


def bc_learner(
    preset: ExperimentConfig,
    threads: int,
    precision: Literal["float32", "bfloat16"] = "float32",
) -> CloningLearner:
    """Cloning with the paper's settings and the preset's network."""
    return CloningLearner(
        config=dataclasses.replace(
            paper().cloning, precision=precision, torch_threads=threads
        ),
        network=preset.network,
        sizes=observation_sizes(preset.environment.observation),
        action=preset.environment.action,
    )


def our_turns(
    preset: ExperimentConfig, algorithm: Algorithm, threads: int
) -> dict[str, Turn]:
    """Our updates in each precision, and our network's passes alone."""
    turns: dict[str, Turn] = {}
    for precision in PRECISIONS:
        alone: list[QNetwork] = []  # passes without gradients
        if algorithm == "dqn":
            batch, ours = dqn_batch(preset), dqn_learner(preset, threads, precision)
            turns[precision] = functools.partial(ours.update, batch)
            network, seen = ours.network, batch.observation_tm1
            alone = [ours.network, ours.target]
        elif precision != "bfloat16-targets":  # cloning has none
            taken, other = bc_batch(preset), bc_learner(preset, threads, precision)
            turns[precision] = functools.partial(other.update, taken)
            network, seen = other.network, taken.observation_tm1
        else:
            continue
        turns[f"{precision} network"] = _passes(network, seen, precision, alone)
    return turns


def peer_turns(preset: ExperimentConfig, algorithm: Algorithm) -> dict[str, Turn]:
    """The plain loops, with the network in plain form and in ours."""
    threads = torch.get_num_threads()
    if algorithm == "dqn":
        ours, batch = dqn_learner(preset, threads), dqn_batch(preset)
        return {
            "plain": torchrl_dqn(ours, plain_network(ours.network), batch),
            "plain loop": torchrl_dqn(ours, copy.deepcopy(ours.network), batch),
        }
    other, taken = bc_learner(preset, threads), bc_batch(preset)
    action = preset.environment.action
    return {
        "plain": plain_cloning(other, action, plain_network(other.network), taken),
        "plain loop": plain_cloning(other, action, copy.deepcopy(other.network), taken),
    }


def _passes(
    network: QNetwork,
    observation: Observation,
    precision: Precision,
    without_gradient: list[QNetwork],
) -> Turn:
    """Forward and backward of the network, and forward of those without gradient."""
    device = torch.device("cpu")
    tensors = to_torch(observation, device)
    with torch.no_grad():
        seed = torch.ones_like(network(*tensors))

    def turn() -> object:
        with in_precision(precision, device):
            outputs = network(*tensors).float()
        with torch.no_grad(), in_precision(precision, device, learns=False):
            for other in without_gradient:
                other(*tensors)
        return torch.autograd.grad(outputs, list(network.parameters()), seed)

    return turn


def measured(contestants: Mapping[str, Lasted], *, repetitions: int) -> Row:
    """Rates, ratios and shares; the contestants take turns."""
    spent: dict[str, list[float]] = {name: [] for name in contestants}
    calls = {name: _calls(run) for name, run in contestants.items()}
    for _ in range(repetitions):
        for name, run in contestants.items():
            spent[name].append(run(calls[name]))
    row: Row = {"calls": calls}
    for name in PEERS:
        row[name] = {"updates_per_s": 1 / statistics.median(spent[name])}
    for name in [name for name in PRECISIONS if name in spent]:
        passes = zip(spent[f"{name} network"], spent[name], strict=True)
        row[name] = {
            "updates_per_s": 1 / statistics.median(spent[name]),
            "other_share": 1 - statistics.median(own / all_ for own, all_ in passes),
        }
        for peer in PEERS:
            pairs = zip(spent[peer], spent[name], strict=True)
            ratios = [other / own for other, own in pairs]
            row[name][f"over {peer}"] = statistics.median(ratios)
            row[name][f"over {peer}, each"] = ratios
    return row


def _calls(run: Lasted) -> int:
    """Calls that take about `SAMPLE_S`; the first one warms up and does not count."""
    run(1)
    return max(1, round(SAMPLE_S / max(run(1), 1e-6)))


def bench_learner_command(options: BenchLearnerConfig) -> int:
    """`slipstream bench learner`."""
    if options.repetitions < 1 or min(options.threads, default=0) < 1:
        raise LaunchError("--repetitions and --threads must be at least 1")
    rows = _rows(options)
    content = {
        "machine": {
            **machine(),
            "model": processor_name(),
            "torch": torch.__version__,
        },
        "rows": rows,
    }
    if options.plot is not None:
        _plot(rows, options.plot)
    text = json.dumps(content, indent=1)
    if options.json == "-":
        print(text)
        return 0
    if options.json:
        write_atomically(Path(options.json), (text + "\n").encode())
    Console().print(_table(rows))
    return 0


def _rows(options: BenchLearnerConfig) -> list[Row]:
    rows: list[Row] = []
    peers = Apart(peer_turns)
    keep_memory()  # as the learner's process does
    for threads in options.threads:
        clock = time.process_time if threads == 1 else time.perf_counter
        for preset in options.presets:
            config = CLONING_PRESETS[preset]()
            for algorithm in options.algorithms:
                contestants = peers.contestants(threads, config, algorithm)
                for name, turn in our_turns(config, algorithm, threads).items():
                    contestants[name] = lasted(turn, clock)
                figures = measured(contestants, repetitions=options.repetitions)
                about = {"preset": preset, "algorithm": algorithm, "threads": threads}
                rows.append({**about, "clock": clock.__name__, **figures})
    peers.close()
    return rows


def _table(rows: list[Row]) -> Table:
    heads = ("updates", "learner", "updates/s", "x plain", "x its loop", "other")
    table = Table(*heads, caption="x1: threads")
    for row in rows:
        about = f"{row['preset']} {row['algorithm']} x{row['threads']}"
        for name in PEERS:
            rate = f"{row[name]['updates_per_s']:.2f}"
            table.add_row(about, f"[dim]{name}", rate, "", "", "")
        for name in [name for name in PRECISIONS if name in row]:
            own = row[name]
            rate = f"{own['updates_per_s']:.2f}"
            ratios = [f"{own[f'over {peer}']:.2f}" for peer in PEERS]
            table.add_row(about, name, rate, *ratios, f"{own['other_share']:.0%}")
        table.add_section()
    return table


def _plot(rows: list[Row], folder: Path) -> None:
    """Ratios to the plain loop, as bars."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 0.5 * len(rows) + 1.5))
    places = np.arange(len(rows))
    for index, name in enumerate(PRECISIONS):
        ratios = [row.get(name, {}).get("over plain", 0.0) for row in rows]
        axes.barh(places + 0.27 * (index - 1), ratios, 0.25, label=name)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_yticks(
        places,
        [f"{row['preset']} {row['algorithm']} x{row['threads']}" for row in rows],
    )
    axes.set_xlabel("updates/s, as a multiple of the plain loop's")
    axes.legend()
    folder.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(folder / "learner.png", dpi=120)
    pyplot.close(figure)
