"""`slipstream evaluate`, and the comparison that a run ends with.

Agents by name are the benchmark's (`sim.agents`); anything else is a run, its
checkpoints or one of them. The results of every scene are in the JSON, and the table
is a summary of them.
"""

import dataclasses
import itertools
import json
import sys
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import jax
import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation import Evaluation, evaluate
from actors.frames import FrameBatch
from actors.policy import greedy, policy_agent, random_vector, read_policy
from launch.config import ExperimentConfig, ScenesConfig, quick, write_atomically
from launch.errors import LaunchError
from launch.scenes import bank_of
from sim.agents import (
    Agent,
    ExpertSpace,
    constant_speed,
    expert,
    log_playback,
    random_actions,
)
from sim.bank import BankFile
from sim.dynamics import ActionSpace
from sim.environment import EnvironmentConfig

NAMES: Final = ("log", "expert", "constant-speed", "random")
COLUMNS: Final = (
    ("failure_rate", "failures", "{:.1%}"),
    ("overlap_rate", "overlap", "{:.1%}"),
    ("offroad_rate", "off-road", "{:.1%}"),
    ("progress", "progress", "{:.2f}"),
    ("log_displacement", "from log [m]", "{:.2f}"),
    ("kinematic_infeasibility", "infeasible", "{:.1%}"),
)


def printer() -> Console:
    """Standard output; wide enough for the table where it is no terminal."""
    return Console(width=None if sys.stdout.isatty() else 110)


def summary(evaluation: Evaluation) -> dict[str, float | int | str | None]:
    """The figures of an agent; JSON has no NaN, so what there is none of is null."""
    figures: dict[str, float] = {
        "failure_rate": evaluation.failure_rate,
        "overlap_rate": evaluation.rate("overlap"),
        "offroad_rate": evaluation.rate("offroad"),
        "progress": evaluation.progress,
        "log_displacement": evaluation.log_displacement,
        "kinematic_infeasibility": evaluation.infeasible,
    }
    known = {k: v if np.isfinite(v) else None for k, v in figures.items()}
    return {"agent": evaluation.agent, "scenes": len(evaluation.scenes), **known}


