"""`slipstream train dqn`: from scenes to an agent, its scores and a recording.

    RUN/config.json          the resolved configuration      scenes/*.bank
        logs/ROLE.log        what each process printed       curves.csv, .png
        tensorboard/         the same curves                 checkpoints/
        evaluation.csv       how checkpoints drove           best/  of them
        evaluation.json .md .png .rrd   scores and a recording    status.json

One replay service (critical unless it is durable) or several shards, a learner that
ends the run and is started again from its newest checkpoint, and actors that are
started again are processes of their own, connected over Zenoh on loopback. With
`serial` they take turns in this process.
"""

import asyncio
import contextlib
import dataclasses
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import tyro
from rich.console import Console

from actors.acting import Objects
from launch.config import (
    CONFIG,
    Algorithm,
    Cloned,
    ExperimentConfig,
    RunFile,
    quick,
    read_run,
    with_durable_replay,
    with_environments,
    with_objects,
)
from launch.converting import say
from launch.errors import INTERRUPTED, LaunchError
from launch.join import HELD_OUT, SCENES, TRAIN, check_bank, free_port
from launch.placement import Placement, joining_lines, placement_of, roles_of
from launch.scenes import PROCEDURAL, prepare_banks
from launch.supervisor import Outcome, Result, Supervisor
from sim.bank import open_bank

LOGS: Final = "logs"


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Trains double DQN with actors, replay and learner on this machine."""

    preset: Literal["quick", "laptop", "paper"] = "quick"
    """The settings that all others start from."""
    scenes: tuple[str, ...] = (PROCEDURAL,)
    """Files or folders of recorded scenes, one or two banks, or `procedural`."""
    run: Path | None = None
    """The run's folder; runs/dqn-PRESET-TIME unless given."""
    resume: bool = False
    """Goes on with an existing run, from its newest checkpoint."""
    envs: int | None = None
    """Environments per actor; the same as --actor.environments."""
    objects: Objects | None = None
    """Whom an environment controls and the policy learns from; the same as
    --actor.objects."""
    serial: bool = False
    """Runs all roles in this process, in a fixed order: same seed, same losses."""
    durable: bool = False
    """Keeps the replay in the run's folder: killed or resumed, it loses no row that was
    stored; the same as --replay.durable."""
    view: bool = False
    """Shows the run live in the browser."""
    listen: tuple[str, ...] = ()
    """Further endpoints at which roles on other machines find the run, e.g.
    tcp/0.0.0.0:7447."""
    remote_actors: int = 0
    """Of the actors, the last ones run elsewhere: they are not started here."""
    insecure: bool = False
    """Allows --listen on addresses other than loopback; nothing is encrypted."""
    config: Annotated[ExperimentConfig, tyro.conf.arg(name="")] = field(
        default_factory=quick
    )
    """Everything else."""


def folder_of(options: TrainConfig) -> Path:
    """Where the run is written."""
    if options.run is not None:
        return options.run
    return Path("runs") / f"dqn-{options.preset}-{time.strftime('%Y%m%d-%H%M%S')}"


def resolved(options: TrainConfig) -> ExperimentConfig:
    """The configuration with the command's short options in it."""
    config = options.config
    if options.durable:
        config = with_durable_replay(config)
    if options.objects is not None:
        config = with_objects(config, options.objects)
    if options.envs is None:
        return config
    return with_environments(config, options.envs)


def prepare(
    options: TrainConfig,
    *,
    algorithm: Algorithm = "dqn",
    objects: Cloned = "vehicles",
) -> tuple[Path, RunFile]:
    """Makes the run folder with scenes and configuration, or takes up an old one."""
    folder = folder_of(options)
    if (folder / CONFIG).exists():
        if not options.resume:
            raise LaunchError(
                f"{folder}: this run exists; go on with it by --resume, or choose "
                "another folder"
            )
        return folder, _taken_up(folder, options, algorithm)
    if options.resume:
        raise LaunchError(f"{folder}: no run to resume ({CONFIG} is missing)")
    # Scenes alone are of a start that was killed before it wrote its configuration.
    if folder.exists() and any(path.name != SCENES for path in folder.iterdir()):
        raise LaunchError(
            f"{folder}: this folder exists and is not empty; choose another"
        )
    config = resolved(options)
    (folder / SCENES).mkdir(parents=True, exist_ok=True)
    try:
        train, held_out = prepare_banks(
            folder / SCENES / TRAIN,
            folder / SCENES / HELD_OUT,
            sources=options.scenes,
            config=config.scenes,
        )
    except BaseException:
        with contextlib.suppress(OSError):  # unless there is something in them
            (folder / SCENES).rmdir()
            folder.rmdir()
        raise
    if abs(train.dt - config.environment.dt) > 1e-6:
        raise LaunchError(
            f"{options.scenes[0]}: recorded in steps of {train.dt} s, the environment "
            f"has {config.environment.dt}; set --environment.dt"
        )
    run = RunFile(
        run_id=f"run-{uuid.uuid4().hex[:12]}",
        config=config,
        train_hash=train.content_hash,
        held_out_hash=held_out.content_hash,
        scenes=options.scenes,
        algorithm=algorithm,
        objects=objects,
    )
    run.write(folder)
    return folder, run


