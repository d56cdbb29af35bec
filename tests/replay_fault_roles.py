"""Roles of the tests of faults and of the soak's: processes to stall, cut and kill.

    python -m tests.replay_fault_roles service ENDPOINT[,ENDPOINT]
    python -m tests.replay_fault_roles writer ENDPOINT WRITER EPOCH
    python -m tests.replay_fault_roles reader ENDPOINT

LEASE_S in the environment replaces the session's lease of a minute. All run until
SIGTERM. The writer then prints how many rows are acknowledged, the reader how many it
received, how many of them were damaged, and how many answers came by a stream: it
shares no memory, so that all it draws crosses the link.
"""

import contextlib
import dataclasses
import os
import sys

import replay.sampler
import replay.session
from replay.client import ReplayTimeout, Sampler, Writer
from replay.server import ReplayServer
from replay.session import open_session
from tests.replay_durable_parts import CHECKED, LOADED, checked_rows, checksum
from tests.replay_parts import KEYS
from tests.replay_roles import until_term

HOLD_S = 1.0  # queries time out five seconds later


def serve(endpoints: str) -> None:
    """A service in memory that is also the router."""
    stop = until_term()
    session = open_session(listen=endpoints.split(","), router=True)
    config = dataclasses.replace(LOADED, durable=False)
    server = ReplayServer(session=session, keys=KEYS, spec=CHECKED, config=config)
    print("ready", flush=True)
    server.run(stop)
    session.close()


def write(endpoint: str, writer: int, epoch: int) -> None:
    """Numbered rows with checksums, as fast as they are taken."""
    stop, start = until_term(), 0
    session = open_session(connect=[endpoint], timeout_s=60.0)
    sink = Writer(
        session=session,
        keys=KEYS,
        spec=CHECKED,
        writer=writer,
        epoch=epoch,
        batch_rows=10,
        hold_s=HOLD_S,
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


def read(endpoint: str) -> None:
    """Samples as fast as it gets, and looks at every row."""
    stop, received, damaged = until_term(), 0, 0
    replay.sampler._STREAM_RETRY_S = 1.0
    session = open_session(connect=[endpoint], timeout_s=60.0, shared_memory=False)
    sampler = Sampler(
        session=session, keys=KEYS, spec=CHECKED, batch_size=32, hold_s=HOLD_S
    )
    sampler.stream_bytes = 1  # else these are too small
    while not stop.is_set():
        with contextlib.suppress(ReplayTimeout):
            rows = sampler.sample(0.2).rows
            received += len(rows)
            damaged += sum(int(row["crc"]) != checksum(row) for row in rows)
    print("all", received, damaged, sampler.streamed, flush=True)
    session.close()


if __name__ == "__main__":
    replay.session.STALL_S = float(os.environ.get("LEASE_S", replay.session.STALL_S))
    if sys.argv[1] == "service":
        serve(sys.argv[2])
    elif sys.argv[1] == "writer":
        write(sys.argv[2], *map(int, sys.argv[3:]))
    else:
        read(sys.argv[2])
