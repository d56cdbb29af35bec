"""What the replay's tests share: a row layout, sessions, a service in a thread."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zenoh

from replay.keys import RunKeys
from replay.server import ReplayConfig, ReplayServer
from replay.session import open_session
from replay.spec import Field, RowSpec

KEYS = RunKeys("test-run")
SPEC = RowSpec(
    (Field("writer", "i4"), Field("number", "i8"), Field("state", "f4", (3,)))
)
# 10 = e: enough for inserts of 4 and samples of 8 at two samples per insert.
SMALL = ReplayConfig(
    capacity=4096,
    min_size=10,
    samples_per_insert=2.0,
    tolerance=0.5,
    priority_exponent=0.6,
)
# For tests that only insert: the limiter never stands in the way.
OPEN = ReplayConfig(
    capacity=1 << 16,
    min_size=1 << 16,
    samples_per_insert=1.0,
    tolerance=1.0,
    priority_exponent=0.0,
)


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def make_rows(start: int, count: int, *, writer: int = 0) -> np.ndarray:
    """Rows numbered from `start`, whose other fields follow from their number."""
    rows = np.zeros(count, SPEC.dtype)
    rows["writer"] = writer
    rows["number"] = np.arange(start, start + count)
    rows["state"] = rows["number"][:, None] * np.array([1, 2, 3])
    return rows


def eventually(condition: Callable[[], object], timeout: float = 20.0) -> bool:
    """Whether it comes true in time; for what has no event of its own."""
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


@contextlib.contextmanager
def session_to(endpoint: str) -> Iterator[zenoh.Session]:
    """A client's session, closed at the end."""
    session = open_session(connect=[endpoint])
    try:
        yield session
    finally:
        session.close()


@dataclass
class Service:
    """A running service and a client's session to it."""

    endpoint: str
    server: ReplayServer
    client: zenoh.Session


@contextlib.contextmanager
def service(
    config: ReplayConfig,
    *,
    seed: int = 0,
    spec: RowSpec = SPEC,
    folder: Path | None = None,
    largest: tuple[int, int] | None = None,
    keys: RunKeys = KEYS,
) -> Iterator[Service]:
    """A replay service in a thread of this process, over a real TCP link."""
    endpoint = free_endpoint()
    router = open_session(listen=[endpoint], router=True)
    server = ReplayServer(
        session=router,
        keys=keys,
        spec=spec,
        config=config,
        seed=seed,
        folder=folder,
        largest=largest,
    )
    stop = threading.Event()
    thread = threading.Thread(target=server.run, args=(stop,))
    thread.start()
    try:
        assert server.wait_ready(30.0)
        with session_to(endpoint) as client:
            yield Service(endpoint=endpoint, server=server, client=client)
    finally:
        stop.set()
        thread.join()
        router.close()
