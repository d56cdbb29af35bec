"""The tables that `slipstream bench sim` prints."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from rich.markup import escape
from rich.table import Table

from launch.bench_paper import SOURCE, WAYMAX

Row = Mapping[str, Any]
TITLES: Final = {"reset": "Reset", "transition": "Transition", "metrics": "Metrics"}


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


def steps_table(rows: Sequence[Row]) -> Table:
    """Whole environment steps."""
    table = _table(
        "Whole environment steps on one core: dynamics, reward, ends, auto-reset, "
        "observation",
        (
            *("controlled", "objects", "agent-steps/s", "at best", "us", "recorded"),
            *("state [B]", "temporary [KB]"),
        ),
        "Controlled objects x environments. State is what an environment holds from "
        "step to step, temporary what the program needs meanwhile, each per "
        "environment and without the bank.",
    )
    for row in rows:
        table.add_row(
            f"{row['controlled']} x {row['environments']}",
            str(row["slots"]),
            f"{row['agent_steps_per_s']:,.0f}",
            f"{row['best_agent_steps_per_s']:,.0f}",
            f"{row['us_per_agent_step']:.2f}",
            f"{row['recorded_share']:.0%}",
            f"{row['state_bytes_per_environment']:,}",
            f"{row['temporary_bytes_per_environment'] / 1e3:,.0f}",
        )
    return table


def scale_table(rows: Sequence[Row]) -> Table:
    """Cost against the number of environments, then of objects."""
    table = _table(
        "Cost against scale, whole steps on one core",
        ["environments", "objects", "controlled", "us per agent-step", "ms per call"],
        "Objects beyond those recorded, in brackets, are copies of them.",
    )
    for row in rows:
        objects = row.get("objects", row["slots"])
        table.add_row(
            f"{row['environments']:,}",
            _slots({"slots": row["slots"], "objects": objects}),
            str(row["controlled"]),
            number(row["us_per_agent_step"]),
            number(row["median_ms"]),
        )
    return table


def banks_table(rows: Sequence[Row]) -> Table:
    """Cost against the number of scenes."""
    table = _table(
        "Banks of procedural scenes, one core, the file in the page cache",
        (
            *("scenes", "file [MB]", "open [ms]", "load [ms]", "first reset [ms]"),
            *("reset [us]", "step [us]", "memory [MB]"),
        ),
        "A reset and an agent's step (1 controlled) are of random scenes, 512 at a "
        "time. Memory is by how much opening and loading grew the process.",
    )
    for row in rows:
        table.add_row(
            f"{row['scenes']:,}",
            f"{row['file_bytes'] / 1e6:,.1f}",
            *(number(row[name]) for name in ("open_ms", "load_ms", "first_reset_ms")),
            number(row["random_reset_us"]),
            number(row["us_per_agent_step"]),
            f"{row['loaded_bytes'] / 1e6:.1f}",
        )
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
    if name == "oracle":
        return [oracle_table(rows), agreement_table(rows), elsewhere_table()]
    return [
        {
            "table6": table6_table,
            "steps": steps_table,
            "scale": scale_table,
            "banks": banks_table,
            "bicycle": bicycle_table,
        }[name](rows)
    ]
