"""Section `memory` of `slipstream bench replay`: what a row takes.

A service's process is looked at with two numbers of rows, in two starts; what it grew
by between them, divided by the rows between them, is what a row takes: programs and
buffers of a constant size fall out. Counted are all pages of the process, anonymous
and mapped. Nothing is sampled: tables fill up to `min_size`, which is all of them.
"""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from actors.rows import row_spec
from launch.bench_replay_runs import Contestant, Crew, Crewed
from launch.bench_replay_sections import OURS, PRESET, TORCHRL, Row, Sizes
from launch.config import PRESETS
from launch.converting import say
from replay.wire import SampleReplyBuffer, SampleRequest
from replay.wire_inserts import Insert

FACTOR: Final = 4  # between the two numbers of rows
KILOBYTES: Final = 8192  # of the rows that peers are compared on


def memory(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """Growth of the service's process per row, and bytes per row in messages."""
    for row_bytes, count in sizes.memory_rows:
        turns = [(OURS[0], False), (OURS[0], True)]
        if row_bytes == KILOBYTES:
            turns.append((TORCHRL[0], False))
        for contestant, durable in turns:
            say(f"memory: {contestant.label}, {count:,} rows of {row_bytes} B")
            held = [
                _resident(contestant, sizes, row_bytes, rows, durable)
                for rows in (count // FACTOR, count)
            ]
            grown = (held[1] - held[0]) / (count - count // FACTOR)
            yield {
                "what": "process",
                "contestant": contestant.name,
                "row_bytes": row_bytes,
                "durable": durable,
                "rows": count,
                "bytes_per_row": grown,
                "over_own_bytes": grown / row_bytes,
            }
    yield {"what": "messages", **message_bytes()}


def _resident(
    contestant: Contestant, sizes: Sizes, row_bytes: int, rows: int, durable: bool
) -> float:
    """Of a service that holds so many rows."""
    load = sizes.workload(
        row_bytes=row_bytes, capacity=rows, min_size=rows, durable=durable
    )
    with Crewed(contestant, load, Crew(reader=False)) as crewed:
        crewed.fill(rows)
        return crewed.look()["service-0"]["resident_bytes"]


def message_bytes(batch: int = 64) -> dict[str, Any]:
    """Bytes per transition of log-replayed traffic in each message, as encoded."""
    spec = row_spec(PRESETS[PRESET]().environment.observation.history)
    rows = np.zeros((batch, spec.row_bytes), np.uint8)
    insert = Insert(writer=0, epoch=0, sequence=0, base=0, hold_ms=0, rows=rows)
    ask = SampleRequest(
        batch_size=batch,
        batches=1,
        hold_ms=0,
        ids=np.zeros(batch, np.uint64),
        priorities=np.zeros(batch),
    )
    reply = SampleReplyBuffer(spec=spec, count=batch).payload
    return {
        "row_bytes": spec.row_bytes,
        "insert": len(insert.encode(spec)) / batch,
        "sample_request": len(ask.encode(spec)) / batch,
        "sample_reply": len(reply) / batch,
    }
