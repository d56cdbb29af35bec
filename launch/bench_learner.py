"""`slipstream bench learner`: updates per second, against plain eager loops.

In one process, with the same network, arrays and number of threads, the contestants
take turns: ours in float32, ours in bfloat16, and the plain loop
(`launch.bench_learner_peers`). A repetition is one turn of each, of at least
`SAMPLE_S`; a figure is the median over the repetitions, a ratio the median of each
repetition's. On one thread the clock is the process's own CPU time, which others on
the machine disturb less; on more it is the wall's.

`other_share` is the part of our update that is not the network: one minus the time of
its forward passes and its backward pass run alone on tensors that are there already.
All of the network's operators count as its arithmetic: products, attention, norms,
activations.
"""

import dataclasses
import json
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import jax
import jax.numpy as jnp
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from launch.bench import machine
from launch.bench_learner_peers import Turn, plain_cloning, torchrl_dqn
from launch.bench_timing import processor_name
from launch.config import CLONING_PRESETS, ExperimentConfig, paper, write_atomically
from launch.errors import LaunchError
from learner.cloning import CloningBatch, CloningLearner
from learner.learner import Batch, Learner
from learner.network import QNetwork, to_torch
from learner.training import in_precision
from sim.observation import Observation, ObservationSizes, observation_sizes

SAMPLE_S: Final = 0.3
VALID: Final = 0.8  # of the rows of a random observation
PRECISIONS: Final[tuple[Literal["float32", "bfloat16"], ...]] = ("float32", "bfloat16")
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
    algorithms: tuple[Literal["dqn", "bc"], ...] = ("dqn", "bc")
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


def dqn_turns(preset: ExperimentConfig, threads: int) -> dict[str, Turn]:
    """The contestants of double DQN, and our network's passes alone."""
    sizes = observation_sizes(preset.environment.observation)
    actions = preset.environment.action.count
    rng = np.random.default_rng(0)
    rows = paper().learner.batch_size
    batch = Batch(
        observation_tm1=random_observation(sizes, rows, rng),
        a_tm1=rng.integers(0, actions, rows).astype(np.int32),
        r_t=-rng.integers(0, 2, rows).astype(np.float32),
        discount_t=(rng.random(rows) < 0.95).astype(np.float32),
        observation_t=random_observation(sizes, rows, rng),
        probabilities=rng.random(rows) + 0.01,
    )

    def learner(precision: Literal["float32", "bfloat16"]) -> Learner:
        config = dataclasses.replace(
            paper().learner, loss="plain", precision=precision, torch_threads=threads
        )
        return Learner(
            config=config, network=preset.network, sizes=sizes, actions=actions
        )

    turns: dict[str, Turn] = {}
    for precision in PRECISIONS:
        ours = learner(precision)
        turns[precision] = lambda ours=ours: ours.update(batch)  # type: ignore[misc]
        turns[f"{precision} network"] = _passes(
            ours.network, batch.observation_tm1, precision, [ours.network, ours.target]
        )
    peer = learner("float32")
    turns["peer"] = torchrl_dqn(peer, peer.network, batch)
    return turns


def bc_turns(preset: ExperimentConfig, threads: int) -> dict[str, Turn]:
    """The contestants of cloning, and our network's passes alone."""
    sizes = observation_sizes(preset.environment.observation)
    action = preset.environment.action
    defaults = paper().cloning
    rng = np.random.default_rng(0)
    rows = defaults.batch_size
    batch = CloningBatch(
        random_observation(sizes, rows, rng),
        rng.integers(0, action.count, rows).astype(np.int32),
        rng.uniform(-0.1, 0.1, (rows, 2)).astype(np.float32),
    )

    def learner(precision: Literal["float32", "bfloat16"]) -> CloningLearner:
        config = dataclasses.replace(
            defaults, precision=precision, torch_threads=threads
        )
        return CloningLearner(
            config=config, network=preset.network, sizes=sizes, action=action
        )

    turns: dict[str, Turn] = {}
    for precision in PRECISIONS:
        ours = learner(precision)
        turns[precision] = lambda ours=ours: ours.update(batch)  # type: ignore[misc]
        turns[f"{precision} network"] = _passes(
            ours.network, batch.observation_tm1, precision, []
        )
    peer = learner("float32")
    turns["peer"] = plain_cloning(peer, action, peer.network, batch)
    return turns


