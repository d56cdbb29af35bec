"""The figures of `slipstream bench replay`, each as PNG and SVG."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from launch.bench_figures import encoded
from launch.bench_replay_sections import medians

Row = Mapping[str, Any]
COLOURS: Final = {"slipstream": "#0072b2", "torchrl": "#009e73", "reverb": "#d55e00"}


def figures(report: Mapping[str, Any]) -> dict[str, bytes]:
    """File names and contents of all that the report has figures of."""
    drawn: dict[str, Figure] = {}
    sections = report["sections"]
    if "throughput" in sections:
        drawn["replay_throughput"] = throughput_figure(sections["throughput"])
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
