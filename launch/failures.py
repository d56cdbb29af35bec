"""What an evaluation's table does not show: which scenes fail, and how wide it is.

The scenes that an agent fails are listed by their ids, so that they can be looked at in
a recording or driven again; the figures' intervals are drawn side by side; and of an
agent that was chosen among checkpoints by some of the scenes, the others' figures are
given apart.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from actors.evaluation import Evaluation
from actors.results import SceneResult
from launch.tables import COLUMNS, summary

LISTED: Final = 200  # failed scenes of an agent in markdown; JSON has all
_SHOWN: Final = 4  # panels in a row


def how_failed(scene: SceneResult) -> str:
    """In words: which failures, and at how many steps."""
    parts = [
        f"{word} at {count} step{'s' if count > 1 else ''}"
        for word, count in (("overlap", scene.overlap), ("off-road", scene.offroad))
        if count
    ]
    return ", ".join(parts)


def failures_json(evaluations: Sequence[Evaluation]) -> dict[str, list[str]]:
    """The ids of the scenes that each agent fails."""
    return {
        one.agent: [scene.id for scene in one.scenes if scene.failed]
        for one in evaluations
    }


def failures_of(evaluations: Sequence[Evaluation]) -> str:
    """Markdown: the failed scenes of each agent and what happened in them."""
    lines: list[str] = []
    for one in evaluations:
        failed = [scene for scene in one.scenes if scene.failed]
        lines += ["", f"## Failures of {one.agent}: {len(failed)} scenes", ""]
        lines += [f"- {scene.id}: {how_failed(scene)}" for scene in failed[:LISTED]]
        if len(failed) > LISTED:
            lines.append(f"- and {len(failed) - LISTED} more")
    return "\n".join(lines) + "\n"


def others_json(trained: Evaluation, chosen_by: int) -> dict[str, Any]:
    """The figures over the scenes that the checkpoint was not chosen by."""
    others = dataclasses.replace(trained, scenes=trained.scenes[chosen_by:], trace=None)
    return {
        "chosen_by_scenes": min(chosen_by, len(trained.scenes)),
        "on_others": summary(others) if others.scenes else None,
    }


def plot_intervals(
    evaluations: Sequence[Evaluation], path: Path, title: str = ""
) -> None:
    """Draws every figure of the table with its 95% interval, agents as rows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    down = -(-len(COLUMNS) // _SHOWN)
    height = 0.9 + 0.28 * len(evaluations)
    figure = Figure(figsize=(3.1 * _SHOWN, height * down + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    names = [one.agent for one in evaluations]
    found = [one.figures for one in evaluations]
    rows = np.arange(len(names))
    for index, (column, heading, form) in enumerate(COLUMNS):
        axes = figure.add_subplot(down, _SHOWN, index + 1)
        values = np.array([figures[column] for figures in found])
        values = values * (100.0 if form.endswith("%}") else 1.0)
        middle = values[:, 0]
        spread = np.nan_to_num(np.abs(values[:, 1:] - middle[:, None])).T
        axes.errorbar(middle, rows, xerr=spread, fmt="o", capsize=3, markersize=4)
        axes.set_yticks(rows, names if index % _SHOWN == 0 else [""] * len(names))
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_title(heading + (" [%]" if form.endswith("%}") else ""), fontsize=9)
        axes.tick_params(labelsize=7)
        axes.grid(visible=True, axis="x", alpha=0.3)
    figure.suptitle(f"{title}; bars: 95% intervals over the scenes", fontsize=10)
    figure.savefig(path, dpi=120)
