"""`slipstream evaluate`, and the comparison that a run ends with.

Agents by name are the benchmark's (`launch.drivers`); anything else is a run, its
checkpoints or one of them. The results of every scene are in the JSON, and the table
is a summary of them.
"""

import itertools
import json
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import jax

from actors.controlled import (
    ControlledSet,
    all_of,
    rows_of,
    sdc_of,
    tracks_of,
    with_others,
)
from actors.evaluation import Evaluation, evaluate
from actors.frames import FrameBatch
from actors.policy import greedy, policy_agent, random_vector, read_policy
from launch.config import ExperimentConfig, ScenesConfig, write_atomically
from launch.drivers import PLAYBACK, Driver, built_in, check_step, driver_of
from launch.errors import LaunchError
from launch.scenes import bank_of
from launch.tables import markdown_of, printer, scenes_json, summary, table_of, title_of
from sim.agents import Agent, composite
from sim.bank import BankFile
from sim.idm import idm

COMPARED: Final = ("random", "constant-speed", "idm", "expert")


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Drives scenes with one agent or several and judges them."""

    agent: tuple[str, ...]
    """log (playback), expert, expert-delta, expert-bicycle-discrete,
    expert-delta-discrete, expert-steering, idm, constant-speed, random, or runs or
    checkpoints."""
    scenes: tuple[str, ...] = ("procedural",)
    """Banks, files or folders of scenes, or `procedural`."""
    objects: str = "sdc"
    """Which objects the agent controls: sdc, all, tracks (those that the scene names to
    predict), or rows of the scenes' objects as I,J,K."""
    others: Literal["log", "idm"] = "log"
    """What all other objects do: replay the log, or react by IDM."""
    json: str = ""
    """Writes the results of every scene to this file, or to standard output by -."""
    markdown: str = ""
    """Writes the table to this file."""
    count: int = 64
    """Scenes of `procedural`."""
    seed: int = 0
    """Of the procedural scenes and of agents that draw."""


SETS: Final = {"sdc": sdc_of, "all": all_of, "tracks": tracks_of}


def rows_named(words: str) -> tuple[int, ...]:
    """The rows that `--objects` names; none where it names a set."""
    if words in SETS:
        return ()
    try:
        return tuple(int(word) for word in words.split(","))
    except ValueError as error:
        raise LaunchError(
            f"--objects {words}: choose sdc, all, tracks, or rows of objects as 0,3,5"
        ) from error


def evaluate_command(options: EvaluateConfig) -> int:
    """`slipstream evaluate`."""
    if not options.agent or len(set(options.agent)) < len(options.agent):
        raise LaunchError("--agent: name agents, runs or checkpoints, each once")
    rows = rows_named(options.objects)
    drivers = [driver_of(name) for name in options.agent]
    config = ScenesConfig(held_out=options.count, seed=options.seed)
    with ExitStack() as keep:
        bank = bank_of(options.scenes, config=config, keep=keep)
        chosen = rows_of(bank, rows) if rows else SETS[options.objects](bank)
        for driver in drivers:
            check_step(bank, driver.environment)
        results = [_evaluated(driver, bank, chosen, options) for driver in drivers]
    _write(results, options)
    return 0


def _evaluated(
    driver: Driver, bank: BankFile, chosen: ControlledSet, options: EvaluateConfig
) -> Evaluation:
    """One agent's results."""
    slots = chosen
    agent = driver.build(None)
    if options.others == "idm":
        slots = with_others(bank, chosen)
        rest = idm(driver.environment)
        agent = composite(driver.build(chosen.judged), chosen.judged, rest)
    return evaluate(
        bank,
        agent,
        name=driver.name,
        key=jax.random.key(options.seed),
        config=driver.environment,
        controlled=slots,
        from_first_step=driver.name == PLAYBACK,
    )


def _write(results: list[Evaluation], options: EvaluateConfig) -> None:
    """JSON and markdown where asked for, and the table."""
    content: dict[str, Any] = _report_json(results)
    if len(results) == 1:
        content = {**summary(results[0]), "scenes": scenes_json(results[0])}
    text = json.dumps(content, indent=1) + "\n"
    title = title_of(results, ", ".join(options.scenes))
    if options.markdown:
        markdown = markdown_of(results, title)
        write_atomically(Path(options.markdown), markdown.encode())
    if options.json == "-":
        print(text, end="")
        return
    if options.json:
        write_atomically(Path(options.json), text.encode())
    console = printer()
    console.print(table_of(results, title, width=console.width))


def _report_json(results: list[Evaluation]) -> dict[str, Any]:
    """Several agents: their figures, and every scene's row of each."""
    return {
        "agents": [summary(result) for result in results],
        "scenes": {result.agent: scenes_json(result) for result in results},
    }


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
        *((name, built_in(name, environment)) for name in COMPARED),
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
    title = title_of(results, "held out")
    text = json.dumps(_report_json(results), indent=1) + "\n"
    write_atomically(folder / "evaluation.json", text.encode())
    markdown = markdown_of(results, title)
    write_atomically(folder / "evaluation.md", markdown.encode())
    console = printer()
    console.print(table_of(results, title, width=console.width))
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
