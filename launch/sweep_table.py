"""The sweep's results: a table laid out like the paper's Table 3, and the curves.

Agents are rows: the benchmark's, then for every action space the best of its runs, by
failure rate and then log displacement (the order by which a run keeps its best
checkpoint). Columns are the benchmark's metrics with 95% intervals over the held-out
scenes. Learning rate and checkpoint are chosen by these very scenes: the more of both
there are, the more that flatters. A second table has every run: how long it was trained
and its failures on the scenes that did not choose its checkpoint.
"""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from rich.table import Table

from launch.config import write_atomically
from launch.sweep_ledger import Point
from launch.sweep_results import Finished, Summary, read_finished, results_of
from launch.tables import WIDE, printer

METRICS: Final = (
    ("offroad_rate", "off-road", "{:.1%}"),
    ("overlap_rate", "collision", "{:.1%}"),
    ("kinematic_infeasibility", "infeasible", "{:.1%}"),
    ("log_displacement", "log ADE [m]", "{:.2f}"),
    ("progression", "route progress", "{:.1%}"),
    ("failure_rate", "failures", "{:.1%}"),
    ("wrong_way_rate", "wrong-way", "{:.1%}"),
    ("off_route_rate", "off-route", "{:.1%}"),
)
_SPACES: Final = {
    "bicycle": "Bicycle",
    "delta": "Delta",
    "bicycle-discrete": "Bicycle-Discrete",
    "delta-discrete": "Delta-Discrete",
}
_AGENTS: Final = {
    "expert": ("Expert", "bicycle"),
    "expert-delta": ("Expert", "delta"),
    "expert-bicycle-discrete": ("Expert", "bicycle-discrete"),
    "expert-delta-discrete": ("Expert", "delta-discrete"),
    "idm": ("IDM", ""),
    "constant-speed": ("Constant speed", ""),
    "random": ("Random", ""),
}
EVALUATIONS: Final = "evaluation.csv"
_NAMES: Final = {"bc": "BC", "dqn": "DQN"}
CURVES: Final = (
    ("failure_rate", "failure rate, held out"),
    ("log_displacement", "log ADE [m], held out"),
    ("log_likelihood", "log-likelihood, held out [nats]"),
)
_COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_STYLES: Final = ("-", "--", ":", "-.")


def baselines_of(path: Path) -> list[Summary]:
    """The figures of the benchmark's agents."""
    return list(json.loads(path.read_text())["agents"])


def best_of(results: Mapping[Point, Summary]) -> list[Point]:
    """The best run of each algorithm and action space, in the grid's order."""
    groups: dict[tuple[str, str], list[Point]] = {}
    for point in results:
        groups.setdefault((point.algorithm, point.space), []).append(point)

    def order(point: Point) -> tuple[float, float]:
        found = results[point]
        return float(found["failure_rate"]), float(found["log_displacement"])

    return [min(points, key=order) for points in groups.values()]


def rows_of(
    results: Mapping[Point, Summary], baselines: Sequence[Summary]
) -> list[dict[str, Any]]:
    """The table's rows, as its JSON has them."""
    rows = []
    for summary in baselines:
        agent, space = _AGENTS[summary["agent"]]
        rows.append(
            {"agent": agent, "space": space, "learning_rate": None, **_of(summary)}
        )
    return rows + [_row(point, results[point]) for point in best_of(results)]


def _row(point: Point, summary: Summary) -> dict[str, Any]:
    return {
        "agent": _NAMES[point.algorithm],
        "space": point.space,
        "learning_rate": point.learning_rate or None,
        **_of(summary),
    }


def _of(summary: Summary) -> dict[str, Any]:
    """The metrics of a summary and their intervals."""
    return {
        "scenes": summary["scenes"],
        **{name: summary[name] for name, _, _ in METRICS},
        "intervals_95": {
            name: summary["intervals_95"][name]
            for name, _, _ in METRICS
            if name in summary["intervals_95"]
        },
    }


def _run(one: Finished) -> dict[str, Any]:
    """A run's row of the second table."""
    others = one.others
    return {
        **_row(one.point, one.trained),
        "run": one.point.name,
        "updates": one.updates,
        "minutes": round(one.minutes, 1),
        "scenes_held_out": [scene.id for scene in one.scenes],
        "on_others": _of(others) if others else None,
    }


def _cell(row: Mapping[str, Any], name: str, form: str) -> str:
    if row[name] is None:
        return "-"
    text = form.format(row[name])
    if name in row["intervals_95"]:
        low, high = (form.format(v).rstrip("%") for v in row["intervals_95"][name])
        text += f" [{low}, {high}]"
    return text


def _words(row: Mapping[str, Any]) -> list[str]:
    rate = row["learning_rate"]
    return [
        row["agent"],
        _SPACES.get(row["space"], "-"),
        f"{rate:g}" if rate else "-",
        *(_cell(row, name, form) for name, _, form in METRICS),
    ]


