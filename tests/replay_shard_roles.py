"""Shards and writers of the shards' tests as processes of their own, to be killed.

    python -m tests.replay_shard_roles shard NUMBER ENDPOINT HUB|- FOLDER|-
    python -m tests.replay_shard_roles writer HUB WRITER SHARDS durable|memory

A shard prints `ready`; a writer writes checked rows, ten at a time, until SIGTERM, and
prints how many were acknowledged in all.
"""

import dataclasses
import sys
import time
from pathlib import Path

from replay.session import open_session
from replay.shards_directory import ShardDirectory
from replay.shards_writer import ShardedWriter
from tests.replay_durable_parts import CHECKED, LOADED, checked_rows
from tests.replay_parts import KEYS
from tests.replay_roles import until_term
from tests.replay_shard_parts import Shard


def serve(number: int, endpoint: str, hub: str, folder: str) -> None:
    """A shard until SIGTERM."""
    stop = until_term()
    shard = Shard(
        number,
        dataclasses.replace(LOADED, durable=folder != "-"),
        hub=None if hub == "-" else hub,
        endpoint=endpoint,
        folder=None if folder == "-" else Path(folder),
        spec=CHECKED,
    )
    print("ready", flush=True)
    stop.wait()
    shard.close()


def write(hub: str, writer: int, shards: int, durable: bool) -> None:
    """A writer until SIGTERM."""
    stop, start = until_term(), 0
    session = open_session(connect=[hub], timeout_s=60.0)
    directory = ShardDirectory(
        session=session, keys=KEYS, spec=CHECKED, hub=[hub], wanted=()
    )
    sink = ShardedWriter(
        directory=directory,
        spec=CHECKED,
        writer=writer,
        epoch=time.time_ns() // 1_000_000,
        shards=shards,
        durable=durable,
        batch_rows=10,
    )
    while not stop.is_set():
        rows = checked_rows(start, 10, writer=writer)
        while not sink.append(rows, 0.2) and not stop.is_set():
            rows = rows[:0]
        start += 10
        stop.wait(0.004)
    if sink.close(60.0):
        print("all", start, flush=True)
    directory.close()
    session.close()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    if sys.argv[1] == "shard":
        serve(int(sys.argv[2]), *sys.argv[3:])
    else:
        write(*sys.argv[2:3], *map(int, sys.argv[3:5]), sys.argv[5] == "durable")
