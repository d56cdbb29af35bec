"""The configuration of a run: the components' configurations, budget and scenes.

One frozen dataclass is the command line, `config.json` of the run folder and what the
processes of a run share. Three presets:

    quick   learns to drive on two cores in minutes: a small network, few road rows, a
            progress reward (the paper's reward is satisfied by standing still), a
            higher learning rate, averaged weights; the README lists what differs
    laptop  the same with a larger network, for 20 to 30 minutes and 2,000 scenes
    paper   appendix A.2 of the Waymax paper, else Acme's: the components' defaults,
            with a network of the paper's width

`RunFile` is what is written: the configuration with the run's id and the banks'
hashes, so that a process that joins can tell whether it has the same scenes.
"""

import dataclasses
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import msgspec

from actors.acting import Objects
from actors.actor import ActorConfig
from actors.mixture import action_limits
from actors.network import (
    NetworkConfig,
    laptop_network,
    paper_network,
    quick_network,
)
from actors.rows import row_spec
from actors.straying import StrayingConfig
from launch.budget import BudgetConfig, EvaluatorConfig, ReportConfig, ScenesConfig
from launch.errors import LaunchError
from learner.config import CloningConfig, LearnerConfig
from replay.local import ReplayConfig
from replay.spec import RowSpec
from sim.dynamics import ActionConfig, ActionSpace
from sim.environment import EnvironmentConfig
from sim.observation import ObservationConfig

CONFIG: Final = "config.json"
FORMAT: Final = 1
Algorithm = Literal["dqn", "bc"]
Cloned = Literal["sdc", "vehicles"]  # whose actions: the recording vehicle's, or of all
FILL_ROWS: Final = 1024  # of a batch by which a bank pass fills the replay
UNBOUNDED: Final = 1e9  # a limiter's tolerance that no run comes near


@dataclass(frozen=True, kw_only=True)
class ExperimentConfig:
    """Everything that a run depends on."""

    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    """Actions, observation, reward, termination."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """The policy's network."""
    actor: ActorConfig = field(default_factory=lambda: ActorConfig(environments=8))
    """One actor process."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    """The replay service."""
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    """Double DQN's updates."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """Behaviour cloning's updates."""
    straying: StrayingConfig = field(default_factory=StrayingConfig)
    """Behaviour cloning's rows off the log."""
    budget: BudgetConfig = field(default_factory=BudgetConfig)
    """When the run is over."""
    scenes: ScenesConfig = field(default_factory=ScenesConfig)
    """Procedural scenes, and how recorded ones are split."""
    report: ReportConfig = field(default_factory=ReportConfig)
    """Checkpoints, curves, recording."""
    evaluator: EvaluatorConfig = field(default_factory=EvaluatorConfig)
    """Which checkpoints are driven on held-out scenes while the run goes on."""
    actors: int = 2
    """Actor processes."""
    shards: int = 1
    """Replay services; the replay's capacity and min_size are of all together."""
    seed: int = 0
    """Of everything random but the scenes: weights, exploration, draws."""

    def __post_init__(self) -> None:
        """Refuses a run without actors, and one whose two sides wait for each other."""
        if self.actors < 1:
            raise ValueError(f"actors={self.actors} must be at least 1")
        if not 1 <= self.shards <= min(256, self.replay.min_size):
            raise ValueError(
                f"shards={self.shards} must be 1 to {min(256, self.replay.min_size)}"
            )
        insert_rows, sample_rows = largest_batches(self)
        self.replay.part_of(self.shards).limiter().check_batches(
            insert_rows=insert_rows, sample_rows=sample_rows
        )


def quick() -> ExperimentConfig:
    """A run of minutes on two cores."""
    return ExperimentConfig(
        environment=EnvironmentConfig(
            action=ActionConfig(
                acceleration_bins=5,
                curvature=0.15,
                curvature_bins=7,
                sideways_bins=1,
                turn=0.1,
                turn_bins=9,
            ),
            observation=ObservationConfig(neighbours=8, road_rows=32, lights=2),
            progress=0.03,
            terminate=True,
        ),
        network=quick_network(),
        actor=ActorConfig(environments=16, scan_steps=8),
        replay=ReplayConfig(capacity=200_000, min_size=2_000, samples_per_insert=4.0),
        learner=LearnerConfig(
            learning_rate=5e-4,
            discount=0.98,
            target_period=300,
            average_updates=3_000,
            max_gradient_norm=10.0,
            loss="plain",
        ),
        budget=BudgetConfig(updates=40_000, minutes=4.5),
        scenes=ScenesConfig(held_out=100),
    )


