"""What the tests of shards share: shards in threads, a directory, a stock of rows."""

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import zenoh

from replay.client import Writer
from replay.keys import RunKeys
from replay.local import ReplayConfig
from replay.server import ReplayServer
from replay.session import open_session
from replay.shards import ShardClaim
from replay.shards_directory import ShardDirectory
from replay.spec import RowSpec
from tests.replay_parts import KEYS, SPEC, eventually, free_endpoint, make_rows

# Uniform: no torch to load. Draws without end from 100 rows on.
ENDLESS = ReplayConfig(
    capacity=1 << 14,
    min_size=100,
    samples_per_insert=1e6,
    tolerance=1e3,
    sampler="uniform",
)


class Shard:
    """A shard in a thread of this process, over real TCP links."""

    def __init__(
        self,
        number: int,
        config: ReplayConfig,
        *,
        hub: "Shard | str | None" = None,
        endpoint: str = "",
        folder: Path | None = None,
        spec: RowSpec = SPEC,
    ) -> None:
        """Serves and is announced when this returns; without a hub it is the hub."""
        self.endpoint = endpoint or free_endpoint()
        self.keys = RunKeys(KEYS.run_id, number)
        self.router = open_session(listen=[self.endpoint], router=True)
        reached = hub.endpoint if isinstance(hub, Shard) else hub
        self.hub = open_session(connect=[reached]) if reached else self.router
        self.claim = ShardClaim(self.hub, self.keys)
        self.server = ReplayServer(
            session=self.router,
            keys=self.keys,
            spec=spec,
            config=config,
            seed=number,
            folder=folder,
            hub=self.hub if hub else None,
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.server.run, args=(self._stop,))
        self._thread.start()
        assert self.server.wait_ready(30.0)
        endpoints = (self.endpoint,) if hub else ()
        self.claim.announce(self.router, spec, endpoints)

    def close(self) -> None:
        """Ends it; harmless when it has ended."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._thread.join()
        self.claim.close()
        if self.hub is not self.router:
            self.hub.close()  # type: ignore[no-untyped-call]
        self.router.close()  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def shards_of(config: ReplayConfig, count: int) -> Iterator[list[Shard]]:
    """A hub and the shards beside it; those appended to the list are ended too."""
    shards: list[Shard] = []
    try:
        for number in range(count):
            hub = shards[0] if shards else None
            shards.append(Shard(number, config, hub=hub))
        yield shards
    finally:
        for shard in reversed(shards):
            shard.close()


@contextlib.contextmanager
def directory_of(
    hub: Shard, *, count: int | None = None, wanted: tuple[int, ...] | None = None
) -> Iterator[ShardDirectory]:
    """A client of its own; waits until it is linked to `count` shards."""
    session: zenoh.Session = open_session(connect=[hub.endpoint])
    directory = ShardDirectory(
        session=session, keys=KEYS, spec=SPEC, hub=[hub.endpoint], wanted=wanted
    )
    try:
        assert count is None or eventually(lambda: len(directory.links) == count)
        yield directory
    finally:
        directory.close()
        session.close()  # type: ignore[no-untyped-call]


def fill(directory: ShardDirectory, rows: dict[int, int]) -> None:
    """Writes so many rows to each shard, numbered from 10,000 x shard."""
    for link in directory.links:
        if not rows.get(link.shard):
            continue
        writer = Writer(
            session=link.session,
            keys=link.keys,
            spec=SPEC,
            writer=link.shard,
            epoch=1,
            batch_rows=50,
        )
        writer.append(make_rows(10_000 * link.shard, rows[link.shard]))
        assert writer.close(20.0)


def shard_of(ids: np.ndarray) -> np.ndarray:
    """The shards' numbers of ids of the run."""
    return (ids >> np.uint64(48)).astype(int)
