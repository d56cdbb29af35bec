"""Evaluations as a table, as markdown and as JSON."""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from rich.console import Console
from rich.table import Table

from actors.evaluation import Evaluation
from actors.results import Figure

WIDE: Final = 156  # columns of a terminal from which on the intervals have room
_SHARE: Final = "{:.1%}"
COLUMNS: Final = (
    ("failure_rate", "failures", _SHARE),
    ("offroad_rate", "off-road", _SHARE),
    ("overlap_rate", "overlap", _SHARE),
    ("kinematic_infeasibility", "infeasible", _SHARE),
    ("log_displacement", "log ADE [m]", "{:.2f}"),
    ("progression", "progression", "{:.2f}"),
    ("wrong_way_rate", "wrong-way", _SHARE),
    ("off_route_rate", "off-route", _SHARE),
)


def printer() -> Console:
    """Standard output; wide enough for the table where it is no terminal."""
    return Console(width=None if sys.stdout.isatty() else WIDE)


def summary(evaluation: Evaluation) -> dict[str, Any]:
    """The figures of an agent; JSON has no NaN, so what there is none of is null."""
    figures = evaluation.figures
    values = {name: _known(figure.value) for name, figure in figures.items()}
    intervals = {
        name: [figure.low, figure.high]
        for name, figure in figures.items()
        if np.isfinite(figure.low)
    }
    return {
        "agent": evaluation.agent,
        "scenes": len(evaluation.scenes),
        **values,
        "intervals_95": intervals,
    }


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def scenes_json(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Every scene's row."""
    return [dataclasses.asdict(scene) for scene in evaluation.scenes]


def several_objects(evaluations: Sequence[Evaluation]) -> bool:
    """Whether some scene has more than one judged object."""
    return any(scene.objects > 1 for one in evaluations for scene in one.scenes)


def title_of(evaluations: Sequence[Evaluation], where: str) -> str:
    """What the table is of and what its rates are shares of."""
    scenes = evaluations[0].scenes
    plural = "s" if len(scenes) > 1 else ""
    of = f"{where}: {len(scenes)} scene{plural}"
    if several_objects(evaluations):
        of += f", rates of {sum(scene.objects for scene in scenes)} objects"
    return of


def _figures(evaluation: Evaluation, of_objects: bool) -> list[tuple[Figure, str]]:
    """The row of an agent: figures and their formats."""
    found = evaluation.figures
    cells = []
    for name, _, form in COLUMNS:
        own = f"object_{name}" if of_objects and name.endswith("_rate") else name
        cells.append((found.get(own, found[name]), form))
    return cells


def _text(figure: Figure, form: str) -> str:
    return form.format(figure.value) if np.isfinite(figure.value) else "-"


def _interval(figure: Figure, form: str) -> str:
    """The interval in the figure's format, the percent sign left out."""
    if not np.isfinite(figure.low):
        return ""
    low, high = (form.format(value).rstrip("%") for value in figure[1:])
    return f"[{low}, {high}]"


def table_of(evaluations: Sequence[Evaluation], title: str, *, width: int) -> Table:
    """One row per agent; each figure over its 95% interval where there is room."""
    table = Table(title=title)
    table.add_column("agent", no_wrap=True)
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    of_objects = several_objects(evaluations)
    for evaluation in evaluations:
        cells = []
        for figure, form in _figures(evaluation, of_objects):
            below = _interval(figure, form) if width >= WIDE else ""
            cells.append("\n".join(filter(None, [_text(figure, form), below])))
        table.add_row(evaluation.agent, *cells)
    return table


def markdown_of(evaluations: Sequence[Evaluation], title: str) -> str:
    """The same table for a README."""
    lines = [f"# {title}", "", "95% intervals over the scenes in brackets.", ""]
    lines.append("| agent | " + " | ".join(h for _, h, _ in COLUMNS) + " |")
    lines.append("|" + "---|" * (len(COLUMNS) + 1))
    of_objects = several_objects(evaluations)
    for evaluation in evaluations:
        cells = [
            f"{_text(figure, form)} {_interval(figure, form)}".strip()
            for figure, form in _figures(evaluation, of_objects)
        ]
        lines.append(f"| {evaluation.agent} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