def table_of(evaluations: Sequence[Evaluation], title: str) -> Table:
    """One row per agent."""
    table = Table(title=title)
    table.add_column("agent", no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for evaluation in evaluations:
        figures = summary(evaluation)
        cells = [
            "-" if figures[name] is None else form.format(figures[name])
            for name, _, form in COLUMNS
        ]
        table.add_row(evaluation.agent, *cells)
    return table


def markdown_of(evaluations: Sequence[Evaluation], title: str) -> str:
    """The same table for a README."""
    lines = [f"# {title}", "", "| agent | " + " | ".join(h for _, h, _ in COLUMNS)]
    lines[-1] += " |"
    lines.append("|" + "---|" * (len(COLUMNS) + 1))
    for evaluation in evaluations:
        figures = summary(evaluation)
        cells = [
            "-" if figures[name] is None else form.format(figures[name])
            for name, _, form in COLUMNS
        ]
        lines.append(f"| {evaluation.agent} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def scenes_json(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Every scene's row."""
    return [dataclasses.asdict(scene) for scene in evaluation.scenes]


def built_in(name: str, environment: EnvironmentConfig) -> Agent:
    """An agent that needs no learning."""
    if name == "log":
        return log_playback()
    if name == "expert":
        return expert(environment, ExpertSpace(ActionSpace.BICYCLE, on_grid=False))
    if name == "constant-speed":
        return constant_speed(environment)
    return random_actions(environment)


@dataclass(frozen=True)
class Driver:
    """An agent with the environment that it knows."""

    name: str
    agent: Agent
    environment: EnvironmentConfig


def driver_of(name: str) -> Driver:
    """What `--agent` names."""
    if name in NAMES:
        environment = quick().environment
        return Driver(name, built_in(name, environment), environment)
    path = Path(name)
    if not path.exists():
        raise LaunchError(
            f"--agent {name}: unknown; one of {', '.join(NAMES)}, or the path of a run "
            "or a checkpoint"
        )
    policy = read_policy(path)
    try:
        config = msgspec.convert(policy.extra["config"], ExperimentConfig)
    except (KeyError, ValueError) as error:
        raise LaunchError(
            f"{path}: the checkpoint lacks its run's configuration ({error}); use one "
            "that `slipstream train` wrote"
        ) from error
    policy.check(config.environment, path)
    agent = policy_agent(policy, config.environment)
    return Driver(str(path), agent, config.environment)


def check_step(bank: BankFile, environment: EnvironmentConfig) -> None:
    """Refuses scenes of another step length than the agent was made for."""
    if abs(bank.dt - environment.dt) > 1e-6:
        raise LaunchError(
            f"{bank.path}: steps of {bank.dt} s, the agent's are {environment.dt} s; "
            "use scenes recorded at that rate"
        )


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Drives scenes with an agent and judges it."""

    agent: str
    """expert, constant-speed, random, log (playback), or a run or checkpoint."""
    scenes: tuple[str, ...] = ("procedural",)
    """Banks, files or folders of scenes, or `procedural`."""
    objects: Literal["sdc", "all"] = "sdc"
    """Which objects the agent controls."""
    json: str = ""
    """Writes the results of every scene to this file, or to standard output by -."""
    count: int = 64
    """Scenes of `procedural`."""
    seed: int = 0
    """Of the procedural scenes and of agents that draw."""


def evaluate_command(options: EvaluateConfig) -> int:
    """`slipstream evaluate`."""
    driver = driver_of(options.agent)
    config = ScenesConfig(held_out=options.count, seed=options.seed)
    with ExitStack() as keep:
        bank = bank_of(options.scenes, config=config, keep=keep)
        check_step(bank, driver.environment)
        result = evaluate(
            bank,
            driver.agent,
            name=driver.name,
            key=jax.random.key(options.seed),
            config=driver.environment,
            all_objects=options.objects == "all",
            from_first_step=driver.name == "log",
        )
    content = {**summary(result), "scenes": scenes_json(result)}
    text = json.dumps(content, indent=1)
    if options.json == "-":
        print(text)
        return 0
    if options.json:
        write_atomically(Path(options.json), (text + "\n").encode())
    names = ", ".join(options.scenes)
    printer().print(table_of([result], f"{names}: {bank.scenes} scenes"))
    return 0


def compare(
    config: ExperimentConfig, policy_path: Path, bank: BankFile
) -> list[Evaluation]:
    """The trained agent beside the untrained network and the benchmark's agents."""
    environment = config.environment
    policy = read_policy(policy_path)
    policy.check(environment, policy_path)
    key = jax.random.fold_in(jax.random.key(config.seed), 1_000_000)
    weights_key, key = jax.random.split(key)
    untrained = random_vector(weights_key, config.network, environment)
    drivers: list[tuple[str, Agent]] = [
        ("trained", policy_agent(policy, environment)),
        ("untrained", greedy(untrained, config.network, environment)),
        *((name, built_in(name, environment)) for name in reversed(NAMES[1:])),
    ]
    results = []
    for name, agent in drivers:
        key, own_key = jax.random.split(key)
        result = evaluate(
            bank,
            agent,
            name=name,
            key=own_key,
            config=environment,
            keep_trace=name == "trained",
        )
        results.append(result)
    return results


def chosen(
    evaluation: Evaluation, rollouts: Iterable[tuple[str, FrameBatch]], *, most: int
) -> list[tuple[str, FrameBatch]]:
    """Rollouts to record, failed and successful ones in turns: one kind misleads."""
    kinds: dict[bool, list[tuple[str, FrameBatch]]] = {False: [], True: []}
    for name, batch in rollouts:
        scene = evaluation.scenes[int(batch.frames["scene"][0])]
        how = "fails" if scene.failed else "drives through"
        kinds[scene.failed].append((f"{name} {how}, scene {scene.id}", batch))
    pairs = itertools.zip_longest(kinds[False], kinds[True])
    return [one for pair in pairs for one in pair if one is not None][:most]


def report(
    folder: Path, config: ExperimentConfig, bank: BankFile, policy_path: Path
) -> list[Evaluation]:
    """Writes a run's evaluation.json, .md and .rrd, and prints its table."""
    results = compare(config, policy_path, bank)
    title = f"{bank.scenes} held-out scene{'s' if bank.scenes > 1 else ''}"
    content = {
        "agents": [summary(result) for result in results],
        "scenes": {result.agent: scenes_json(result) for result in results},
    }
    text = json.dumps(content, indent=1) + "\n"
    write_atomically(folder / "evaluation.json", text.encode())
    markdown = markdown_of(results, title)
    write_atomically(folder / "evaluation.md", markdown.encode())
    printer().print(table_of(results, title))
    return results


def record(
    folder: Path, config: ExperimentConfig, bank: BankFile, trained: Evaluation
) -> Path | None:
    """Writes the recording of the trained agent; None where Rerun is not installed."""
    try:
        from launch.bank_view import bank_scenes, labels_of
        from launch.recording import record_evaluation, rollouts_of
    except ImportError:
        return None
    path = folder / "evaluation.rrd"
    record_evaluation(
        path,
        scene_of=bank_scenes(bank),
        rollouts=chosen(
            trained, rollouts_of(trained, bank), most=config.report.rollouts
        ),
        actions=labels_of(config.environment.action),
    )
    return path
