"""The replay's roles: shard 0, which is the run's hub, and any other shard.

The hub is the router that every role connects to; it serves the run's files besides. A
shard listens on endpoints of its own and is a client of the hub. One that is started
while a run is in progress joins it: the learner draws from it, actors write to it.
"""

import contextlib
import dataclasses
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from launch.config import (
    CONFIG,
    ExperimentConfig,
    batches_of,
    read_run,
    row_spec_of,
)
from launch.errors import LaunchError
from launch.join import (
    HELD_OUT,
    REPLAY,
    SCENES,
    TRAIN,
    JoinConfig,
    ShardConfig,
    follow,
    free_port,
    joined,
)
from replay.local import ReplayConfig

if TYPE_CHECKING:
    import zenoh

    from replay.server import ReplayServer
    from replay.shards import ShardClaim
    from replay.spec import RowSpec


def replay_role(join: JoinConfig, options: ShardConfig, stop: threading.Event) -> None:
    """Serves a shard until asked to stop."""
    from replay.shards import MAX_SHARDS

    if not 0 <= options.shard < MAX_SHARDS:
        raise LaunchError(f"--shard {options.shard}: 0 to {MAX_SHARDS - 1}")
    if options.shard:
        _serve_shard(join, options, stop)
    else:
        _serve_hub(join, options, stop)


def _serve_hub(join: JoinConfig, options: ShardConfig, stop: threading.Event) -> None:
    """Shard 0, and the run's files for those who have none of it."""
    if not join.listen:
        raise LaunchError("the replay service needs --listen tcp/HOST:PORT")
    if join.run is None:
        raise LaunchError("the replay service serves a run's folder: name it by --run")
    from replay.channels import ControlSubscriber
    from replay.files import FileServer
    from replay.keys import RunKeys
    from replay.session import check_endpoints, open_session
    from replay.shards import ShardClaim

    check_endpoints((*join.listen, *join.connect), join.insecure)
    run = read_run(join.run)
    keys = RunKeys(join.run_id)
    # The port answers before torch is loaded: the other roles start meanwhile.
    with open_session(connect=join.connect, listen=join.listen, router=True) as session:
        control = ControlSubscriber(session, keys)
        follow(control, stop)
        scenes = join.run / SCENES
        files = {name: scenes / name for name in (TRAIN, HELD_OUT)}
        files[CONFIG] = join.run / CONFIG
        offered = FileServer(session=session, keys=keys, files=files)
        claim = ShardClaim(session, keys)
        from replay.server import ReplayServer

        spec = row_spec_of(run)
        server = ReplayServer(
            session=session,
            keys=keys,
            spec=spec,
            config=_settings(run.config, options),
            seed=run.config.seed,
            folder=join.run / REPLAY / str(keys.shard),
            largest=batches_of(run),
        )
        with _Announcing(server, claim, session, spec, ()).until_end():
            server.run(stop)
        offered.close()
        control.close()


def _serve_shard(join: JoinConfig, options: ShardConfig, stop: threading.Event) -> None:
    """A shard beside the hub."""
    from replay.keys import RunKeys
    from replay.server import ReplayServer
    from replay.session import check_endpoints, is_loopback, open_session
    from replay.shards import ShardClaim

    if not join.listen and not all(map(is_loopback, join.connect)):
        raise LaunchError(
            f"shard {options.shard}: name an endpoint that the other machines reach by "
            "--listen tcp/HOST:PORT"
        )
    listen = join.listen or (f"tcp/127.0.0.1:{free_port()}",)
    announced = options.announce or listen
    check_endpoints((*listen, *announced), join.insecure)
    keys = RunKeys(join.run_id, options.shard)
    with joined(dataclasses.replace(join, listen=()), stop) as place:
        config = place.run.config
        claim = ShardClaim(place.session, keys)
        with open_session(listen=listen, router=True) as local:
            spec = row_spec_of(place.run)
            server = ReplayServer(
                session=local,
                keys=keys,
                spec=spec,
                config=_settings(config, options),
                seed=config.seed + options.shard,
                folder=place.folder / REPLAY / str(keys.shard),
                largest=batches_of(place.run),
                hub=place.session,
            )
            with _Announcing(server, claim, local, spec, announced).until_end():
                server.run(stop)


def _settings(config: ExperimentConfig, options: ShardConfig) -> ReplayConfig:
    replay = config.replay.part_of(config.shards, options.shard)
    return dataclasses.replace(replay, durable=True) if options.durable else replay


@final
@dataclass(frozen=True, eq=False)
class _Announcing:
    """A shard is announced once it serves, and no longer than it does."""

    server: "ReplayServer"
    claim: "ShardClaim"
    local: "zenoh.Session"
    spec: "RowSpec"
    endpoints: tuple[str, ...]

    @contextlib.contextmanager
    def until_end(self) -> Iterator[None]:
        """Waits on a thread, as serving takes this one."""
        ended = threading.Event()

        def wait() -> None:
            while not ended.is_set():
                if self.server.wait_ready(0.2):
                    self.claim.announce(self.local, self.spec, self.endpoints)
                    return

        thread = threading.Thread(target=wait, name="announce")
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            self.claim.close()
