"""Section `scale` of `slipstream bench replay`: shards, writers, and the model.

First shards times writers, at one workload; then one shard at other batch sizes and
samples per insert, which tell the costs of rows and of queries apart; then the model
(`launch.bench_replay_model`), fitted on every second of these and checked on the rest.
"""

import dataclasses
import os
from collections.abc import Iterator, Mapping
from typing import Any, Final

from launch.bench_replay_model import TERMS, Point, Run, checked_fit, needs
from launch.bench_replay_runs import Contestant, Crew, measure
from launch.bench_replay_sections import OURS, Row, Sizes
from launch.converting import say

ROW_BYTES: Final = 128
TICK_S: Final = 1 / os.sysconf("SC_CLK_TCK")  # of the kernel's account of CPU time
SECONDS: Final = 2.0  # of each point, at most: there are many
RATIOS: Final = (2.0, 8.0, 32.0)  # samples per insert of the model's points
INSERTS: Final = (16, 64, 128)  # rows per insert of the model's points
BOTH: Final = 2048  # rows per insert times rows per sample, of these points


def scale(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """Shards and writers, with rows of 128 bytes; then the model of a larger run."""
    seconds = min(sizes.seconds, SECONDS)
    load = sizes.workload(row_bytes=ROW_BYTES)
    best = 0.0
    for shards in sizes.shards:
        # A shard without a writer would never fill.
        for writers in dict.fromkeys(max(count, shards) for count in sizes.writers):
            crew = Crew(shards=shards, writers=writers)
            say(f"scale: {shards} shards, {crew.writers} writers")
            found = measure(OURS[1], load, crew, seconds=seconds)
            best = max(best, found["samples_per_s"]) if shards == 1 else best
            yield {"what": "scale", **found}
    points = []
    for ratio in RATIOS:
        for rows in INSERTS:
            say(f"scale: {ratio:g} samples per insert, inserts of {rows}")
            # Large inserts go with small samples: alike, they could not be told apart.
            varied = sizes.workload(
                row_bytes=ROW_BYTES,
                samples_per_insert=ratio,
                insert_rows=rows,
                batch_size=BOTH // rows,
                batches_per_reply=1,
            )
            found = measure(OURS[0], varied, seconds=seconds)
            points.append(point_of(found))
            sent = {"insert_rows": rows, "batch_size": varied.batch_size}
            yield {"what": "point", **found, **sent}
    model = checked_fit(points)
    asked = Run()
    projected = needs(model["costs_us"], asked, shard_samples_per_s=best)
    yield {"what": "model", **model, "run": dataclasses.asdict(asked), **projected}


def point_of(found: Mapping[str, Any]) -> Point:
    """A measurement as the model has it."""
    rates = {
        "insert_rows": found["inserts_per_s"],
        "insert_queries": found["insert_queries_per_s"],
        "sample_rows": found["samples_per_s"],
        "sample_queries": found["sample_queries_per_s"],
    }
    least = TICK_S / found["seconds"]  # what was less was not seen, yet is not nothing
    cores = {kind: max(found["cores"][kind], least) for kind in TERMS}
    return Point(rates=rates, cores=cores)