def _taken_up(folder: Path, options: TrainConfig, algorithm: Algorithm) -> RunFile:
    """An existing run, with the settings given now, which may lengthen its budget."""
    run = read_run(folder)
    if run.algorithm != algorithm:
        raise LaunchError(
            f"{folder}: a run of train {run.algorithm}; go on with it by slipstream "
            f"train {run.algorithm} --resume --run {folder}"
        )
    for name, expected in ((TRAIN, run.train_hash), (HELD_OUT, run.held_out_hash)):
        check_bank(open_bank(folder / SCENES / name), expected)
    config = resolved(options)
    if run.config.replay.durable:  # its rows are there to go on with
        config = with_durable_replay(config)
        if config.shards not in (1, run.config.shards):
            raise LaunchError(
                f"{folder}: its rows lie in {run.config.shards} shards and cannot be "
                f"dealt out to {config.shards}; resume with --shards "
                f"{run.config.shards}"
            )
        config = dataclasses.replace(config, shards=run.config.shards)
    run = dataclasses.replace(run, config=config)
    run.write(folder)
    return run


@contextlib.contextmanager
def announced(folder: Path, run: RunFile, endpoint: str) -> Iterator[None]:
    """While the run is in progress, its folder says where it can be joined."""
    try:
        from launch.view import ENDPOINT, Endpoint
    except ImportError:  # without the viewer's packages nobody reads it here
        yield
        return
    Endpoint(run.run_id, (endpoint,)).write(folder)
    try:
        yield
    finally:
        (folder / ENDPOINT).unlink(missing_ok=True)


async def _tell_page(log: Path, console: Console) -> None:
    """Passes on where the viewer says that it can be opened."""
    while True:
        lines = log.read_text().splitlines() if log.exists() else []
        for line in lines:
            if line.startswith("open "):
                console.print(line, highlight=False, soft_wrap=True)
                return
        await asyncio.sleep(0.5)


async def supervise(
    folder: Path,
    run: RunFile,
    *,
    placement: Placement | None = None,
    on_look: Callable[[Mapping[str, Any]], None] = lambda figures: None,
) -> Result:
    """Runs the processes of a run to its end, with the console beside them.

    `on_look` gets the console's figures about once a second.
    """
    from launch.console import RunConsole
    from replay.keys import RunKeys

    placement = placement or Placement()
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    console = Console()
    supervisor = Supervisor(
        roles=roles_of(folder, run, port, placement),
        log_folder=folder / LOGS,
        on_event=lambda line: console.print(line, highlight=False),
        before_stop=lambda: shown.last_look(),
    )
    shown = RunConsole(
        config=run.config,
        keys=RunKeys(run.run_id),
        endpoint=endpoint,
        folder=folder,
        supervisor=supervisor,
        console=console,
        on_look=on_look,
    )
    with announced(folder, run, endpoint):
        beside = [asyncio.create_task(shown.follow())]
        if placement.view:
            log = folder / LOGS / "viewer.log"
            beside.append(asyncio.create_task(_tell_page(log, console)))
        try:
            result = await supervisor.run()
        finally:
            for task in beside:
                task.cancel()
            await asyncio.gather(*beside, return_exceptions=True)
        shown.write(result.outcome.value, result.reason)
    return result


def train_command(options: TrainConfig) -> int:
    """`slipstream train dqn`; the exit code."""
    placement = placement_of(options, resolved(options).actors)
    if options.serial and resolved(options).shards > 1:
        raise LaunchError("--serial runs one table in this process: leave out --shards")
    folder, run = prepare(options)
    say(f"run: {folder}  ({', '.join(run.scenes)}, preset {options.preset})")
    if options.serial:
        from launch.serial import run_serial

        run_serial(folder, run)
    else:
        for line in joining_lines(run, placement):
            say(line)
        if not supervised(folder, run, placement):
            return INTERRUPTED
    finish(folder, run)
    return 0


def supervised(folder: Path, run: RunFile, placement: Placement) -> bool:
    """Runs the processes; False if a person ended the run before its end."""
    result = asyncio.run(supervise(folder, run, placement=placement))
    if result.outcome is Outcome.INTERRUPTED:
        say(
            f"interrupted; go on with: slipstream train {run.algorithm} --resume "
            f"--run {folder}"
        )
        return False
    if result.outcome is Outcome.FAILED:
        raise LaunchError(result.reason)
    return True


def finish(folder: Path, run: RunFile) -> None:
    """Draws the curves, scores the agent on the held-out scenes and records it."""
    from launch.evaluate import record, report
    from launch.evaluator import CURVE, CheckpointJudge
    from learner.curves import plot_curves

    judge = CheckpointJudge(folder, run)
    if run.config.evaluator.scenes:
        judge.look()  # the last checkpoint, which the evaluator may not have come to
    judge.close()
    curves = [folder / "curves.csv", folder / CURVE]
    plot_curves(curves, folder / "curves.png", title=str(folder))
    results = report(folder, run, judge.judge, judge.bank)
    print(f"curves: {folder / 'curves.png'}")
    recording, most = folder / "evaluation.rrd", run.config.report.rollouts
    action = run.config.environment.action
    if record(recording, action, judge.bank, results[0], most=most):
        print(f"recording: {recording}  (slipstream view {folder})")
