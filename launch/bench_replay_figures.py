"""The figures of `slipstream bench replay`, each as PNG and SVG."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from launch.bench_figures import encoded
from launch.bench_replay_sections import medians

Row = Mapping[str, Any]
SOAKED: Final = {"service": "#d55e00", "writer": "#0072b2", "reader": "#009e73"}
COLOURS: Final = {"slipstream": "#0072b2", "torchrl": "#009e73", "reverb": "#d55e00"}


def figures(report: Mapping[str, Any]) -> dict[str, bytes]:
    """File names and contents of all that the report has figures of."""
    drawn: dict[str, Figure] = {}
    sections = report["sections"]
    if "throughput" in sections:
        drawn["replay_throughput"] = throughput_figure(sections["throughput"])
    if "scale" in sections:
        drawn["replay_scale"] = scale_figure(sections["scale"])
    if "soak" in sections:
        drawn["replay_soak"] = soak_figure(sections["soak"])
    return {
        f"{name}.{kind}": encoded(figure, kind)
        for name, figure in drawn.items()
        for kind in ("png", "svg")
    }


def _blank(title: str) -> Figure:
    # Figure and canvas by hand: pyplot keeps global state and looks for a display.
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=11)
    return figure


def throughput_figure(rows: Sequence[Row]) -> Figure:
    """Samples/s, each repetition a dot, and CPU time per sample by process."""
    figure = _blank(
        "8 KB rows, 8 samples per insert; in brackets: batches of 64 in a reply"
    )
    rates, costs = figure.subplots(1, 2, sharey=True)
    found = medians(rows)
    for place, row in enumerate(found):
        colour = COLOURS[row["contestant"]]
        rates.barh(place, row["samples_per_s"], color=colour, alpha=0.8)
        each = [
            other["samples_per_s"]
            for other in rows
            if other["contestant"] == row["contestant"]
            and other["shared_memory"] == row["shared_memory"]
            and other["batches_per_reply"] == row["batches_per_reply"]
        ]
        rates.plot(each, [place] * len(each), "k.", markersize=5)
        start = 0.0
        for kind, alpha in (("service", 0.9), ("writers", 0.6), ("reader", 0.35)):
            width = row["cpu_us_per_sample_by"][kind]
            label = kind if place == 0 else None
            costs.barh(place, width, left=start, color=colour, alpha=alpha, label=label)
            start += width
    labels = [
        f"{row['contestant']}\n{'shared memory' if row['shared_memory'] else 'TCP'}"
        f" ({row['batches_per_reply']})"
        for row in found
    ]
    rates.set_yticks(range(len(found)), labels)
    rates.invert_yaxis()
    rates.set_xlabel("samples/s (bar: median, dots: repetitions)")
    rates.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    rates.tick_params(axis="x", labelrotation=20)
    costs.set_xlabel("CPU time per sample, all processes [us]")
    figure.legend(loc="outside lower right", ncols=3, fontsize=8)
    for axes in (rates, costs):
        axes.grid(visible=True, axis="x", alpha=0.35)
    return figure


def scale_figure(rows: Sequence[Row]) -> Figure:
    """Samples/s and CPU time per sample against writers, a line per shard count."""
    figure = _blank("Shards and writers, rows of 128 bytes, by shared memory")
    found = [row for row in rows if row["what"] == "scale"]
    panels = figure.subplots(1, 2)
    for axes, what, label in (
        (panels[0], "samples_per_s", "samples/s"),
        (panels[1], "cpu_us_per_sample", "CPU time per sample [us]"),
    ):
        for shards in sorted({row["shards"] for row in found}):
            line = [row for row in found if row["shards"] == shards]
            x = [row["writers"] for row in line]
            y = [row[what] for row in line]
            axes.plot(x, y, "o-", label=f"{shards} shard{'s' if shards > 1 else ''}")
        axes.set_xscale("log", base=2)
        axes.set_ylim(bottom=0, top=1.05 * axes.get_ylim()[1])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        axes.set_xlabel("writers")
        axes.set_ylabel(label)
        axes.grid(visible=True, alpha=0.35)
    panels[0].legend(fontsize=8)
    return figure


def soak_figure(rows: Sequence[Row]) -> Figure:
    """Memory of the processes and samples per insert over the time; kills as lines."""
    figure = _blank(
        "Soak: service red, writers blue, readers green; lines: kill -9 of the service "
        "(red) and of clients (grey)"
    )
    found = [row for row in rows if row["what"] == "look"]
    memory, ratio = figure.subplots(2, 1, sharex=True)
    lives = dict.fromkeys(life for row in found for life in row["processes"])
    for life in lives:
        seen = [row for row in found if life in row["processes"]]
        memory.plot(
            [row["seconds"] for row in seen],
            [row["processes"][life]["own"] / 2**20 for row in seen],
            color=SOAKED[life.split()[0].rstrip(",")],
            linewidth=1.0,
        )
    told = [row for row in found if row.get("inserts", 0) > 0]
    inserts = np.array([row["inserts"] for row in told], float)
    samples = np.array([row["samples"] for row in told], float)
    ratio.plot(
        [row["seconds"] for row in told][1:],
        np.diff(samples) / np.maximum(np.diff(inserts), 1.0),
        "k.",
        markersize=3,
    )
    for one, other in itertools.pairwise(found):
        for role, count in other["kills"].items():
            if count > one["kills"][role]:
                colour = "#d55e00" if role == "service" else "0.8"
                for axes in (memory, ratio):
                    axes.axvline(other["seconds"], color=colour, zorder=0, lw=0.8)
    memory.set_ylim(bottom=0)
    memory.set_ylabel("own memory [MiB]")
    ratio.set_ylabel("samples per insert\nbetween looks")
    ratio.set_xlabel("time [s]")
    return figure
