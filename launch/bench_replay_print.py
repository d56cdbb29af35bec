"""The tables that `slipstream bench replay` prints."""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rich.table import Table

from launch.bench_replay_sections import medians, ratios

Row = Mapping[str, Any]
WANTED: Final = {("reverb", False): 5.0, ("reverb", True): 8.0}
WANTED_TORCHRL: Final = {("torchrl", False): 2.5, ("torchrl", True): 4.0}
KINDS: Final = ("service", "writers", "reader")


def tables(rows: Sequence[Row]) -> Iterator[Table]:
    """All of a section."""
    yield _rates("8 KB rows, 8 samples per insert, batches of 64", rows)
    yield _ratios(rows)


def _table(title: str, *columns: str, caption: str = "") -> Table:
    table = Table(title=title, caption=caption or None, caption_justify="left")
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left")
    return table


def _link(row: Row) -> str:
    return "shared memory" if row["shared_memory"] else "TCP"


def _rates(title: str, rows: Sequence[Row]) -> Table:
    columns = ("contestant", "link", "samples/s", "inserts/s", "CPU us/sample", *KINDS)
    table = _table(
        f"{title}: medians", *columns, caption="CPU time of all processes per sample"
    )
    for row in medians(rows):
        table.add_row(
            row["contestant"],
            _link(row),
            f"{row['samples_per_s']:,.0f}",
            f"{row['inserts_per_s']:,.0f}",
            f"{row['cpu_us_per_sample']:.1f}",
            *(f"{row['cpu_us_per_sample_by'][kind]:.1f}" for kind in KINDS),
        )
    return table


def _ratios(rows: Sequence[Row]) -> Table:
    table = _table(
        "Our samples/s over a peer's, repetition by repetition",
        "peer",
        "our link",
        "median",
        "least",
        "wanted",
    )
    for (peer, shared), wanted in {**WANTED, **WANTED_TORCHRL}.items():
        found = ratios(rows, shared, peer)
        if found:
            table.add_row(
                f"{peer}, TCP",
                "shared memory" if shared else "TCP",
                f"{statistics.median(found):.2f}",
                f"{min(found):.2f}",
                f"{wanted:g}",
            )
    return table
