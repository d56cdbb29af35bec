"""The sections of `slipstream bench replay`; see `launch.bench_replay`."""

import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from launch.bench_replay_runs import Contestant, Workload, measure
from launch.converting import say

Row = dict[str, Any]
OURS: Final = (
    Contestant(name="slipstream"),
    Contestant(name="slipstream", shared_memory=True),
)
TORCHRL: Final = (
    Contestant(name="torchrl"),
    Contestant(name="torchrl", shared_memory=True),
)


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    repetitions: int = 3
    seconds: float = 5.0
    capacity: int = 20_000
    min_size: int = 2_000

    def workload(self) -> Workload:
        """Rows of 8 KB."""
        return Workload(
            capacity=self.capacity,
            min_size=self.min_size,
            # A small table needs a wider window for batches of 64 (`replay.limiter`).
            tolerance=max(0.1, 64 / self.min_size),
        )


def throughput(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """Rows of 8 KB: one writer, one reader, priorities set for every batch."""
    contestants = (*OURS, *TORCHRL, *([peer] if peer else []))
    for repetition in range(sizes.repetitions):
        for contestant in contestants:
            say(f"throughput: {contestant.label}, repetition {repetition + 1}")
            found = measure(contestant, sizes.workload(), seconds=sizes.seconds)
            yield {"repetition": repetition, **found}


def ratios(rows: Sequence[Mapping[str, Any]], ours: bool, peer: str) -> list[float]:
    """Our samples/s over a peer's, repetition by repetition.

    `ours`: by shared memory. A peer is compared over TCP: what a user would have.
    """
    found = []
    for repetition in sorted({row["repetition"] for row in rows}):
        same = [row for row in rows if row["repetition"] == repetition]
        mine = _rate(same, "slipstream", ours)
        theirs = _rate(same, peer, False)
        if mine and theirs:
            found.append(mine / theirs)
    return found


def _rate(
    rows: Sequence[Mapping[str, Any]], name: str, shared_memory: bool
) -> float | None:
    for row in rows:
        if (row["contestant"], row["shared_memory"]) == (name, shared_memory):
            return float(row["samples_per_s"])
    return None


def medians(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Each contestant's medians over its repetitions, in the order of the run."""
    groups: dict[tuple[str, bool], list[Mapping[str, Any]]] = {}
    for row in rows:
        key = (row["contestant"], row["shared_memory"])
        groups.setdefault(key, []).append(row)
    return [
        {
            "contestant": name,
            "shared_memory": shared,
            "repetitions": len(group),
            **{
                what: statistics.median(row[what] for row in group)
                for what in (
                    "samples_per_s",
                    "inserts_per_s",
                    "samples_per_insert",
                    "cpu_us_per_sample",
                )
            },
            "cpu_us_per_sample_by": {
                kind: statistics.median(
                    row["cpu_us_per_sample_by"][kind] for row in group
                )
                for kind in group[0]["cpu_us_per_sample_by"]
            },
        }
        for (name, shared), group in groups.items()
    ]
