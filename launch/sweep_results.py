"""What a sweep's runs found, read from their folders.

A run's evaluation is of the checkpoint that the first held-out scenes chose; `others`
is the same checkpoint on the scenes that did not. Where scenes are held out in turn,
the runs of all turns are one result: each scene's figures are by the run that never saw
it.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from actors.evaluation import Evaluation
from actors.results import SceneResult
from launch.errors import LaunchError
from launch.sweep_ledger import Point
from launch.tables import summary
from learner.curves import read_curves

Summary = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Finished:
    """A run that has ended."""

    point: Point
    trained: Summary  # figures over all held-out scenes
    others: Summary | None  # over those that did not choose the checkpoint
    scenes: list[SceneResult]
    updates: int
    minutes: float  # since the first update, by the clock


def read_evaluation(run: Path) -> dict[str, Any] | None:
    """A finished run's evaluation.json; None: it has not finished."""
    path = run / "evaluation.json"
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        names = [agent["agent"] for agent in content["agents"]]
        content["trained"] = content["agents"][names.index("trained")]
        return content
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise LaunchError(
            f"{path}: not a run's evaluation; remove it, and the run is evaluated again"
        ) from error


def read_finished(point: Point, run: Path) -> Finished | None:
    """A point's run; None: it has not finished."""
    content = read_evaluation(run)
    if content is None:
        return None
    curves = read_curves(run / "curves.csv")
    ended = len(curves["updates"]) > 0
    return Finished(
        point=point,
        trained=content["trained"],
        others=content.get("on_others"),
        scenes=msgspec.convert(content["scenes"]["trained"], list[SceneResult]),
        updates=int(curves["updates"][-1]) if ended else 0,
        minutes=float(curves["seconds"][-1]) / 60 if ended else 0.0,
    )


def results_of(
    points: Sequence[Point], finished: Sequence[Finished]
) -> dict[Point, Summary]:
    """Each point's figures; of those held out in turn, if no turn is missing."""
    groups: dict[Point, list[Point]] = {}
    for point in points:
        groups.setdefault(replace(point, held_out=-1), []).append(point)
    found = {one.point: one for one in finished}
    results: dict[Point, Summary] = {}
    for whole, turns in groups.items():
        runs = [found[turn] for turn in turns if turn in found]
        if len(runs) < len(turns):
            continue
        if turns == [whole]:
            results[whole] = runs[0].trained
        else:
            scenes = [scene for run in runs for scene in run.scenes]
            results[whole] = summary(Evaluation("trained", scenes, None))
    return results
