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
from actors.evaluation import Evaluation, Judge, evaluate
from actors.frames import FrameBatch
from actors.policy import Policy, find_policy, greedy, random_vector, read_policy
from launch.budget import ScenesConfig
from launch.config import (
    ExperimentConfig,
    RunFile,
    write_atomically,
)
from launch.drivers import PLAYBACK, Driver, built_in, check_step, driver_of
from launch.errors import LaunchError
from launch.failures import failures_json, failures_of, others_json, plot_intervals
from launch.scenes import bank_of
from launch.tables import markdown_of, printer, scenes_json, summary, table_of, title_of
from sim.agents import Agent, composite
from sim.bank import BankFile
from sim.dynamics import ActionConfig
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
    """Writes the table, and which scenes fail, to this file."""
    plot: str = ""
    """Draws the figures with their intervals into this file (PNG, SVG or PDF)."""
    record: str = ""
    """Records rollouts of the one agent for the viewer in this file (.rrd), failed ones
    and others in turns."""
    rollouts: int = 12
    """How many."""
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
    if options.record and (len(options.agent) > 1 or options.objects != "sdc"):
        raise LaunchError(
            "--record shows the recording vehicle by one agent: name one --agent, and "
            "leave --objects at sdc"
        )
    drivers = [driver_of(name) for name in options.agent]
    config = ScenesConfig(held_out=options.count, seed=options.seed)
    with ExitStack() as keep:
        bank = bank_of(options.scenes, config=config, keep=keep)
        chosen = rows_of(bank, rows) if rows else SETS[options.objects](bank)
        for driver in drivers:
            check_step(bank, driver.environment)
        results = [_evaluated(driver, bank, chosen, options) for driver in drivers]
        if options.record:
            path, action = Path(options.record), drivers[0].environment.action
            if not record(path, action, bank, results[0], most=options.rollouts):
                raise LaunchError(
                    "--record needs the viewer's packages: pip install "
                    "'slipstream[viewer]'"
                )
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
        keep_trace=bool(options.record),
    )


def _write(results: list[Evaluation], options: EvaluateConfig) -> None:
    """JSON and markdown where asked for, and the table."""
    content: dict[str, Any] = _report_json(results)
    if len(results) == 1:
        content = {
            **summary(results[0]),
            "failures": failures_json(results)[results[0].agent],
            "scenes": scenes_json(results[0]),
        }
    text = json.dumps(content, indent=1) + "\n"
    title = title_of(results, ", ".join(options.scenes))
    if options.markdown:
        markdown = markdown_of(results, title) + failures_of(results)
        write_atomically(Path(options.markdown), markdown.encode())
    if options.plot:
        _plot(results, Path(options.plot), title)
    if options.json == "-":
        print(text, end="")
        return
    if options.json:
        write_atomically(Path(options.json), text.encode())
    console = printer()
    console.print(table_of(results, title, width=console.width))


def _plot(results: list[Evaluation], path: Path, title: str) -> None:
    """The figures with their intervals, in a format that matplotlib knows."""
    try:
        plot_intervals(results, path, title)
    except ImportError as error:
        raise LaunchError(
            "--plot needs matplotlib: pip install 'slipstream[learner]'"
        ) from error
    except ValueError as error:  # of an unknown format
        raise LaunchError(f"--plot {path}: {error}") from error


def _report_json(results: list[Evaluation]) -> dict[str, Any]:
    """Several agents: their figures, and every scene's row of each."""
    return {
        "failures": failures_json(results),
        "agents": [summary(result) for result in results],
        "scenes": {result.agent: scenes_json(result) for result in results},
    }


def compare(
    config: ExperimentConfig, policy: Policy, judge: Judge, bank: BankFile
) -> list[Evaluation]:
    """The trained agent beside the untrained network and the benchmark's agents."""
    environment = config.environment
    key = jax.random.fold_in(jax.random.key(config.seed), 1_000_000)
    weights_key, *keys = jax.random.split(key, 3 + len(COMPARED))
    trained = judge.evaluate(
        policy.vector, name="trained", key=keys[0], keep_trace=True
    )
    untrained = random_vector(weights_key, config.network, environment)
    drivers: list[tuple[str, Agent]] = [
        ("untrained", greedy(untrained, config.network, environment)),
        *((name, built_in(name, environment)) for name in COMPARED),
    ]
    return [trained] + [
        evaluate(bank, agent, name=name, key=own_key, config=environment)
        for (name, agent), own_key in zip(drivers, keys[1:], strict=True)
    ]


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
    folder: Path, run: RunFile, judge: Judge, bank: BankFile
) -> list[Evaluation]:
    """Writes a run's evaluation.json, .md and .png, and prints its table."""
    policy_path = find_policy(folder)
    policy = read_policy(policy_path)
    policy.check(run.config.environment, policy_path)
    results = compare(run.config, policy, judge, bank)
    title = title_of(results, "held out")
    content = _report_json(results) | others_json(
        results[0], run.config.evaluator.scenes
    )
    text = json.dumps(content, indent=1) + "\n"
    write_atomically(folder / "evaluation.json", text.encode())
    markdown = markdown_of(results, title) + failures_of(results[:1])
    write_atomically(folder / "evaluation.md", markdown.encode())
    plot_intervals(results, folder / "evaluation.png", title)
    console = printer()
    console.print(table_of(results, title, width=console.width))
    return results


def record(
    path: Path, action: ActionConfig, bank: BankFile, driven: Evaluation, *, most: int
) -> bool:
    """Writes the recording of an agent; False where Rerun is not installed."""
    try:
        from launch.bank_view import bank_scenes, labels_of
        from launch.recording import record_evaluation, rollouts_of
    except ImportError:
        return False
    record_evaluation(
        path,
        scene_of=bank_scenes(bank),
        rollouts=chosen(driven, rollouts_of(driven, bank), most=most),
        actions=labels_of(action),
    )
    return True
