"""Roles of the replay's tests that run as processes of their own, to be killed.

    python -m tests.replay_roles service ENDPOINT
    python -m tests.replay_roles writer ENDPOINT WRITER EPOCH ROWS

The writer numbers its rows from `EPOCH * 1_000_000` and prints how many rows were
acknowledged whenever that grows; the service prints `ready`.
"""

import signal
import sys
import threading

from replay.client import Writer
from replay.server import ReplayServer
from replay.session import open_session
from tests.replay_parts import KEYS, OPEN, SPEC, make_rows


def serve(endpoint: str) -> None:
    """A service that is also the router, until SIGTERM."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    session = open_session(listen=[endpoint], router=True)
    server = ReplayServer(session=session, keys=KEYS, spec=SPEC, config=OPEN)
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


if __name__ == "__main__":
    if sys.argv[1] == "service":
        serve(sys.argv[2])
    else:
        write(sys.argv[2], *map(int, sys.argv[3:]))
