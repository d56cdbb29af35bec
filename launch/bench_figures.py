"""The figures of `slipstream bench sim`, each as PNG and SVG.

Figures 4 and 5 are the paper's (Gulino et al., 2023, appendix A.3): Reset + Transition
+ Metrics, and memory, against the number of objects. What was measured in the run is
drawn solid; the paper's numbers, from another machine, dashed and hollow.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any, Final

from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from launch.bench_paper import WAYMAX
from launch.bench_print import TITLES
from launch.bench_table6 import YARDSTICK
from launch.bench_targets import LABELS

Row = Mapping[str, Any]
PAPER_MACHINES: Final = {"cpu": "EPYC 7B12", "gpu": "V100"}
COLOURS: Final = {
    ("cpu", 1): "#0072b2",
    ("cpu", 16): "#d55e00",
    ("gpu", 1): "#009e73",
    ("gpu", 16): "#cc79a7",
}
OURS: Final[dict[str, Any]] = {"linestyle": "-", "marker": "o", "linewidth": 2.0}
PAPERS: Final[dict[str, Any]] = {
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
    if "oracle" in sections:
        drawn["oracle"] = oracle_figure(sections["oracle"])
    if "scale" in sections:
        drawn["scale"] = scale_figure(sections["scale"])
    if "banks" in sections:
        drawn["banks"] = banks_figure(sections["banks"])
    return {
        f"{name}.{kind}": encoded(figure, kind)
        for name, figure in drawn.items()
        for kind in ("png", "svg")
    }


def encoded(figure: Figure, kind: str) -> bytes:
    """The picture as a file of this kind."""
    stream = io.BytesIO()
    extra: dict[str, Any] = {"dpi": 150}
    if kind == "svg":  # the same figures give the same file
        extra = {"metadata": {"Date": None}}
    with rc_context({"svg.hashsalt": "slipstream"}):
        figure.savefig(stream, format=kind, **extra)
    return stream.getvalue()


def blank(title: str, x: str, y: str, *, across: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure of one or more logarithmic axes side by side."""
    # Figure and canvas by hand: pyplot keeps global state and looks for a display.
    figure = Figure(figsize=(2.2 + 4.4 * across, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    found = [figure.add_subplot(1, across, 1 + index) for index in range(across)]
    for axes in found:
        axes.set_xlabel(x)
        axes.set_ylabel(y)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.grid(visible=True, which="major", alpha=0.35)
        axes.grid(visible=True, which="minor", alpha=0.12)
    return figure, found


def ticks(axes: Axes, values: Sequence[int]) -> None:
    """Marks what was measured along x, in plain numbers on both axes."""
    axes.set_xticks(sorted(set(values)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axes.xaxis.set_minor_locator(NullLocator())
    low, high = axes.get_ylim()
    parts = (1.0, 2.0, 5.0) if high < 30 * low else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=parts))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def legend(figure: Figure, columns: int = 2) -> None:
    """Below the axes, which the lines fill; each label once."""
    entries: dict[str, Artist] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=columns,
        fontsize=8,
        frameon=False,
    )


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
    figure, (axes,) = blank(
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
    legend(figure)
    return figure


def figure5(rows: Sequence[Row]) -> Figure:
    """Peak memory against the number of objects."""
    figure, (axes,) = blank(
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
    legend(figure)
    return figure


def oracle_figure(rows: Sequence[Row]) -> Figure:
    """Metrics and RolloutExpert against the brute-force oracle's, batch 1."""
    figure, panels = blank(
        "The simulator and the brute-force oracle, batch 1",
        "object slots",
        "time [ms]",
        across=2,
    )
    slots = [row["slots"] for row in rows]
    for axes, program in zip(panels, ("metrics", "rollout"), strict=True):
        axes.set_title(LABELS[program], fontsize=10)
        found = [row["oracle"][YARDSTICK][program] for row in rows]
        for side, label, colour in (
            ("oracle", "oracle: all corners against all points", "#d55e00"),
            ("ours", "Slipstream", "#0072b2"),
        ):
            times = [row[side]["median_ms"] for row in found]
            axes.plot(slots, times, label=label, color=colour, **OURS)
        known = [(n, WAYMAX[n][program == "rollout"]) for n in slots if n in WAYMAX]
        if known:
            x, y = zip(*known, strict=True)
            label = "Waymax, as reported from a 2-core machine"
            axes.plot(x, y, label=label, color="#555555", **PAPERS)
        ticks(axes, slots)
    legend(figure, columns=3)
    return figure


def scale_figure(rows: Sequence[Row]) -> Figure:
    """Time per agent-step against the number of environments and of objects."""
    figure, panels = blank(
        "Whole environment steps on one core",
        "",
        "time per agent-step [us]",
        across=2,
    )
    for axes, axis, label in (
        (panels[0], "environments", "environments, 1 controlled object each"),
        (panels[1], "slots", "objects, all controlled, 16 environments"),
    ):
        wanted = "environments" if axis == "environments" else "objects"
        chosen = [row for row in rows if row["axis"] == wanted]
        x = [row[axis] for row in chosen]
        for name, text, style in (
            ("median_ms", "median", OURS),
            ("least_ms", "least, undisturbed", {**PAPERS, "marker": "."}),
        ):
            agents = [row["controlled"] * row["environments"] for row in chosen]
            y = [row[name] * 1e3 / n for row, n in zip(chosen, agents, strict=True)]
            axes.plot(x, y, label=text, color="#0072b2", **style)
        axes.set_xlabel(label)
        ticks(axes, x)
    legend(figure)
    return figure


def banks_figure(rows: Sequence[Row]) -> Figure:
    """What the number of scenes costs: times and bytes."""
    figure, (times, sizes) = blank("Banks", "procedural scenes", "", across=2)
    scenes = [row["scenes"] for row in rows]
    for name, label, unit, colour in (
        ("open_ms", "open", 1e-3, "#0072b2"),
        ("load_ms", "hand to JAX", 1e-3, "#009e73"),
        ("first_reset_ms", "first reset", 1e-3, "#d55e00"),
        ("random_reset_us", "reset of a random scene, of 512", 1e-6, "#cc79a7"),
    ):
        seconds = [row[name] * unit * 1e3 for row in rows]
        times.plot(scenes, seconds, label=label, color=colour, **OURS)
    for name, label, colour, style in (
        ("file_bytes", "the file", "#555555", PAPERS),
        ("loaded_bytes", "process, by opening and loading", "#0072b2", OURS),
    ):
        # A logarithmic axis has no 0: below 0.01 MB is drawn there.
        megabytes = [max(row[name] / 1e6, 0.01) for row in rows]
        sizes.plot(scenes, megabytes, label=label, color=colour, **style)
    times.set_ylabel("time [ms]")
    sizes.set_ylabel("memory [MB]")
    for axes in (times, sizes):
        ticks(axes, scenes)
    legend(figure, columns=3)
    return figure
