"""Section `soak` of `slipstream bench replay`: a day in ten minutes, with random kills.

A durable service, four writers and three readers, each a process, as fast as they can.
In the first half one of them is killed every six seconds on average; in the second half
only writers and readers are, so that the service lives long enough for a leak to show.
One writer and two readers are never killed: they live through all reconnections. Rows
come to one of these by memory that it shares with the service and to the other by a
stream, as from another machine; to the third reader by either in turn. What must hold
is in `launch.bench_soak_verdict`; a soak in which it does not makes the command's exit
code 1.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from launch.bench_replay_runs import Contestant
from launch.bench_replay_sections import Row, Sizes
from launch.bench_soak_roles import CONFIG
from launch.bench_soak_run import Look, Soak
from launch.bench_soak_verdict import (
    disk_faults,
    found_bytes_per_query,
    memory_of,
    most_owed,
    ratio_faults,
    worst_window,
)
from launch.converting import say

WRITERS: Final = 4
SEED: Final = 0
_SAID_EVERY: Final = 15  # looks


def soak(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """A look every two seconds, and the verdict."""
    looks: list[Look] = []
    say(f"soak: {sizes.soak_seconds:g} s")
    with tempfile.TemporaryDirectory(prefix="slipstream-bench-") as name:
        running = Soak(
            Path(name), seconds=sizes.soak_seconds, writers=WRITERS, seed=SEED
        )
        try:
            for look in running.run():
                if len(looks) % _SAID_EVERY == 0:
                    say(_words(look))
                looks.append(look)
                yield {"what": "look", **look}
            stats = running.finish()
        finally:
            running.abandon()
    yield {"what": "verdict", **_verdict(looks, running, stats)}


def _words(look: Look) -> str:
    return (
        f"soak: {look['seconds']:.0f} s, {look.get('inserts', 0):,} inserts, "
        f"{sum(look['kills'].values())} kills"
    )


def _verdict(looks: list[Look], ran: Soak, stats: dict[str, Any]) -> dict[str, Any]:
    memory, faults = memory_of(looks)
    faults += disk_faults(looks) + ratio_faults(ran.marks) + _row_faults(ran, stats)
    return {
        "held": not faults,
        "faults": faults,
        "inserts": stats["inserts"],
        "samples": stats["samples"],
        "samples_per_insert": stats["samples"]
        / max(1, stats["inserts"] - CONFIG.min_size),
        "configured_samples_per_insert": CONFIG.samples_per_insert,
        "worst_ratio_error": worst_window(ran.marks),
        "most_owed_in_tolerances": most_owed(ran.marks),
        "marks": len(ran.marks),
        "kills": ran.kills,
        "unseen_rows": ran.rows.unseen,
        "answers": ran.answers,
        "memory": memory,
        "leak_found_bytes_per_query": found_bytes_per_query(looks),
    }


def _row_faults(ran: Soak, stats: dict[str, Any]) -> list[str]:
    """What was not there, not once, or not as written."""
    rows, faults = ran.rows, []
    for (writer, life), told in ran.acknowledged.items():
        if rows.counts.get((writer, life), 0) < told:
            faults.append(
                f"rows: {told} acknowledged of writer {writer}, life {life}: not all "
                "were there"
            )
    received, damaged = ran.received
    if rows.damaged or rows.misplaced or damaged:
        faults.append(
            f"rows: {rows.damaged} damaged, {rows.misplaced} misplaced, {damaged} "
            "damaged in samples"
        )
    if stats["inserts"] != rows.next_id:
        faults.append(f"rows: {stats['inserts']} counted, {rows.next_id} there")
    if received > stats["samples"]:
        faults.append(f"rows: {received} received, {stats['samples']} sampled")
    unused = [way for way, answers in ran.answers.items() if not answers]
    return faults + [f"rows: none came by {way}" for way in unused]
