"""`slipstream bench pipeline`: what a run of the quick preset achieves, and on what.

The run is a real one, all roles as processes over Zenoh, in a temporary folder.
Figures are differences between two looks at the same counters: the first once the
learner has updated for `warm_up`, so compilation does not count, the last at the end.
`waits` is the share of a process's time that it was held up by others: the learner for
samples, an actor for its window of unacknowledged batches.
"""

import asyncio
import dataclasses
import os
import platform
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from launch.bench_output import check_outputs, write_report
from launch.budget import BudgetConfig
from launch.config import quick
from launch.errors import LaunchError
from launch.supervisor import Outcome
from launch.train import TrainConfig, prepare, supervise

Figures = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class PipelineConfig:
    """Measures a run of the quick preset."""

    seconds: float = 60.0
    """How long is measured."""
    warm_up: float = 10.0
    """Seconds of updates before that."""
    scenes: tuple[str, ...] = ("procedural",)
    """As for train."""
    actors: int = 2
    """Actor processes."""
    json: str = ""
    """Writes the figures to this file, or to standard output by -."""


def _shares(before: Mapping[str, Any], after: Mapping[str, Any], clock: str) -> Any:  # noqa: ANN401 - JSON
    """Shares of a role's time by what it was spent on."""
    wall = after[clock] - before[clock]
    spent = {
        name.removesuffix("_s"): (after[name] - before[name]) / wall
        for name in ("waited_s", "acted_s", "rendered_s", "updated_s")
        if name in after
    }
    return {**spent, "other": 1.0 - sum(spent.values())}


def measured(first: Figures, last: Figures) -> dict[str, Any]:
    """Rates and shares between two looks."""
    ours, theirs = first["roles"], last["roles"]
    learner, learner_then = theirs["learner"], ours["learner"]
    wall = learner["updating_s"] - learner_then["updating_s"]
    actors = [name for name in theirs if name.startswith("actor") and name in ours]
    if wall <= 0 or not actors:
        raise LaunchError("nothing was measured: give it more --seconds")
    steps_per_s = sum(
        (theirs[name]["steps"] - ours[name]["steps"])
        / max(theirs[name]["uptime_s"] - ours[name]["uptime_s"], 1e-9)
        for name in actors
    )
    looked = last["looked_s"] - first["looked_s"]
    processes = {"learner": _shares(learner_then, learner, "updating_s")}
    for name in actors:
        processes[name] = _shares(ours[name], theirs[name], "uptime_s")
    return {
        "seconds": wall,
        "environment_steps_per_s": steps_per_s,
        "transitions_per_s": (last["steps"] - first["steps"]) / looked,
        "samples_per_s": (last["samples"] - first["samples"]) / looked,
        "updates_per_s": (learner["updates"] - learner_then["updates"]) / wall,
        "samples_per_insert": last["samples_per_insert"],
        "configured_samples_per_insert": last["configured_samples_per_insert"],
        "learner_waits": processes["learner"]["waited"],
        "processes": processes,
        "cores_used": last["cpu"],
    }


def pipeline_command(options: PipelineConfig) -> int:
    """`slipstream bench pipeline`."""
    check_outputs(options.json)
    looks: list[Figures] = []

    def on_look(figures: Figures) -> None:
        roles = figures["roles"]
        warm = roles.get("learner", {}).get("updating_s", 0.0) >= options.warm_up
        if warm and all(f"actor-{i}" in roles for i in range(options.actors)):
            looks.append(figures)

    minutes = (options.warm_up + options.seconds) / 60
    config = dataclasses.replace(
        quick(),
        budget=BudgetConfig(updates=10**9, minutes=minutes),
        actors=options.actors,
    )
    with tempfile.TemporaryDirectory(prefix="slipstream-bench-") as name:
        folder, run = prepare(
            TrainConfig(run=Path(name) / "run", scenes=options.scenes, config=config)
        )
        result = asyncio.run(supervise(folder, run, on_look=on_look))
        if result.outcome is not Outcome.FINISHED:
            raise LaunchError(f"the run ended early: {result.reason}")
    if len(looks) < 2:
        raise LaunchError("nothing was measured: give it more --seconds")
    content = {"machine": machine(), **measured(looks[0], looks[-1])}
    write_report(content, json_path=options.json)
    if options.json != "-":
        Console().print(_table(content))
    return 0


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "cores": len(os.sched_getaffinity(0)),
        "processor": platform.processor() or platform.machine(),
        "python": platform.python_version(),
    }


def _table(content: Mapping[str, Any]) -> Table:
    table = Table(title="pipeline, preset quick", show_header=False)
    for name in (
        "environment_steps_per_s",
        "transitions_per_s",
        "samples_per_s",
        "updates_per_s",
        "samples_per_insert",
    ):
        table.add_row(name, f"{content[name]:,.2f}")
    for role, shares in content["processes"].items():
        parts = [f"{name} {share:.1%}" for name, share in shares.items()]
        table.add_row(f"time of {role}", ", ".join(parts))
    cores = [f"{name} {share:.2f}" for name, share in content["cores_used"].items()]
    table.add_row("cores", ", ".join(cores))
    return table