def paper() -> ExperimentConfig:
    """The paper's DQN; it gives the width of 128, the other sizes are ours."""
    return ExperimentConfig(network=paper_network(), replay=ReplayConfig(durable=True))


def laptop() -> ExperimentConfig:
    """Double DQN in half an hour on two cores, on 2,000 scenes."""
    config = quick()
    return dataclasses.replace(
        config,
        network=laptop_network(),
        # The learner is what is slow: more is driven for each of its updates.
        replay=dataclasses.replace(
            config.replay, capacity=500_000, samples_per_insert=2.0
        ),
        learner=dataclasses.replace(config.learner, learning_rate=3e-4),
        budget=BudgetConfig(updates=1_000_000, minutes=30.0),
        scenes=ScenesConfig(train=2000, held_out=200),
    )


PRESETS: Final = {"quick": quick, "laptop": laptop, "paper": paper}


def quick_cloning() -> ExperimentConfig:
    """Cloning in minutes on two cores: the preset quick's scenes, view and network.

    Its grids are finer: nothing is tried out, and what a coarse one rounds away, such
    as half of a gentle braking, is lost in every step.
    """
    config = quick()
    action = dataclasses.replace(
        config.environment.action,
        acceleration_bins=13,
        curvature_bins=13,
        forward_bins=31,
    )
    return dataclasses.replace(
        config,
        environment=dataclasses.replace(config.environment, action=action),
        cloning=CloningConfig(
            learning_rate=1e-3,
            batch_size=128,
            max_gradient_norm=5.0,
            average_updates=1000,
            torch_threads=2,  # no actors beside it
        ),
        straying=StrayingConfig(share=0.5),
    )


def laptop_cloning() -> ExperimentConfig:
    """Cloning in 20 minutes on two cores, on 2,000 scenes."""
    return dataclasses.replace(
        quick_cloning(),
        network=laptop_network(),
        cloning=CloningConfig(
            learning_rate=5e-4,
            max_gradient_norm=5.0,
            average_updates=2000,
            torch_threads=2,
        ),
        budget=BudgetConfig(updates=1_000_000, minutes=20.0),
        scenes=ScenesConfig(train=2000, held_out=200),
    )


def paper_cloning() -> ExperimentConfig:
    """The paper's cloning; it does not say for how long."""
    return dataclasses.replace(
        paper(), budget=BudgetConfig(updates=1_000_000), cloning=CloningConfig()
    )


CLONING_PRESETS: Final = {
    "quick": quick_cloning,
    "laptop": laptop_cloning,
    "paper": paper_cloning,
}


@dataclass(frozen=True, kw_only=True)
class RunFile:
    """`config.json`: what the processes of a run share."""

    run_id: str
    config: ExperimentConfig
    train_hash: str  # of the bank's content, SHA-256
    held_out_hash: str
    scenes: tuple[str, ...]  # as given on the command line
    algorithm: Algorithm = "dqn"
    objects: Cloned = "vehicles"
    format: int = FORMAT

    @property
    def mixture(self) -> int:
        """Components of the policy's mixture; 0: an output for each of the actions."""
        return self.config.cloning.mixture if self.algorithm == "bc" else 0

    def write(self, folder: Path) -> None:
        """Writes the run folder's file; whole or not at all."""
        data = msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"
        write_atomically(folder / CONFIG, data)


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces a file by a rename: a reader sees the old content or the new."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_run(path: Path) -> RunFile:
    """Reads a run folder's configuration, or the file itself."""
    file = path / CONFIG if path.is_dir() else path
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        raise LaunchError(f"{path}: no run here ({CONFIG} is missing)") from None
    return decode_run(data, where=str(file))


