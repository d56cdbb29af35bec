"""Roles of the replay's tests that run as processes of their own, to be killed.

    python -m tests.replay_roles service ENDPOINT [FOLDER]
    python -m tests.replay_roles writer ENDPOINT WRITER EPOCH ROWS
    python -m tests.replay_roles checked ENDPOINT WRITER EPOCH
    python -m tests.replay_roles reader ENDPOINT BATCHES

The writer numbers its rows from `EPOCH * 1_000_000` and prints how many rows were
acknowledged whenever that grows; the service prints `ready`. With a folder it is
durable and its rows are checked ones; `checked` writes those until SIGTERM, and puts
them into memory for the service to read if its number is odd. The reader checks what
it draws and prints how many answers came through shared memory.
"""

import signal
import sys
import threading
from pathlib import Path

import replay.writer
from replay.client import Sampler, Writer
from replay.server import ReplayServer
from replay.session import open_session
from tests.replay_durable_parts import CHECKED, LOADED, checked_rows
from tests.replay_parts import KEYS, OPEN, SPEC, make_rows


def until_term() -> threading.Event:
    """Set by SIGTERM."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    return stop


def serve(endpoint: str, folder: Path | None) -> None:
    """A service that is also the router, until SIGTERM."""
    stop = until_term()
    session = open_session(listen=[endpoint], router=True)
    server = ReplayServer(
        session=session,
        keys=KEYS,
        spec=CHECKED if folder else SPEC,
        config=LOADED if folder else OPEN,
        folder=folder,
    )
    print("ready", flush=True)
    server.run(stop)
    session.close()


def write(endpoint: str, writer: int, epoch: int, rows: int) -> None:
    """Writes `rows` rows, ten at a time."""
    session = open_session(connect=[endpoint])
    sink = Writer(
        session=session,
        keys=KEYS,
        spec=SPEC,
        writer=writer,
        epoch=epoch,
        batch_rows=10,
        hold_s=1.0,
    )
    first, told = epoch * 1_000_000, 0
    for start in range(first, first + rows, 10):
        sink.append(make_rows(start, 10, writer=writer))
        if sink.acknowledged > told:
            told = sink.acknowledged
            print(told, flush=True)
    if sink.close(60.0):
        print("all", sink.acknowledged, flush=True)
    session.close()


def write_checked(endpoint: str, writer: int, epoch: int) -> None:
    """Writes rows with checksums until SIGTERM, then tells how many are stored."""
    stop, start = until_term(), 0
    if writer % 2:
        replay.writer._LEAST_PLACED_BYTES = 1  # else these are too small
    session = open_session(connect=[endpoint], timeout_s=60.0)
    sink = Writer(
        session=session,
        keys=KEYS,
        spec=CHECKED,
        writer=writer,
        epoch=epoch,
        batch_rows=10,
        hold_s=1.0,
    )
    while not stop.is_set():
        rows = checked_rows(start, 10, writer=writer)
        # What did not fit in time is whole and offered again.
        while not sink.append(rows, 0.2) and not stop.is_set():
            rows = rows[:0]
        start += 10
        stop.wait(0.002)
    if sink.close(60.0):
        print("all", sink.acknowledged, flush=True)
    session.close()


def read(endpoint: str, batches: int) -> None:
    """Draws batches of 8 and checks every row."""
    session = open_session(connect=[endpoint])
    sampler = Sampler(session=session, keys=KEYS, spec=SPEC, batch_size=8)
    for drawn in range(batches):
        rows = sampler.sample(20.0).rows
        assert (rows == make_rows(0, 1000)[rows["number"]]).all()
        if drawn == 50:
            print("reading", flush=True)
    print("placed", sampler.placed, flush=True)
    session.close()


if __name__ == "__main__":
    if sys.argv[1] == "service":
        serve(sys.argv[2], Path(sys.argv[3]) if len(sys.argv) > 3 else None)
    elif sys.argv[1] == "checked":
        write_checked(sys.argv[2], *map(int, sys.argv[3:]))
    elif sys.argv[1] == "reader":
        read(sys.argv[2], int(sys.argv[3]))
    else:
        write(sys.argv[2], *map(int, sys.argv[3:]))
