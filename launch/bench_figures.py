"""The figures of `slipstream bench sim`, each as PNG and SVG.

Figures 4 and 5 are the paper's (Gulino et al., 2023, appendix A.3): Reset + Transition
+ Metrics, and memory, against the number of objects. What was measured in the run is
drawn solid; the paper's numbers, from another machine, dashed and hollow.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from launch.bench_print import TITLES

Row = Mapping[str, Any]
PAPER_MACHINES: Final = {"cpu": "EPYC 7B12", "gpu": "V100"}
COLOURS: Final = {
    ("cpu", 1): "#0072b2",
    ("cpu", 16): "#d55e00",
    ("gpu", 1): "#009e73",
    ("gpu", 16): "#cc79a7",
}
OURS: Final = {"linestyle": "-", "marker": "o", "linewidth": 2.0}
PAPERS: Final = {
    "linestyle": "--",
    "marker": "s",
    "markerfacecolor": "white",
    "linewidth": 1.2,
}


def figures(report: Mapping[str, Any]) -> dict[str, bytes]:
    """File names and contents of all that the report has figures of."""
    drawn: dict[str, Figure] = {}
    sections = report["sections"]
    if "table6" in sections:
        drawn["figure4"] = figure4(sections["table6"])
        drawn["figure5"] = figure5(sections["table6"])
    return {
        f"{name}.{kind}": _bytes(figure, kind)
        for name, figure in drawn.items()
        for kind in ("png", "svg")
    }


def _bytes(figure: Figure, kind: str) -> bytes:
    stream = io.BytesIO()
    # No date: the same figures give the same file.
    extra = {"metadata": {"Date": None}} if kind == "svg" else {"dpi": 150}
    figure.savefig(stream, format=kind, **extra)
    return stream.getvalue()


def blank(title: str, x: str, y: str) -> tuple[Figure, Axes]:
    """A figure with logarithmic axes."""
    # Figure and canvas by hand: pyplot keeps global state and looks for a display.
    figure = Figure(figsize=(6.6, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.grid(visible=True, which="major", alpha=0.35)
    axes.grid(visible=True, which="minor", alpha=0.12)
    return figure, axes


def ticks(axes: Axes, values: Sequence[int]) -> None:
    """Marks what was measured along x, in plain numbers on both axes."""
    axes.set_xticks(sorted(set(values)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def legend(axes: Axes) -> None:
    """Below the axes, which the lines fill."""
    axes.figure.legend(loc="outside lower center", ncols=2, fontsize=8, frameon=False)


def _groups(rows: Sequence[Row]) -> dict[tuple[str, int], list[Row]]:
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["device"], row["batch"]), []).append(row)
    return groups


def _line(
    axes: Axes,
    rows: Sequence[Row],
    values: Sequence[float | None],
    label: str,
    style: Mapping[str, Any],
) -> None:
    known = [(r["slots"], v) for r, v in zip(rows, values, strict=True) if v]
    key = (rows[0]["device"], rows[0]["batch"])
    if known:
        x, y = zip(*known, strict=True)
        axes.plot(x, y, label=label, color=COLOURS.get(key, "#555555"), **style)


def figure4(rows: Sequence[Row]) -> Figure:
    """Reset + Transition + Metrics against the number of objects."""
    figure, axes = blank(
        "Reset + Transition + Metrics (figure 4)", "object slots", "time [ms]"
    )
    for (device, batch), group in _groups(rows).items():
        ours = [
            sum(row["programs"][name]["median_ms"] for name in TITLES) for row in group
        ]
        papers = [
            sum(row["paper"][name] for name in TITLES) if row["paper"] else None
            for row in group
        ]
        _line(axes, group, ours, f"Slipstream, {device}, batch {batch}", OURS)
        _line(
            axes,
            group,
            papers,
            f"paper ({PAPER_MACHINES[device]}), batch {batch}",
            PAPERS,
        )
    ticks(axes, [row["slots"] for row in rows])
    legend(axes)
    return figure


def figure5(rows: Sequence[Row]) -> Figure:
    """Peak memory against the number of objects."""
    figure, axes = blank(
        "Peak memory of the largest program (figure 5)", "object slots", "memory [MB]"
    )
    for (device, batch), group in _groups(rows).items():
        ours = [row["peak_memory_bytes"] / 1e6 for row in group]
        papers = [(row["paper"] or {}).get("memory") for row in group]
        _line(axes, group, ours, f"Slipstream, {device}, batch {batch}", OURS)
        _line(
            axes,
            group,
            papers,
            f"paper ({PAPER_MACHINES[device]}), batch {batch}",
            PAPERS,
        )
    ticks(axes, [row["slots"] for row in rows])
    legend(axes)
    return figure
