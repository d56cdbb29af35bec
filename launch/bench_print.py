"""The tables that `slipstream bench sim` prints, and the targets it is held to."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from rich.markup import escape
from rich.table import Table

from launch.bench_paper import SOURCE, WAYMAX
from launch.bench_table6 import YARDSTICK

Row = Mapping[str, Any]
TITLES: Final = {"reset": "Reset", "transition": "Transition", "metrics": "Metrics"}
RATIOS: Final = (("metrics", "Metrics", 150), ("rollout", "RolloutExpert", 200))


def _table(title: str, columns: Sequence[str], caption: str = "") -> Table:
    # Escaped, for `[m]` would be taken for a style.
    table = Table(title=escape(title), caption=caption or None, caption_justify="left")
    for index, column in enumerate(columns):
        table.add_column(escape(column), justify="left" if index == 0 else "right")
    return table


def number(value: float | None, digits: int = 3) -> str:
    """Three significant digits; a dash for none."""
    if value is None:
        return "-"
    if abs(value) >= 10 ** (digits - 1):
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


def yardsticks_table(report: Row) -> Table:
    """The machine."""
    found = report["yardsticks"]
    table = Table(title="Yardsticks of the machine", show_header=False)
    load = ", ".join(f"{value:.2f}" for value in report["load_average"])
    rows = {
        "processor": f"{found['processor']}, {found['cores']} cores",
        "load average at the start": load,
        "matrix product, one core": f"{found['matrix_product_gflops']:.1f} GFLOP/s",
        "memory copy, one thread": f"{found['memory_copy_gb_s']:.1f} GB/s",
        "JAX": f"{found['jax']} on {', '.join(found['devices'])}",
    }
    for name, value in rows.items():
        table.add_row(name, value)
    return table


def table6_table(rows: Sequence[Row]) -> Table:
    """Table 6: each cell ours, then the paper's."""
    table = _table(
        "Table 6: median ms, and peak memory in MB; in brackets the paper's",
        ["device", "batch", "objects", *TITLES.values(), "RolloutExpert", "memory"],
        f"Paper: {SOURCE}, on another machine (EPYC 7B12; V100). `objects` are slots; "
        "(n) holds n recorded ones. Memory is that of the largest program, its "
        "arguments (the scene's tables) included.",
    )
    for row in rows:
        paper = row["paper"] or {}
        programs = row["programs"]
        cells = [
            f"{number(programs[name]['median_ms'])} ({number(paper.get(name))})"
            if name in programs
            else "-"
            for name in (*TITLES, "rollout")
        ]
        memory = f"{row['peak_memory_bytes'] / 1e6:.2f} ({number(paper.get('memory'))})"
        table.add_row(row["device"], str(row["batch"]), _slots(row), *cells, memory)
    return table


def _slots(row: Row) -> str:
    slots, objects = row["slots"], row["objects"]
    return str(slots) if slots == objects else f"{slots} ({objects})"


def oracle_table(rows: Sequence[Row]) -> Table:
    """Ours beside the oracle's variants."""
    table = _table(
        "The brute-force oracle in JAX: median ms, oracle / ours, batch 1, one device",
        ["objects", "searched", "Metrics", "ratio", "RolloutExpert", "ratio"],
        "Searched are, for each corner, `all points` of the map (other than edges at "
        "infinite distance), kept as columns or rows, or the edges' points alone.",
    )
    for row in rows:
        for name, oracle in row["oracle"].items():
            cells = []
            for program in ("metrics", "rollout"):
                found = oracle[program]
                theirs, ours = found["oracle"]["median_ms"], found["ours"]["median_ms"]
                cells.append(f"{number(theirs)} / {number(ours)}")
                cells.append(f"{found['ratio']:.0f}")
            table.add_row(_slots(row), f"{name} ({oracle['points']:,})", *cells)
    return table


