"""Section `memory` of `slipstream bench replay`: what a row takes.

A service's process is looked at twice in one life: when the first rows are stored, and
when its table is full. What it grew by, divided by the rows between, is what a row
takes. Programs fall out; buffers that grow with the traffic do not. Two starts, or
looks while the table fills, differ by megabytes of what is on its way. Counted is what
the process has to itself, anonymous pages and those of its mapped files, as
`tests/test_replay_memory.py` counts. Nothing is sampled: tables fill up to `min_size`,
which is all of them.
"""

import time
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from actors.rows import row_spec
from launch.bench_replay_runs import LOOK_S, Contestant, Crew, Crewed
from launch.bench_replay_sections import OURS, PRESET, TORCHRL, Row, Sizes
from launch.config import PRESETS
from launch.converting import say
from replay.wire import SampleReplyBuffer, SampleRequest
from replay.wire_inserts import Insert

SETTLING: Final = 10  # looks at a full table
KILOBYTES: Final = 8192  # of the rows that peers are compared on


def memory(sizes: Sizes, peer: Contestant | None) -> Iterator[Row]:
    """Growth of the service's process per row, and bytes per row in messages."""
    for row_bytes, count in sizes.memory_rows:
        turns = [(OURS[0], False), (OURS[0], True)]
        if row_bytes == KILOBYTES:
            turns.append((TORCHRL[0], False))
        for contestant, durable in turns:
            say(f"memory: {contestant.label}, {count:,} rows of {row_bytes} B")
            grown = _grown(contestant, sizes, row_bytes, count, durable)
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


def _grown(
    contestant: Contestant, sizes: Sizes, row_bytes: int, rows: int, durable: bool
) -> float:
    """Bytes that a service grows by for each row that it takes in."""
    load = sizes.workload(
        row_bytes=row_bytes, capacity=rows, min_size=rows, durable=durable
    )
    with Crewed(contestant, load, Crew(reader=False)) as crewed:
        stored, held = 0.0, 0
        while stored == 0.0:
            held = crewed.own_bytes("service-0")
            stored = crewed.look()["writers"]["stored"]
        crewed.fill(rows)
        # Until what is on its way has arrived and its buffers are let go.
        looks = []
        for _ in range(SETTLING):
            time.sleep(LOOK_S)
            looks.append(crewed.own_bytes("service-0"))
        return (min(looks) - held) / (rows - min(stored, rows / 2))


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