def _passes(
    network: QNetwork,
    observation: Observation,
    precision: Literal["float32", "bfloat16"],
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
            with torch.no_grad():
                for other in without_gradient:
                    other(*tensors)
        return torch.autograd.grad(outputs, list(network.parameters()), seed)

    return turn


def measured(
    turns: Mapping[str, Turn], *, repetitions: int, clock: Callable[[], float]
) -> Row:
    """Rates, ratios and shares; the contestants take turns."""
    spent: dict[str, list[float]] = {name: [] for name in turns}
    loops = {name: _loop(turn, clock) for name, turn in turns.items()}
    for _ in range(repetitions):
        for name, turn in turns.items():
            spent[name].append(_lasted(turn, loops[name], clock))
    row: Row = {
        "peer_updates_per_s": 1 / statistics.median(spent["peer"]),
        "calls": loops,
    }
    for name in PRECISIONS:
        pairs = zip(spent["peer"], spent[name], strict=True)
        passes = zip(spent[f"{name} network"], spent[name], strict=True)
        ratios = [peer / own for peer, own in pairs]
        row[name] = {
            "updates_per_s": 1 / statistics.median(spent[name]),
            "ratios": ratios,
            "ratio": statistics.median(ratios),
            "other_share": 1 - statistics.median(own / all_ for own, all_ in passes),
        }
    return row


def _loop(turn: Turn, clock: Callable[[], float]) -> int:
    """Calls that take about `SAMPLE_S`; the first one warms up and does not count."""
    turn()
    return max(1, round(SAMPLE_S / max(_lasted(turn, 1, clock), 1e-6)))


def _lasted(turn: Turn, times: int, clock: Callable[[], float]) -> float:
    begin = clock()
    for _ in range(times):
        turn()
    return (clock() - begin) / times


def bench_learner_command(options: BenchLearnerConfig) -> int:
    """`slipstream bench learner`."""
    if options.repetitions < 1 or min(options.threads, default=0) < 1:
        raise LaunchError("--repetitions and --threads must be at least 1")
    makers = {"dqn": dqn_turns, "bc": bc_turns}
    rows: list[Row] = []
    for threads in options.threads:
        clock = time.process_time if threads == 1 else time.perf_counter
        for preset in options.presets:
            config = CLONING_PRESETS[preset]()
            for algorithm in options.algorithms:
                turns = makers[algorithm](config, threads)
                figures = measured(turns, repetitions=options.repetitions, clock=clock)
                about = {"preset": preset, "algorithm": algorithm, "threads": threads}
                rows.append({**about, "clock": clock.__name__, **figures})
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


def _table(rows: list[Row]) -> Table:
    table = Table(
        "", "threads", "plain/s", "float32/s", "x", "other", "bfloat16/s", "x", "other"
    )
    for row in rows:
        cells = [f"{row['preset']} {row['algorithm']}", str(row["threads"])]
        cells.append(f"{row['peer_updates_per_s']:.2f}")
        for name in PRECISIONS:
            own = row[name]
            cells += [f"{own['updates_per_s']:.2f}", f"{own['ratio']:.2f}"]
            cells.append(f"{own['other_share']:.0%}")
        table.add_row(*cells)
    return table


def _plot(rows: list[Row], folder: Path) -> None:
    """Ratios to the plain loop, as bars."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 0.5 * len(rows) + 1.5))
    places = np.arange(len(rows))
    for index, name in enumerate(PRECISIONS):
        ratios = [row[name]["ratio"] for row in rows]
        axes.barh(places + 0.4 * index - 0.2, ratios, 0.38, label=name)
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
