"""A role as a command: its options, its signals, its exit code."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import tyro

from launch.join import JoinConfig, ShardConfig
from launch.signals import Asked
from launch.viewing import PageConfig, viewer_config

GRACE_S: Final = 8.0  # a role that was asked to end and is busy gets this long
Act = Callable[[threading.Event], None]
Parse = Callable[[Any], Any]


@dataclass(frozen=True, kw_only=True)
class ActorRoleConfig:
    """One actor of a run."""

    join: tyro.conf.OmitArgPrefixes[JoinConfig]
    """Which run."""
    actor: int = 0
    """The actor's number, from 0; each has its own."""


@dataclass(frozen=True, kw_only=True)
class ReplayRoleConfig:
    """A shard of a run's replay."""

    join: tyro.conf.OmitArgPrefixes[JoinConfig]
    """Which run."""
    part: tyro.conf.OmitArgPrefixes[ShardConfig]
    """Which shard, and how."""


@dataclass(frozen=True, kw_only=True)
class ViewerRoleConfig:
    """The live viewer of a run."""

    join: tyro.conf.OmitArgPrefixes[JoinConfig]
    """Which run."""
    page: tyro.conf.OmitArgPrefixes[PageConfig]
    """What is shown, and where."""


def run_role(name: str, parse: Parse) -> int:
    """Runs a role until it ends; the exit code is 128 plus a signal's number."""
    roles = {
        "replay": _replay,
        "actor": _actor,
        "learner": _learner,
        "filler": _filler,
        "evaluator": _evaluator,
        "viewer": _viewer,
    }
    act = roles[name](parse)
    asked = Asked()
    asked.listen(GRACE_S)
    act(asked.stop)
    return asked.exit_code


def _replay(parse: Parse) -> Act:
    options = parse(ReplayRoleConfig)
    from launch.replay_role import replay_role

    return lambda stop: replay_role(options.join, options.part, stop)


def _actor(parse: Parse) -> Act:
    options = parse(ActorRoleConfig)
    from launch.roles import actor_role

    return lambda stop: actor_role(options.join, options.actor, stop)


def _learner(parse: Parse) -> Act:
    options = parse(JoinConfig)
    from launch.learning import learner_role

    return lambda stop: learner_role(options, stop)


def _filler(parse: Parse) -> Act:
    options = parse(JoinConfig)
    from launch.cloning import filler_role

    return lambda stop: filler_role(options, stop)


def _evaluator(parse: Parse) -> Act:
    options = parse(JoinConfig)
    from launch.evaluator import evaluator_role

    return lambda stop: evaluator_role(options, stop)


def _viewer(parse: Parse) -> Act:
    options = parse(ViewerRoleConfig)
    viewer = viewer_config(options.page, options.join.insecure)
    from launch.roles import viewer_role

    return lambda stop: viewer_role(options.join, viewer, stop)
