"""`slipstream replay stats`: how a run's replay fares, once or as it goes."""

import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

from launch.config import write_atomically
from launch.errors import LaunchError
from replay.control import PERCENTILES
from replay.keys import RunKeys
from replay.session import check_endpoints, open_session
from replay.shards_tools import fetch_all_stats, total

ENDPOINT: Final = "endpoint.json"  # of a run in progress, see `launch.view`
_WATCH_S: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class StatsConfig:
    """Size, rates, waits, ages, priorities, writers and memory of a run's replay."""

    run: Path | None = None
    """The folder of a run in progress on this machine; it knows the rest."""
    run_id: str = ""
    """The run's name in its Zenoh keys, where its folder is elsewhere."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, e.g. tcp/127.0.0.1:7447."""
    insecure: bool = False
    """Allows addresses other than loopback; nothing is encrypted."""
    json: str = ""
    """Writes the figures to this file, or to standard output by -."""
    watch: bool = False
    """Goes on, once a second, until Ctrl-C."""


def place_of(
    run: Path | None, run_id: str, connect: tuple[str, ...]
) -> tuple[str, tuple[str, ...]]:
    """The run's id and endpoints, as given or as its folder says."""
    if run is None:
        if not (run_id and connect):
            raise LaunchError(
                "name the run: --run FOLDER of a run in progress, or --run-id ID and "
                "--connect tcp/HOST:PORT"
            )
        return run_id, connect
    try:
        content = json.loads((run / ENDPOINT).read_bytes())
        return str(content["run_id"]), connect or tuple(content["connect"])
    except FileNotFoundError:
        raise LaunchError(
            f"{run}: no run in progress here ({ENDPOINT} is missing)"
        ) from None
    except (ValueError, KeyError, TypeError):
        raise LaunchError(f"{run / ENDPOINT}: not what a run writes there") from None


def derived(stats: Mapping[str, Any]) -> dict[str, Any]:
    """The counters with what follows from them."""
    capacity, row_bytes = stats["capacity"], stats["row_bytes"]
    names = [f"p{percent}" for percent in PERCENTILES]
    return {
        **stats,
        "ages": dict(zip(names, stats["ages"], strict=False)),
        "priorities": dict(zip(names, stats["priorities"], strict=False)),
        "memory_per_row_bytes": stats["table_bytes"] / capacity,
        "memory_over_rows": stats["table_bytes"] / (capacity * row_bytes),
    }


def _rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What is printed, as (name, value)."""
    kept = f"{figures['size']:,} of {figures['capacity']:,} rows"
    ratio = (
        f"{figures['samples_per_insert']:.3f} samples per insert "
        f"({figures['configured_samples_per_insert']:g} asked for)"
    )
    waits = (
        f"inserts {figures['insert_wait_s']:.1f} s, "
        f"samples {figures['sample_wait_s']:.1f} s in all; answered busy "
        f"{figures['busy_inserts']} and {figures['busy_samples']}"
    )
    memory = (
        f"{figures['table_bytes'] / 1e6:.1f} MB when full "
        f"({figures['memory_over_rows']:.2f} x the rows), process "
        f"{figures['resident_bytes'] / 1e6:.1f} MB, "
        f"files {figures['disk_bytes'] / 1e6:.1f} MB"
    )
    bad = (
        f"{figures['refused']} refused, {figures['duplicates']} duplicates, "
        f"{figures['gaps']} gaps, {figures['stale_updates']} stale priorities"
    )
    rows = [
        ("kept", f"{kept}, sampler {figures['sampler']}"),
        ("ratio", f"{ratio}, debt {figures['debt']:.0f} of {figures['tolerance']:.0f}"),
        ("inserts", f"{figures['inserts']:,}, {figures['insert_rate']:.0f}/s"),
        ("samples", f"{figures['samples']:,}, {figures['sample_rate']:.0f}/s"),
        ("waits", waits),
        ("age [rows]", _spread(figures["ages"])),
        ("priority", _spread(figures["priorities"])),
        ("transition", f"{figures['row_bytes']} bytes in memory and in a message"),
        ("memory", memory),
        ("requests", bad),
        ("durable", f"{figures['durable']}, {figures['recovered']:,} rows recovered"),
    ]
    if figures["fault"]:
        rows.insert(0, ("FAULT", figures["fault"]))
    return rows


def _spread(percentiles: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in percentiles.items())


def _table_of(shards: Mapping[str, Mapping[str, Any]]) -> Table:
    """A line for each shard."""
    table = Table("shard", "rows", "inserts", "samples", "ratio", "debt", "age, median")
    for number, told in shards.items():
        table.add_row(
            number,
            f"{told['size']:,}",
            f"{told['inserts']:,}, {told['insert_rate']:.0f}/s",
            f"{told['samples']:,}, {told['sample_rate']:.0f}/s",
            f"{told['samples_per_insert']:.3f}",
            f"{told['debt']:.0f}",
            f"{told['ages'].get('p50', 0):.0f}",
        )
    return table


def show(figures: Mapping[str, Any], console: Console) -> None:
    """Two tables: the replay, and its writers."""
    table = Table(show_header=False)
    for row in _rows(figures):
        table.add_row(*row)
    console.print(table)
    if figures["shards"] > 1:
        console.print(_table_of(figures["each"]))
    writers = Table("writer", "rows", "next batch", "waiting", "last stored [s ago]")
    for told in figures["writers"]:
        writers.add_row(
            str(told["writer"]),
            f"{told['rows']:,}",
            str(told["next_sequence"]),
            str(told["pending"]),
            f"{told['lag_s']:.1f}",
        )
    console.print(writers)


def stats_command(options: StatsConfig) -> int:
    """`slipstream replay stats`; the exit code."""
    run_id, connect = place_of(options.run, options.run_id, options.connect)
    check_endpoints(connect, options.insecure)
    keys, console, never = RunKeys(run_id), Console(), threading.Event()
    with open_session(connect=connect) as session:
        while True:
            shards = fetch_all_stats(session, keys)
            figures = derived(total(shards))
            figures["each"] = {str(n): derived(told) for n, told in shards.items()}
            if options.json == "-":
                print(json.dumps(figures), flush=True)
            else:
                show(figures, console)
            if options.json not in ("", "-"):
                text = json.dumps(figures, indent=1) + "\n"
                write_atomically(Path(options.json), text.encode())
            if not options.watch:
                return 0
            never.wait(_WATCH_S)
