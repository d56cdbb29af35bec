"""What an evaluation found: every scene's row, and figures with 95% intervals.

Rates are shares of the scenes in which something happened at some step, with Wilson's
score interval (Wilson, J. Am. Stat. Assoc. 22, 1927), which holds for few scenes and
for rates of 0. Where several objects of a scene are judged there are shares of objects
too. All other intervals are percentiles of `RESAMPLES` bootstrap resamples of the
scenes (Efron, 1979), from a fixed seed; objects of one scene stay together.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

RESAMPLES: Final = 2000
LEVEL_95: Final = 1.959964  # standard deviations
RATES: Final = ("failure", "overlap", "offroad", "wrong_way", "off_route")


@dataclass(frozen=True)
class SceneResult:
    """One scene's row of an evaluation."""

    id: str
    objects: int  # judged objects with at least one counted step
    valid: int  # (object, step) pairs that count
    overlap: int  # of them with an overlap
    offroad: int
    kinematic_infeasibility: int
    wrong_way: int
    off_route: int
    failed: bool  # any overlap or off-road
    failure_objects: int  # objects with an overlap or off-road at some step
    overlap_objects: int
    offroad_objects: int
    wrong_way_objects: int
    off_route_objects: int
    log_displacement: float  # m, mean over the pairs
    progress: float | None  # of the logged route: mean over objects that have one
    progression: float | None  # of the lane path: mean over objects that have one


class Figure(NamedTuple):
    """A figure and its 95% interval; NaN where there is none."""

    value: float
    low: float
    high: float


NONE: Final = Figure(np.nan, np.nan, np.nan)


def wilson(hits: int, count: int) -> Figure:
    """A rate with its score interval."""
    if not count:
        return NONE
    rate, z2 = hits / count, LEVEL_95**2
    middle = (rate + z2 / (2 * count)) / (1 + z2 / count)
    spread = rate * (1 - rate) / count + z2 / (4 * count**2)
    half = LEVEL_95 * spread**0.5 / (1 + z2 / count)
    return Figure(rate, max(middle - half, 0.0), min(middle + half, 1.0))


def bootstrap(
    parts: Float[np.ndarray, " scenes"], weights: Float[np.ndarray, " scenes"]
) -> Figure:
    """The ratio of two sums over scenes, resampled; no interval for a single scene."""
    if not weights.sum() > 0:
        return NONE
    value = float(parts.sum() / weights.sum())
    if len(parts) < 2:
        return Figure(value, np.nan, np.nan)
    drawn = np.random.default_rng(0).integers(len(parts), size=(RESAMPLES, len(parts)))
    sums, masses = parts[drawn].sum(1), weights[drawn].sum(1)
    ratios = sums[masses > 0] / masses[masses > 0]
    low, high = np.quantile(ratios, (0.025, 0.975))
    return Figure(value, float(low), float(high))


def figures_of(scenes: list[SceneResult]) -> dict[str, Figure]:
    """All figures by name, over the scenes that have an object to judge."""
    judged = [scene for scene in scenes if scene.objects]
    found = {f"{name}_rate": _rate(judged, f"{name}_objects") for name in RATES}
    if any(scene.objects > 1 for scene in judged):
        found |= {
            f"object_{name}_rate": _share(judged, f"{name}_objects", "objects")
            for name in RATES
        }
    return found | {
        "progress": _mean(judged, lambda scene: scene.progress),
        "progression": _mean(judged, lambda scene: scene.progression),
        "log_displacement": _mean(judged, lambda scene: scene.log_displacement),
        "kinematic_infeasibility": _share(judged, "kinematic_infeasibility", "valid"),
    }


def _rate(scenes: list[SceneResult], name: str) -> Figure:
    """The share of scenes in which an object did so."""
    return wilson(sum(getattr(scene, name) > 0 for scene in scenes), len(scenes))


def _share(scenes: list[SceneResult], name: str, of: str) -> Figure:
    parts = np.array([getattr(scene, name) for scene in scenes], np.float64)
    return bootstrap(
        parts, np.array([getattr(scene, of) for scene in scenes], np.float64)
    )


def _mean(
    scenes: list[SceneResult], get: Callable[[SceneResult], float | None]
) -> Figure:
    values = [value for scene in scenes if (value := get(scene)) is not None]
    return bootstrap(np.array(values, np.float64), np.ones(len(values)))