def headings() -> list[str]:
    """Of the columns."""
    return ["agent", "action space", "learning rate", *(h for _, h, _ in METRICS)]


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table for a README."""
    lines = ["| " + " | ".join(headings()) + " |", "|" + "---|" * len(headings())]
    lines += ["| " + " | ".join(_words(row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def markdown_of_runs(runs: Sequence[Mapping[str, Any]]) -> str:
    """The second table."""
    heads = ["run", "updates", "minutes", "failures", "log ADE [m]"]
    heads += ["scenes that did not choose", "failures on them"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in runs:
        others = row["on_others"]
        words = [row["run"], f"{row['updates']:,}", f"{row['minutes']:.1f}"]
        words.append(_cell(row, "failure_rate", "{:.1%}"))
        words.append(_cell(row, "log_displacement", "{:.2f}"))
        words.append(str(others["scenes"]) if others else "-")
        words.append(_cell(others, "failure_rate", "{:.1%}") if others else "-")
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join(lines) + "\n"


def write_table(
    folder: Path,
    points: Sequence[Point],
    runs: Sequence[Path],
    baselines: Sequence[Summary],
    command: str,
) -> None:
    """Writes table.md, table.json and curves.png, and prints the table."""
    finished = [
        found
        for point, run in zip(points, runs, strict=True)
        if (found := read_finished(point, run)) is not None
    ]
    ended = {one.point for one in finished}
    missing = [point.name for point in points if point not in ended]
    rows = rows_of(results_of(points, finished), baselines)
    every = [_run(one) for one in finished]
    content = {"command": command, "table": rows, "runs": every, "failed": missing}
    text = json.dumps(content, indent=1) + "\n"
    write_atomically(folder / "table.json", text.encode())
    in_turn = ", each held out in turn" if points[0].held_out >= 0 else " held out"
    parts = [
        f"# {rows[0]['scenes']} scenes{in_turn}\n",
        f"    {command}\n",
        "95% intervals over the scenes in brackets.\n",
        markdown(rows),
        "## Every run\n",
        markdown_of_runs(every),
    ]
    if missing:
        parts.append(f"Failed: {', '.join(missing)}; the reasons are in logs/.\n")
    write_atomically(folder / "table.md", "\n".join(parts).encode())
    told = f"table: {folder / 'table.md'}"
    if plot_curves(folder / "curves.png", points, runs):
        told += f"  curves: {folder / 'curves.png'}"
    _print(rows, missing)
    print(told)


def _print(rows: Sequence[Mapping[str, Any]], missing: Sequence[str]) -> None:
    console = printer()
    shown = Table(title=f"{rows[0]['scenes']} held-out scenes")
    for index, heading in enumerate(headings()):
        justify: Literal["left", "right"] = "right" if index > 2 else "left"
        shown.add_column(heading, justify=justify, no_wrap=index < 3)
    for row in rows:
        parts = [word.partition(" [") for word in _words(row)]
        below = console.width >= WIDE  # room for the intervals
        shown.add_row(
            *(
                f"{value}\n[{rest}" if rest and below else value
                for value, _, rest in parts
            )
        )
    console.print(shown)
    if missing:
        console.print(f"failed: {', '.join(missing)}")


def plot_curves(path: Path, points: Sequence[Point], runs: Sequence[Path]) -> bool:
    """Draws how the runs' checkpoints drove; False where none was judged."""
    if not any((run / EVALUATIONS).exists() for run in runs):
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    algorithms = list(dict.fromkeys(point.algorithm for point in points))
    spaces = list(dict.fromkeys(point.space for point in points))
    rates = sorted({point.learning_rate for point in points if point.learning_rate})
    size = (4.6 * len(CURVES), 3.4 * len(algorithms))
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    for down, algorithm in enumerate(algorithms):
        shown = [
            (point, read_curve(run / EVALUATIONS))
            for point, run in zip(points, runs, strict=True)
            if point.algorithm == algorithm
        ]
        for across, (name, title) in enumerate(CURVES):
            if not any(name in curve for _, curve in shown):
                continue  # DQN has no likelihood
            place = down * len(CURVES) + across + 1
            axes = figure.add_subplot(len(algorithms), len(CURVES), place)
            for point, curve in shown:
                steps, values = curve.get(name, ([], []))
                rate = point.learning_rate
                axes.plot(
                    steps,
                    values,
                    color=_COLOURS[spaces.index(point.space) % len(_COLOURS)],
                    linestyle=_STYLES[rates.index(rate) % len(_STYLES)]
                    if rate
                    else "-",
                    marker="." if len(steps) < 20 else "",
                    linewidth=1.2,
                    label=point.name.removeprefix(f"{algorithm}-"),
                )
            axes.set_title(f"{_NAMES[algorithm]}: {title}", fontsize=9)
            axes.set_xlabel("updates", fontsize=8)
            axes.tick_params(labelsize=7)
            axes.grid(visible=True, alpha=0.3)
            if across == 0:
                axes.legend(fontsize=6)
    figure.savefig(path, dpi=120)
    return True


def read_curve(path: Path) -> dict[str, tuple[list[int], list[float]]]:
    """Steps and values of each column of a run's `evaluation.csv`; {} without one."""
    found: dict[str, tuple[list[int], list[float]]] = {}
    if not path.exists():
        return found
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            for name, cell in row.items():
                if name and cell and name != "updates":
                    steps, values = found.setdefault(name, ([], []))
                    steps.append(int(row["updates"]))
                    values.append(float(cell))
    return found
