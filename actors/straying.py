"""Expert rows of a driver who has strayed from the log, and of the way back to it.

A cloned policy's own errors lead it to where no recorded driver was, and nothing that
it learnt says how to return. The remedy is the usual one: states off the log with
actions that lead back (Bansal et al., ChauffeurNet, 2018, section 5; Laskey et al.,
DART, 2017). The Waymax paper does not have it: `share` 0, the preset `paper`'s.

At t-1 the object is put a distance d to the left of the log, turned by phi and at s
times its speed, and it came there with a yaw rate and an acceleration that the log has
not. From there it goes back, critically damped, in its travelled length l and time:

    d' = sin phi     phi' = -d / L^2 - 2 sin phi / L     ds/dt = (1 - s) / T

with L = `LENGTH` + `LOOK_AHEAD` v. One step of that gives the state at t; the action is
the inverse dynamics between the two, as it is for the log's own states. A standing
object stays where it was put. Along its route nothing is moved: when the log was where
is not observed, and so could not be learnt.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from actors.cloning import expert_actions
from sim.environment import EnvironmentConfig

LENGTH: Final = 4.0  # m, in which a slow object returns
LOOK_AHEAD: Final = 0.8  # s: at 10 m/s the lateral acceleration is 0.7 m/s^2 for 1 m
TIME: Final = 2.0  # s, in which a speed returns


@dataclass(frozen=True, kw_only=True)
class StrayingConfig:
    """How far off the log cloned drivers are put. Deviations are of normals."""

    share: float = 0.0
    """Of each batch; 0, the paper's, clones the log's own states alone."""
    sideways: float = 0.5
    """Deviation of the distance from the log's path [m]."""
    heading: float = 0.05
    """Deviation of the heading from the log's [rad]."""
    speed: float = 0.1
    """Deviation of the speed over the log's, of its logarithm."""

    def __post_init__(self) -> None:
        """Refuses shares that are none and negative deviations."""
        if not 0 <= self.share <= 1:
            raise ValueError(f"straying: share={self.share} must be within 0 and 1")
        for name in ("sideways", "heading", "speed"):
            if getattr(self, name) < 0:
                raise ValueError(
                    f"straying: {name}={getattr(self, name)} must not be negative"
                )


class Stray(NamedTuple):
    """How far off the log each row's object is at t-1, and how it came there."""

    aside: Float[np.ndarray, " rows"]  # m, to the left
    turn: Float[np.ndarray, " rows"]  # rad, counter-clockwise
    pace: Float[np.ndarray, " rows"]  # speed over the log's
    turning: Float[np.ndarray, " rows"]  # rad per step until t-1
    pickup: Float[np.ndarray, " rows"]  # of the pace, per step until t-1


def strayed(
    rows: np.ndarray,
    rng: np.random.Generator,
    config: StrayingConfig,
    environment: EnvironmentConfig,
) -> np.ndarray:
    """A batch of `expert_rows`, the first `share` of which have strayed.

    Which rows come first in a batch is chance; as many each time compile once.
    """
    count = round(config.share * len(rows))
    if not count:
        return rows
    rows = rows.copy()
    part = rows[:count]
    stray = draw_stray(count, rng, config)
    part["states"] = off_the_log(part["states"], stray, environment.dt)
    acted = expert_actions(
        np.ascontiguousarray(part["states"][:, -2]),
        np.ascontiguousarray(part["states"][:, -1]),
        environment,
    )
    part["action"], part["continuous"] = acted.on_grid, acted.continuous
    return rows


def draw_stray(count: int, rng: np.random.Generator, config: StrayingConfig) -> Stray:
    """Normal deviations; in each step before t-1 a tenth of one that is its own."""
    draw = rng.standard_normal((5, count))
    return Stray(
        aside=config.sideways * draw[0],
        turn=config.heading * draw[1],
        pace=np.exp(config.speed * draw[2]),
        turning=0.1 * config.heading * draw[3],
        pickup=0.1 * config.speed * draw[4],
    )


def off_the_log(
    states: Float[np.ndarray, "rows states 5"], stray: Stray, dt: float
) -> Float[np.ndarray, "rows states 5"]:
    """States up to t-1 off the log's, and the state at t on the way back to it."""
    count = states.shape[1]
    ago = np.arange(count - 2, -1, -1)[None]  # of the states up to t-1
    speed = np.hypot(states[:, -2, 3], states[:, -2, 4]) * stray.pace
    length = LENGTH + LOOK_AHEAD * speed
    bend = -stray.aside / length**2 - 2 * np.sin(stray.turn) / length
    turn_t = stray.turn + bend * speed * dt
    pace_t = 1 + (stray.pace - 1) * (1 - dt / TIME)
    turns = stray.turn[:, None] - stray.turning[:, None] * ago
    paces = stray.pace[:, None] * np.exp(-stray.pickup[:, None] * ago)
    turns = np.concatenate([turns, turn_t[:, None]], 1)
    paces = np.concatenate([paces, pace_t[:, None]], 1)
    moved = states.astype(np.float64)
    moved[..., 2] = (moved[..., 2] + turns + np.pi) % (2 * np.pi) - np.pi
    moved[..., 3:] = _turned(moved[..., 3:], turns) * paces[..., None]
    # Each step is the log's, turned and stretched by the means of its two ends.
    steps = _turned(np.diff(moved[..., :2], axis=1), _means(turns))
    steps *= _means(paces)[..., None]
    path = np.concatenate([np.zeros_like(steps[:, :1]), steps.cumsum(1)], 1)
    left = np.stack([-np.sin(states[:, -2, 2]), np.cos(states[:, -2, 2])], -1)
    here = states[:, -2, :2] + stray.aside[:, None] * left
    moved[..., :2] = path - path[:, -2:-1] + here[:, None]
    return moved.astype(np.float32)


def _means(values: Float[np.ndarray, "rows states"]) -> Float[np.ndarray, "rows steps"]:
    """Of each two that follow one another."""
    return 0.5 * (values[:, 1:] + values[:, :-1])


def _turned(
    vectors: Float[np.ndarray, "rows states 2"],
    angles: Float[np.ndarray, "rows states"],
) -> Float[np.ndarray, "rows states 2"]:
    """Counter-clockwise."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], -1)
