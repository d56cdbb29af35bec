"""The soak's processes: a durable service, writers and a reader, each to be killed.

    python -m launch.bench_soak_roles service ENDPOINT FOLDER
    python -m launch.bench_soak_roles writer ENDPOINT WRITER LIFE
    python -m launch.bench_soak_roles reader ENDPOINT memory|stream

They run at full rate until SIGTERM, or until their standard input ends: none outlives
the soak. Writers print how many rows are acknowledged, readers how many they received,
how many of those were damaged and how many answers came the reader's way, as they go.
"""

import contextlib
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Integer

from replay.client import ReplayTimeout, Sampler, Writer
from replay.keys import RunKeys
from replay.server import ReplayConfig, ReplayServer
from replay.session import open_session
from replay.spec import Field, RowSpec

KEYS: Final = RunKeys("soak")
SPEC: Final = RowSpec(
    (
        Field("writer", "i4"),
        Field("life", "i4"),
        Field("number", "i8"),
        Field("words", "u8", (14,)),  # to 128 bytes
    )
)
INSERTED: Final = 32  # rows of an insert
DRAWN: Final = 64  # rows of a sample
# The ring comes round within a minute, so that what grows afterwards is a leak. Twice
# the tolerance of 256 samples is 0.64% of those that 10,000 inserts allow, and these
# batches need 248.
CONFIG: Final = ReplayConfig(
    capacity=1 << 17,
    min_size=1_000,
    samples_per_insert=8.0,
    tolerance=0.032,
    sampler="prioritized",
    durable=True,
    sync_s=1.0,
)
_TOLD_S: Final = 0.2


def words_of(
    writer: Integer[np.ndarray, " rows"],
    life: Integer[np.ndarray, " rows"],
    number: Integer[np.ndarray, " rows"],
) -> Integer[np.ndarray, "rows words"]:
    """What a row holds: it follows from who wrote it and its number."""
    seed = number.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    seed += writer.astype(np.uint64) << np.uint64(32)
    seed += life.astype(np.uint64)
    return seed[:, None] * (
        np.arange(14, dtype=np.uint64) * np.uint64(2) + np.uint64(1)
    )


def rows_of(writer: int, life: int, start: int) -> np.ndarray:
    """A batch of rows from number `start` on."""
    rows = np.zeros(INSERTED, SPEC.dtype)
    rows["writer"], rows["life"] = writer, life
    rows["number"] = np.arange(start, start + INSERTED)
    rows["words"] = words_of(rows["writer"], rows["life"], rows["number"])
    return rows


def are_whole(rows: np.ndarray) -> Bool[np.ndarray, " rows"]:
    """Which rows are as they were written."""
    words = words_of(rows["writer"], rows["life"], rows["number"])
    return (rows["words"] == words).all(axis=1)


def _until_term() -> threading.Event:
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())

    def listen() -> None:
        sys.stdin.read()
        stop.set()

    threading.Thread(target=listen, daemon=True).start()
    return stop


def _serve(endpoint: str, folder: Path) -> None:
    stop = _until_term()
    session: Any = open_session(listen=[endpoint], router=True)
    server = ReplayServer(
        session=session,
        keys=KEYS,
        spec=SPEC,
        config=CONFIG,
        folder=folder,
        largest=(INSERTED, DRAWN),
    )
    server.run(stop)
    session.close()


def _write(endpoint: str, writer: int, life: int) -> None:
    stop, start, due = _until_term(), 0, 0.0
    session: Any = open_session(connect=[endpoint], timeout_s=60.0)
    sink = Writer(
        session=session,
        keys=KEYS,
        spec=SPEC,
        writer=writer,
        epoch=life,
        batch_rows=INSERTED,
        hold_s=1.0,
    )
    while not stop.is_set():
        rows = rows_of(writer, life, start)
        # What did not fit in time is whole and offered again.
        while not sink.append(rows, _TOLD_S) and not stop.is_set():
            rows = rows[:0]
        start += INSERTED
        if time.monotonic() > due:
            due = time.monotonic() + _TOLD_S
            print(sink.acknowledged, flush=True)
    sink.close(30.0)
    print(sink.acknowledged, flush=True)
    session.close()


def _read(endpoint: str, way: str) -> None:
    stop, received, damaged, due = _until_term(), 0, 0, 0.0
    session: Any = open_session(
        connect=[endpoint], timeout_s=60.0, shared_memory=way == "memory"
    )
    sampler = Sampler(
        session=session, keys=KEYS, spec=SPEC, batch_size=DRAWN, hold_s=1.0
    )
    sampler.stream_bytes = 1  # such small answers, too
    random = np.random.default_rng(0)
    while not stop.is_set():
        with contextlib.suppress(ReplayTimeout):
            sample = sampler.sample(_TOLD_S)
            received += DRAWN
            damaged += int((~are_whole(sample.rows)).sum())
            sampler.update_priorities(sample.ids, random.gamma(1.0, size=DRAWN))
        if time.monotonic() > due:
            due = time.monotonic() + _TOLD_S
            print(received, damaged, sampler.placed + sampler.streamed, flush=True)
    print(received, damaged, sampler.placed + sampler.streamed, flush=True)
    session.close()


if __name__ == "__main__":
    if sys.argv[1] == "service":
        _serve(sys.argv[2], Path(sys.argv[3]))
    elif sys.argv[1] == "writer":
        _write(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        _read(*sys.argv[2:4])
