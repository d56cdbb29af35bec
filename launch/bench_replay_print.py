"""The tables that `slipstream bench replay` prints."""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rich.table import Table

from launch.bench_replay_sections import medians, ratios
from launch.bench_soak_verdict import MOST_BYTES, MOST_RATIO_ERROR, WINDOW

Row = Mapping[str, Any]
# Peer, ours by shared memory, the peer by shared memory: how many times.
WANTED: Final = {
    ("reverb", False, False): 5.0,
    ("reverb", True, False): 8.0,
    ("torchrl", False, False): 2.5,
    ("torchrl", True, False): 4.0,
    ("torchrl", True, True): 4.0,
}
WANTED_ROWS: Final = {("reverb", False, False): 15.0, ("reverb", True, False): 15.0}
KINDS: Final = ("service", "writers", "reader")


def tables(section: str, rows: Sequence[Row]) -> Iterator[Table]:
    """All of a section."""
    if section == "throughput":
        yield _rates("8 KB rows, 8 samples per insert, batches of 64", rows)
        yield _ratios(rows, WANTED)
    elif section == "memory":
        yield _memory(rows)
    elif section == "soak":
        yield _soak(next(row for row in rows if row["what"] == "verdict"))
    elif section == "scale":
        yield _scale([row for row in rows if row["what"] == "scale"])
        yield _model(next(row for row in rows if row["what"] == "model"))
    else:
        sampled = [row for row in rows if row["what"] == "sampled"]
        yield _rates("Rows of 128 bytes, a peer's of 8 KB", sampled)
        if any(row["contestant"] == "reverb" for row in sampled):
            yield _ratios(sampled, WANTED_ROWS)
        yield _rendering(rows)


def _table(title: str, *columns: str, caption: str = "") -> Table:
    table = Table(title=title, caption=caption or None, caption_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left")
    return table


def _link(shared_memory: bool) -> str:
    return "shared memory" if shared_memory else "TCP"


def _rates(title: str, rows: Sequence[Row]) -> Table:
    columns = (
        "contestant",
        "link",
        "batches",
        "samples/s",
        "inserts/s",
        "CPU us/sample",
        *KINDS,
    )
    table = _table(
        f"{title}: medians", *columns, caption="Batches in a reply; CPU time of all"
    )
    for row in medians(rows):
        table.add_row(
            row["contestant"],
            _link(row["shared_memory"]),
            str(row["batches_per_reply"]),
            f"{row['samples_per_s']:,.0f}",
            f"{row['inserts_per_s']:,.0f}",
            f"{row['cpu_us_per_sample']:.1f}",
            *(f"{row['cpu_us_per_sample_by'][kind]:.1f}" for kind in KINDS),
        )
    return table


def _ratios(
    rows: Sequence[Row], targets: Mapping[tuple[str, bool, bool], float]
) -> Table:
    table = _table(
        "Our samples/s over a peer's, repetition by repetition",
        "peer",
        "our link",
        "median",
        "least",
        "wanted",
    )
    for (peer, ours, theirs), wanted in targets.items():
        found = ratios(rows, ours, peer, theirs)
        if found:
            table.add_row(
                f"{peer}, {_link(theirs)}",
                _link(ours),
                f"{statistics.median(found):.2f}",
                f"{min(found):.2f}",
                f"{wanted:g}",
            )
    return table


def _rendering(rows: Sequence[Row]) -> Table:
    table = _table(
        "Observations rendered on one core",
        "what",
        "observations/s",
        "CPU us/observation",
        "wanted/s",
        caption="Medians; CPU time of the process that renders",
    )
    for what in ("rendered", "sampled and rendered"):
        same = [row for row in rows if row["what"] == what]
        cost = [row.get("cpu_us_per_observation") or _reader_us(row) for row in same]
        rates = statistics.median(row["observations_per_s"] for row in same)
        table.add_row(
            what, f"{rates:,.0f}", f"{statistics.median(cost):.1f}", "100,000"
        )
    return table


def _reader_us(row: Row) -> float:
    return float(row["cpu_us_per_sample_by"]["reader"]) / 2


def _memory(rows: Sequence[Row]) -> Table:
    table = _table(
        "Memory of the service's process per row", "contestant", "row", "grown", "times"
    )
    for row in rows:
        if row["what"] == "process":
            table.add_row(
                f"{row['contestant']}{', durable' if row['durable'] else ''}",
                f"{row['row_bytes']:,} B",
                f"{row['bytes_per_row']:,.0f} B",
                f"{row['over_own_bytes']:.3f}",
            )
        else:
            table.caption = (
                f"A transition in messages of 64: insert {row['insert']:.0f} B, "
                f"sample {row['sample_reply']:.0f} B, its request "
                f"{row['sample_request']:.0f} B"
            )
    return table


def _scale(rows: Sequence[Row]) -> Table:
    table = _table(
        "Shards and writers, rows of 128 bytes",
        "shards",
        "writers",
        "samples/s",
        "inserts/s",
        "CPU us/sample",
    )
    for row in rows:
        table.add_row(
            str(row["shards"]),
            str(row["writers"]),
            f"{row['samples_per_s']:,.0f}",
            f"{row['inserts_per_s']:,.0f}",
            f"{row['cpu_us_per_sample']:.1f}",
        )
    return table


def _model(row: Row) -> Table:
    run, error = row["run"], row["relative_error_checked"]
    table = _table(
        f"{run['actors']:,} actors, {run['samples_per_s']:,.0f} samples/s: needed",
        "what",
        "how much",
        caption=f"The model is off by {error['all']:.0%} (median) and at most "
        f"{error['all_largest']:.0%} at points that it was not fitted to",
    )
    for kind, cores in row["cores"].items():
        table.add_row(f"cores, {kind}", f"{cores:.2f}")
    table.add_row("shards", str(row["shards"]))
    for link, rate in row["bytes_per_s"].items():
        table.add_row(link.replace("_", " "), f"{rate / 1e6:,.1f} MB/s")
    return table


def _soak(row: Row) -> Table:
    kills = ", ".join(f"{count} of the {role}s" for role, count in row["kills"].items())
    table = _table(
        f"Soak: {'held' if row['held'] else 'did not hold'}",
        "what",
        "found",
        "allowed",
        caption="\n".join(row["faults"]),
    )
    for name, memory in row["memory"].items():
        grown = memory["growth_bytes_in_600_s"] / 2**20
        error = memory["error_bytes_in_600_s"] / 2**20
        table.add_row(
            f"growth of the {name}, which takes {memory['bytes'] / 2**20:.0f} MiB",
            f"{grown:.2f} +- {error:.2f} MiB in 600 s",
            f"{MOST_BYTES / 2**20:g}",
        )
    if row["leak_found_bytes_per_query"] is not None:
        lost = f"{row['leak_found_bytes_per_query']:.0f} B"
        table.add_row("a leak per query that would be a fault", lost, "")
    if row["worst_ratio_error"] is not None:
        table.add_row(
            f"error of the ratio over {WINDOW:,} inserts",
            f"{row['worst_ratio_error']:.2%}",
            f"{MOST_RATIO_ERROR:.0%}",
        )
    owed = f"{row['most_owed_in_tolerances']:.2f} tolerances"
    table.add_row("samples owed, either way", owed, "1")
    table.add_row("rows inserted", f"{row['inserts']:,}", "")
    table.add_row("rows sampled", f"{row['samples']:,}", "")
    for way, answers in row["answers"].items():
        table.add_row(f"answers by {way}", f"{answers:,}", "")
    table.add_row("kill -9", kills, "")
    return table
