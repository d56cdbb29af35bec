"""What a role needs to take part in a run: session, configuration, scenes.

A role on the machine that started the run is given its folder. Any other asks the
replay service's process for `config.json` and, by its hash, for the bank, which it
keeps in the user's cache for the next time. A bank of another hash is refused.
"""

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from launch.config import CONFIG, RunFile, read_run
from launch.errors import LaunchError
from replay.channels import ControlSubscriber
from replay.files import FileError, fetch_file
from replay.keys import RunKeys
from replay.session import check_endpoints, open_session
from replay.shards_directory import ShardDirectory
from replay.spec import RowSpec
from sim.bank import BankFile, open_bank

if TYPE_CHECKING:
    import zenoh

TRAIN: Final = "train.bank"
HELD_OUT: Final = "heldout.bank"
SCENES: Final = "scenes"
REPLAY: Final = "replay"  # below the run's folder: the rows of a durable replay
FETCH_S: Final = 20.0  # after which a file that nobody offers is an error


@dataclass(frozen=True, kw_only=True)
class JoinConfig:
    """How one role finds its run."""

    run_id: str
    """The run's name in its Zenoh keys; `endpoint.json` of the run folder has it."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, e.g. tcp/127.0.0.1:7447."""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on; the replay's hub, shard 0, needs one."""
    insecure: bool = False
    """Allows addresses other than loopback; nothing is encrypted."""
    run: Path | None = None
    """The run's folder, where this machine has it."""


@dataclass(frozen=True, kw_only=True)
class ShardConfig:
    """Which part of the replay a process serves."""

    shard: int = 0
    """The shard's number; 0 is the hub, to which all others and all roles connect."""
    announce: tuple[str, ...] = ()
    """Endpoints by which others reach this shard; unless given, those of --listen."""
    durable: bool = False
    """Keeps the rows in the run's folder, whatever its configuration says."""


@final
@dataclass(frozen=True, kw_only=True)
class Joined:
    """A role's place in its run."""

    session: "zenoh.Session"
    keys: RunKeys
    run: RunFile
    folder: Path  # the run's, or the cache's
    hub: tuple[str, ...]  # endpoints by which it is reached
    insecure: bool

    def directory(
        self, spec: RowSpec, *, wanted: tuple[int, ...] | None = None
    ) -> ShardDirectory:
        """The run's shards; `wanted`: those to be linked to, unless given all."""
        return ShardDirectory(
            session=self.session,
            keys=self.keys,
            spec=spec,
            hub=self.hub,
            insecure=self.insecure,
            wanted=wanted,
        )


def free_port() -> int:
    """A port of loopback that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def joined(join: JoinConfig, stop: threading.Event) -> Iterator[Joined]:
    """Connects and gets the configuration; a run that is called off sets `stop`."""
    if not join.connect:
        raise LaunchError("name the run's endpoint: --connect tcp/HOST:PORT")
    keys = RunKeys(join.run_id)
    check_endpoints((*join.connect, *join.listen), join.insecure)
    with open_session(connect=join.connect, listen=join.listen) as session:
        control = ControlSubscriber(session, keys)
        follow(control, stop)
        folder = join.run if join.run is not None else _cache() / join.run_id
        if not (folder / CONFIG).is_file():
            _fetch(session, keys, CONFIG, folder / CONFIG)
        run = read_run(folder)
        if run.run_id != join.run_id:
            raise LaunchError(
                f"{folder}: holds the run {run.run_id}, not {join.run_id}; name "
                "another folder with --run"
            )
        yield Joined(
            session=session,
            keys=keys,
            run=run,
            folder=folder,
            hub=join.connect,
            insecure=join.insecure,
        )


def _fetch(session: "zenoh.Session", keys: RunKeys, name: str, to: Path) -> None:
    """Fetches a file; a service that has only begun does not offer it yet."""
    deadline = time.monotonic() + FETCH_S
    while True:
        try:
            fetch_file(session, keys, name, to)
            return
        except FileError:
            if time.monotonic() > deadline:
                raise
            # An answer that nobody gives comes at once, and there is no event for
            # "somebody offers it now".
            time.sleep(0.2)


def follow(control: ControlSubscriber, stop: threading.Event) -> None:
    """Sets `stop` when the run is called off."""

    def wait() -> None:
        control.stop.wait()
        stop.set()

    threading.Thread(target=wait, name="control", daemon=True).start()


def train_bank(place: Joined) -> BankFile:
    """The scenes that the run trains on, from the run's folder, the cache or afar."""
    path = place.folder / SCENES / TRAIN
    if not path.is_file():
        path = _cache() / "banks" / f"{place.run.train_hash}.bank"
    if not path.is_file():
        _fetch(place.session, place.keys, TRAIN, path)
    return check_bank(open_bank(path), place.run.train_hash)


def check_bank(bank: BankFile, expected: str) -> BankFile:
    """Refuses other scenes than the run's: indices would mean other things."""
    if bank.content_hash != expected:
        raise LaunchError(
            f"{bank.path}: holds other scenes than the run (hash {bank.content_hash}, "
            f"the run's {expected}); remove it, and it is fetched"
        )
    return bank


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "slipstream"
