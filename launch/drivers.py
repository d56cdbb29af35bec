"""The agents that `slipstream evaluate` knows by name, and those of runs."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec

from actors.policy import policy_agent, read_policy
from launch.config import ExperimentConfig
from launch.errors import LaunchError
from sim.agents import (
    Agent,
    ExpertSpace,
    constant_speed,
    expert,
    log_playback,
    random_actions,
)
from sim.bank import BankFile
from sim.dynamics import ActionSpace
from sim.environment import EnvironmentConfig
from sim.idm import idm

PLAYBACK: Final = "log"
EXPERTS: Final = {
    "expert": ExpertSpace(ActionSpace.BICYCLE, on_grid=False),
    "expert-delta": ExpertSpace(ActionSpace.DELTA, on_grid=False),
    "expert-bicycle-discrete": ExpertSpace(ActionSpace.BICYCLE, on_grid=True),
    "expert-delta-discrete": ExpertSpace(ActionSpace.DELTA, on_grid=True),
    "expert-steering": ExpertSpace(ActionSpace.STEERING, on_grid=False),
}
NAMES: Final = (PLAYBACK, *EXPERTS, "idm", "constant-speed", "random")


def built_in(name: str, environment: EnvironmentConfig) -> Agent:
    """An agent that needs no learning."""
    if name == PLAYBACK:
        return log_playback()
    if name in EXPERTS:
        return expert(environment, EXPERTS[name])
    if name == "idm":
        return idm(environment)
    if name == "constant-speed":
        return constant_speed(environment)
    return random_actions(environment)


@dataclass(frozen=True)
class Driver:
    """An agent with the environment that it knows."""

    name: str
    build: Callable[[int | None], Agent]  # for the first so many slots; None: for all
    environment: EnvironmentConfig


def driver_of(name: str) -> Driver:
    """What `--agent` names."""
    if name in NAMES:
        environment = EnvironmentConfig()
        agent = built_in(name, environment)
        return Driver(name, lambda slots: agent, environment)
    path = Path(name)
    if not path.exists():
        raise LaunchError(
            f"--agent {name}: unknown; one of {', '.join(NAMES)}, or the path of a run "
            "or a checkpoint"
        )
    policy = read_policy(path)
    try:
        config = msgspec.convert(policy.extra["config"], ExperimentConfig)
    except (KeyError, ValueError) as error:
        raise LaunchError(
            f"{path}: the checkpoint lacks its run's configuration ({error}); use one "
            "that `slipstream train` wrote"
        ) from error
    environment = config.environment
    policy.check(environment, path)

    def build(slots: int | None) -> Agent:
        return policy_agent(policy, environment, slots=slots)

    return Driver(str(path), build, environment)


def check_step(bank: BankFile, environment: EnvironmentConfig) -> None:
    """Refuses scenes of another step length than the agent was made for."""
    if abs(bank.dt - environment.dt) > 1e-6:
        raise LaunchError(
            f"{bank.path}: steps of {bank.dt} s, the agent's are {environment.dt} s; "
            "use scenes recorded at that rate"
        )