def agreement_table(rows: Sequence[Row]) -> Table:
    """Where ours and the oracle judge alike."""
    names = ("overlap", "offroad", "kinematic_infeasibility")
    table = _table(
        "Share of recorded (object, step) pairs of RolloutExpert judged alike",
        ["objects", "pairs", "overlap", "off-road", "infeasible", "divergence apart"],
    )
    for row in rows:
        agreed = row["agreement"]
        apart = agreed["log_divergence_largest_difference_m"]
        table.add_row(
            _slots(row),
            f"{agreed['pairs']:,}",
            *(f"{agreed[name]:.4%}" for name in names),
            f"{apart:.1e} m",
        )
    return table


def elsewhere_table() -> Table:
    """Waymax's own timings, for orientation."""
    table = _table(
        "For orientation, not of this run: Waymax as reported from a 2-core machine",
        ["objects", "Metrics [ms]", "RolloutExpert [ms]"],
    )
    for objects, (judged, rolled) in WAYMAX.items():
        table.add_row(str(objects), number(judged), f"{rolled:,.0f}")
    return table


def bicycle_table(rows: Sequence[Row]) -> Table:
    """One-step position errors."""
    table = _table(
        "One-step position error of moving vehicles [m]: inverse, then forward",
        ["scene", "pairs", "Bicycle mean", "median", "99th pct.", "Delta mean"],
    )
    for row in rows:
        found = row["bicycle"]
        table.add_row(
            row["scene"],
            f"{row['pairs']:,}",
            *(f"{found[name]:.4f}" for name in ("mean_m", "median_m", "p99_m")),
            f"{row['delta']['mean_m']:.1e}",
        )
    return table


def targets(sections: Mapping[str, Sequence[Row]]) -> list[dict[str, Any]]:
    """What the simulator is to reach, of what was measured."""
    found: list[dict[str, Any]] = []

    def add(name: str, wanted: float, measured: float, *, least: bool) -> None:
        met = measured >= wanted if least else measured <= wanted
        found.append(
            {
                "target": name,
                "at least" if least else "at most": wanted,
                "measured": measured,
                "met": bool(met),
            }
        )

    for row in sections.get("oracle", ()):
        if row["slots"] == 128:
            for program, label, wanted in RATIOS:
                ratio = row["oracle"][YARDSTICK][program]["ratio"]
                add(f"{label}, 128: oracle / ours", wanted, ratio, least=True)
    for row in sections.get("table6", ()):
        if row["device"] == "cpu" and row["batch"] == 1:
            for name, limit in _limits(row["slots"]).items():
                label = {**TITLES, "rollout": "RolloutExpert"}[name]
                value = row["programs"][name]["median_ms"]
                add(f"{label}, {row['slots']} [ms]", limit, value, least=False)
    return found


def _limits(slots: int) -> dict[str, float]:
    """Milliseconds at batch 1 on the quiet test machine."""
    limits = {"reset": 0.1, "transition": 0.1}
    if slots == 8:
        return {**limits, "metrics": 0.1, "rollout": 5.0}
    if slots == 128:
        return {**limits, "metrics": 0.8, "rollout": 60.0}
    return limits


def targets_table(rows: Sequence[Row]) -> Table:
    """Met or missed."""
    table = _table(
        "Targets (times are those of a quiet 2-core machine)",
        ["target", "wanted", "measured", ""],
    )
    for row in rows:
        wanted = (
            f">= {row['at least']:,g}"
            if "at least" in row
            else f"<= {row['at most']:,g}"
        )
        met = "met" if row["met"] else "missed"
        table.add_row(escape(row["target"]), wanted, number(row["measured"], 4), met)
    return table


def section_tables(name: str, rows: Sequence[Row]) -> list[Table]:
    """A section's tables."""
    if name == "table6":
        return [table6_table(rows)]
    if name == "oracle":
        return [oracle_table(rows), agreement_table(rows), elsewhere_table()]
    return [bicycle_table(rows)]