def decode_run(data: bytes, *, where: str) -> RunFile:
    """Parses and checks a run's configuration, from a file or the network."""
    try:
        content = msgspec.json.decode(data)
        run = msgspec.convert(content, RunFile)
    except (msgspec.DecodeError, ValueError) as error:
        raise LaunchError(
            f"{where}: not a run's configuration ({error}); use a run made by this "
            "version"
        ) from error
    # What is unknown was meant to say something: it is not passed over.
    unknown = _unknown(content, json.loads(msgspec.json.encode(run)), "")
    if unknown or run.format != FORMAT:
        raise LaunchError(
            f"{where}: format {run.format}, this version reads {FORMAT}"
            + (f"; unknown {unknown[0]}" if unknown else "")
            + "; use the version that wrote it"
        )
    return run


def _unknown(content: Any, known: Any, at: str) -> list[str]:  # noqa: ANN401 - JSON
    """Keys of `content` that `known` has not, as dotted paths."""
    if not (isinstance(content, dict) and isinstance(known, dict)):
        return []
    found = [f"{at}{name}" for name in content if name not in known]
    for name in content.keys() & known.keys():
        found += _unknown(content[name], known[name], f"{at}{name}.")
    return found


def with_space(config: ExperimentConfig, space: str) -> ExperimentConfig:
    """The same run in one of the paper's action spaces: bicycle, delta-discrete, ..."""
    name = space.removesuffix("-discrete")
    action = dataclasses.replace(
        config.environment.action, space=ActionSpace(f"{name}-discrete")
    )
    mixture = 0 if name != space else config.cloning.mixture or CloningConfig().mixture
    return dataclasses.replace(
        config,
        environment=dataclasses.replace(config.environment, action=action),
        cloning=dataclasses.replace(config.cloning, mixture=mixture),
    )


def with_environments(config: ExperimentConfig, count: int) -> ExperimentConfig:
    """The same run with another number of environments per actor."""
    watched = min(config.actor.watched, count)
    actor = dataclasses.replace(config.actor, environments=count, watched=watched)
    return dataclasses.replace(config, actor=actor)


def with_objects(config: ExperimentConfig, objects: Objects) -> ExperimentConfig:
    """The same run with other objects of each scene controlled."""
    actor = dataclasses.replace(config.actor, objects=objects)
    return dataclasses.replace(config, actor=actor)


def with_durable_replay(config: ExperimentConfig) -> ExperimentConfig:
    """The same run with its replay kept in files."""
    replay = dataclasses.replace(config.replay, durable=True)
    return dataclasses.replace(config, replay=replay)


def rows_of_run(config: ExperimentConfig) -> RowSpec:
    """The layout of the run's transitions."""
    actor = config.actor
    return row_spec(
        config.environment.observation.history,
        n_step=config.learner.n_step,
        others=0 if actor.objects == "sdc" else actor.slots - 1,
    )


def with_filled_replay(config: ExperimentConfig, rows: int) -> ExperimentConfig:
    """The same run with a replay that is filled once with so many rows.

    Nothing is sampled before they are all there, and then without bound, uniformly.
    Rows beyond them push the oldest out: a bank pass that is made again from its
    beginning leaves each row once.
    """
    replay = dataclasses.replace(
        config.replay,
        capacity=rows,
        min_size=rows,
        samples_per_insert=1.0,
        tolerance=UNBOUNDED,
        sampler="uniform",
        max_times_sampled=0,
    )
    return dataclasses.replace(config, replay=replay)


def row_spec_of(run: RunFile) -> RowSpec:
    """The rows of a run's replay; those of an expert have its continuous actions."""
    if run.algorithm == "dqn":
        return rows_of_run(run.config)
    environment = run.config.environment
    components = len(action_limits(environment.action))
    return row_spec(environment.observation.history, components)


def batches_of(run: RunFile) -> tuple[int, int]:
    """Rows of the largest batches that a run inserts and samples."""
    if run.algorithm == "bc":
        reply = run.config.learner.batches_per_reply
        return FILL_ROWS, run.config.cloning.batch_size * reply
    return largest_batches(run.config)


def largest_batches(config: ExperimentConfig) -> tuple[int, int]:
    """Rows of the largest batch that an actor inserts, and that the learner samples."""
    inserted = config.actor.environments * config.actor.scan_steps
    return inserted, config.learner.batch_size * config.learner.batches_per_reply
