"""The sections of `slipstream bench replay`; see `launch.bench_replay`."""

import dataclasses
import statistics
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from launch import bench_child
from launch.bench_replay_runs import Contestant, Crew, Workload, measure
from launch.config import PRESETS
from launch.converting import say
from launch.scenes import write_procedural

Row = dict[str, Any]
PRESET: Final = "paper"  # whose rows and observations are measured
WINDOW: Final = 200  # rows that the limiter's sides may be apart, at least
SMALL_INSERT: Final = 128  # rows of 128 bytes in a message, as quick's actors send
# Batches that Reverb, which has no replies of several, asks for ahead, halved: 1,024
# samples, with which it is fastest of 128 to 2,048, and 128, Acme's setting.
PEER_AHEAD: Final = (8, 1)
SMALL_REPLIES: Final = 2  # times as many batches in a reply of rows of 128 bytes
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
    seconds: float = 3.0
    capacity: int = 20_000
    min_size: int = 16_000  # most of a ring is filled before the limiter counts
    batches_per_reply: int = 16
    scenes: int = 16  # of the bank that rows are rendered from
    memory_rows: tuple[tuple[int, int], ...] = ((8192, 1 << 14), (128, 1 << 20))
    shards: tuple[int, ...] = (1, 2, 3, 4)
    writers: tuple[int, ...] = (1, 4, 16, 64)
    soak_seconds: float = 600.0

    def workload(self, **changes: Any) -> Workload:  # noqa: ANN401 - any of its fields
        """Rows of 8 KB unless `changes` says something else."""
        known = {
            "capacity": self.capacity,
            "min_size": self.min_size,
            "batches_per_reply": self.batches_per_reply,
        }
        load = Workload(**{**known, **changes})
        # As narrow as the batches allow (`replay.limiter`), whatever the size.
        sampled = load.batch_size * load.batches_per_reply / load.samples_per_insert
        rows = max(WINDOW, load.insert_rows + sampled)
        return dataclasses.replace(load, tolerance=rows / load.min_size)


def throughput(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """Rows of 8 KB: one writer, one reader, priorities set for every batch."""
    several = sizes.batches_per_reply
    turns = [(contestant, several) for contestant in (*OURS, *TORCHRL)]
    if several > 1:
        turns += [(contestant, 1) for contestant in OURS]
    if peer is not None:
        turns += [(peer, batches) for batches in PEER_AHEAD]
    for repetition in range(sizes.repetitions):
        for contestant, batches in turns:
            say(
                f"throughput: {contestant.label}, batches in a reply: {batches}, "
                f"repetition {repetition + 1}"
            )
            load = sizes.workload(batches_per_reply=batches)
            found = measure(contestant, load, seconds=sizes.seconds)
            yield {"repetition": repetition, **found}


def rows(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """The project's rows: sampled beside a peer's items of 8 KB, and rendered.

    Messages are larger than those of rows of 8 KB: with 128 bytes it is they that cost.
    """
    history = PRESETS[PRESET]().environment.observation.history
    with tempfile.TemporaryDirectory(prefix="slipstream-bench-") as folder:
        bank = Path(folder) / "rows.bank"
        write_procedural(bank, count=sizes.scenes, seed=1)
        load = sizes.workload(
            history=history,
            bank=str(bank),
            insert_rows=SMALL_INSERT,
            batches_per_reply=SMALL_REPLIES * sizes.batches_per_reply,
        )
        for repetition in range(sizes.repetitions):
            for contestant in OURS:
                say(f"rows: {contestant.label}, repetition {repetition + 1}")
                found = measure(contestant, load, seconds=sizes.seconds)
                yield {"what": "sampled", "repetition": repetition, **found}
            if peer is not None:
                say(f"rows: {peer.label}, 8 KB, repetition {repetition + 1}")
                eight = sizes.workload(batches_per_reply=1)
                found = measure(peer, eight, seconds=sizes.seconds)
                yield {"what": "sampled", "repetition": repetition, **found}
            say(f"rows: rendering, repetition {repetition + 1}")
            crew = Crew(render=PRESET, one_core=True)
            found = measure(OURS[1], load, crew, seconds=sizes.seconds)
            yield {
                "what": "sampled and rendered",
                "repetition": repetition,
                "observations_per_s": 2 * found["samples_per_s"],
                **found,
            }
            request = {
                "bank": str(bank),
                "preset": PRESET,
                "rows": load.batch_size,
                "seconds": sizes.seconds,
            }
            for alone in bench_child.run("rendering", request, one_core=True):
                yield {"what": "rendered", "repetition": repetition, **alone}


def ratios(
    rows: Sequence[Mapping[str, Any]], ours: bool, peer: str, theirs: bool = False
) -> list[float]:
    """Our samples/s over a peer's, repetition by repetition.

    `ours`, `theirs`: by shared memory. Of ours the turn with the most batches in a
    reply counts, which is the designed path.
    """
    found = []
    for repetition in sorted({row["repetition"] for row in rows}):
        same = [row for row in rows if row["repetition"] == repetition]
        mine = _rate(same, "slipstream", ours)
        other = _rate(same, peer, theirs)
        if mine and other:
            found.append(mine / other)
    return found


def _rate(
    rows: Sequence[Mapping[str, Any]], name: str, shared_memory: bool
) -> float | None:
    same = [
        row
        for row in rows
        if (row["contestant"], row["shared_memory"]) == (name, shared_memory)
    ]
    if not same:
        return None
    return float(max(same, key=lambda row: row["batches_per_reply"])["samples_per_s"])


def medians(rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Each contestant's medians over its repetitions, in the order of the run."""
    groups: dict[tuple[str, bool, int], list[Mapping[str, Any]]] = {}
    for row in rows:
        key = (row["contestant"], row["shared_memory"], row["batches_per_reply"])
        groups.setdefault(key, []).append(row)
    return [
        {
            "contestant": name,
            "shared_memory": shared,
            "batches_per_reply": batches,
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
        for (name, shared, batches), group in groups.items()
    ]
