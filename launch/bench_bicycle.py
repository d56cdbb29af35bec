"""Section `bicycle`: how far one step of the action spaces is from a recorded one.

Every two consecutive recorded states of a vehicle that moves (at both `SLOW` or
faster) go through the inverse and then the forward dynamics, from the recorded state;
the error is the distance of the predicted position from the recorded one [m]. The
Bicycle's measures how well its model fits how cars were recorded; Delta reproduces any
motion, so its error is what float32 rounds.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim import dynamics
from sim.convert import origin_of
from sim.dynamics import SLOW, ObjectState
from sim.scene import ObjectType, Scene


def pairs_of(scene: Scene) -> Float[np.ndarray, "pairs 2 5"]:
    """Consecutive states (x, y, yaw, v_x, v_y) of moving vehicles, local frame."""
    origin = origin_of(scene)[:2]
    states = np.concatenate(
        [scene.position[..., :2] - origin, scene.yaw[..., None], scene.velocity], -1
    )
    speed = np.hypot(*np.moveaxis(scene.velocity, -1, 0))
    good = scene.valid & (np.where(scene.valid, speed, 0.0) >= SLOW)
    good &= (scene.object_types == ObjectType.VEHICLE)[:, None]
    both = good[:, :-1] & good[:, 1:]
    pairs = np.stack([states[:, :-1][both], states[:, 1:][both]], 1)
    return pairs.astype(np.float32)


def errors(
    pairs: Float[np.ndarray, "pairs 2 5"], dt: float
) -> dict[str, Float[np.ndarray, " pairs"]]:
    """Each action space's position error [m]."""

    def one(pair: Float[Array, "2 5"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        now, following = ObjectState(*pair[0]), ObjectState(*pair[1])
        action = dynamics.bicycle_inverse(now, following, dt)
        turned = dynamics.bicycle(now, action, dt)
        moved = dynamics.delta(now, dynamics.delta_inverse(now, following), dt)
        return _apart(turned, following), _apart(moved, following)

    bicycle, delta = jax.jit(jax.vmap(one))(jnp.asarray(pairs))
    return {"bicycle": np.asarray(bicycle), "delta": np.asarray(delta)}


def _apart(one: ObjectState, other: ObjectState) -> Float[Array, ""]:
    return jnp.hypot(one.x - other.x, one.y - other.y)


def summary(error: Float[np.ndarray, " pairs"]) -> dict[str, float]:
    """Mean, median and 99th percentile [m]."""
    return {
        "mean_m": float(error.mean()),
        "median_m": float(np.median(error)),
        "p99_m": float(np.quantile(error, 0.99)),
    }


def bicycle(scenes: list[Scene]) -> Iterator[dict[str, Any]]:
    """A row for each scene with a moving vehicle, then one for all together."""
    every: dict[str, list[np.ndarray]] = {"bicycle": [], "delta": []}
    for scene in scenes:
        pairs = pairs_of(scene)
        if not len(pairs):
            continue
        error = errors(pairs, scene.dt)
        for name, values in error.items():
            every[name].append(values)
        yield _row(scene.scenario_id, error)
    if every["bicycle"]:
        yield _row("all", {name: np.concatenate(v) for name, v in every.items()})


def _row(name: str, error: dict[str, np.ndarray]) -> dict[str, Any]:
    return {
        "scene": name,
        "pairs": len(error["bicycle"]),
        **{space: summary(values) for space, values in error.items()},
    }
