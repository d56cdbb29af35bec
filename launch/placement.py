"""Which processes of a run are started on this machine, and how others reach them."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from launch.config import RunFile
from launch.errors import LaunchError
from launch.join import free_port
from launch.supervisor import Role

if TYPE_CHECKING:
    from launch.train import TrainConfig


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Which processes are started here, and where others find them."""

    view: bool = False
    listen: tuple[str, ...] = ()
    remote_actors: int = 0
    insecure: bool = False


def placement_of(options: "TrainConfig", actors: int) -> Placement:
    """The command's, checked; `actors` is how many the run has in all."""
    from replay.session import check_endpoints

    check_endpoints(options.listen, options.insecure)
    if not 0 <= options.remote_actors <= actors:
        raise LaunchError(
            f"--remote-actors {options.remote_actors}: the run has {actors} actors in "
            "all; set --actors"
        )
    if options.remote_actors and not options.listen:
        raise LaunchError(
            f"--remote-actors {options.remote_actors}: name the endpoint that they "
            "connect to by --listen tcp/HOST:PORT"
        )
    return Placement(
        view=options.view,
        listen=options.listen,
        remote_actors=options.remote_actors,
        insecure=options.insecure,
    )


def joining_lines(run: RunFile, placement: Placement) -> list[str]:
    """What to type on the other machines."""
    local = run.config.actors - placement.remote_actors
    insecure = " --insecure" if placement.insecure else ""
    return [
        f"actor {actor} joins from another machine by: slipstream actor --run-id "
        f"{run.run_id} --connect {placement.listen[0]}{insecure} --actor {actor}"
        for actor in range(local, run.config.actors)
    ]


def beside(listen: tuple[str, ...], shard: int) -> tuple[str, ...]:
    """Endpoints for a shard where the hub has these: ports counted on from there."""
    found = []
    for endpoint in listen:
        address, _, port = endpoint.rpartition(":")
        found.append(f"{address}:{int(port) + shard}")
    return tuple(found)


def roles_of(folder: Path, run: RunFile, port: int, placement: Placement) -> list[Role]:
    """The processes of a run that are started here."""
    endpoint = f"tcp/127.0.0.1:{port}"
    command = (sys.executable, "-m", "launch")
    common = ("--run-id", run.run_id, "--run", str(folder))
    client = (*common, "--connect", endpoint)
    roles = [
        Role(
            name="replay",
            command=(
                *(*command, "replay", *common, "--listen", endpoint),
                *placement.listen,
                *(("--insecure",) if placement.insecure else ()),
            ),
            # A durable one goes on where it was killed, an expert's is filled again,
            # and where there are others the run can do without its rows.
            critical=not run.config.replay.durable
            and run.algorithm == "dqn"
            and run.config.shards == 1,
            port=port,
        ),
        *(
            Role(
                name=f"replay-{shard}",
                command=(
                    *(*command, "replay", *client),
                    *("--listen", f"tcp/127.0.0.1:{free_port()}"),
                    *beside(placement.listen, shard),
                    *(("--insecure",) if placement.insecure else ()),
                    *("--shard", str(shard)),
                ),
            )
            for shard in range(1, run.config.shards)
        ),
        Role(
            name="learner",
            command=(*command, "learner", *client),
            finishes=True,
        ),
    ]
    actors = run.config.actors - placement.remote_actors
    if run.algorithm == "bc":
        roles.append(Role(name="filler", command=(*command, "filler", *client)))
        actors = 0
    for actor in range(actors):
        roles.append(
            Role(
                name=f"actor-{actor}",
                command=(*command, "actor", *client, "--actor", str(actor)),
            )
        )
    if run.config.evaluator.scenes:
        roles.append(Role(name="evaluator", command=(*command, "evaluator", *client)))
    if placement.view:
        roles.append(Role(name="viewer", command=(*command, "viewer", *client)))
    return roles
