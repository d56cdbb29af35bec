"""What objects see from their logged histories, for tests of observations."""

import jax
import jax.numpy as jnp
import numpy as np

from sim.bank import BankFile
from sim.observation import Observation, ObservationConfig, observe, observe_batch
from sim.world import View

CONFIG = ObservationConfig()
SMALL = ObservationConfig(
    history=2, neighbours=2, road_rows=3, lights=1, route_points=1, radius=20.0
)

_observe = jax.jit(observe, static_argnums=2)
_observe_batch = jax.jit(observe_batch, static_argnums=2)


def history_of(
    file: BankFile, scene: int, step: int, controlled: int, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """The logged states up to `step`, and which are valid."""
    steps = np.arange(step - length + 1, step + 1)
    log = file.arrays["log"][scene, np.maximum(steps, 0), controlled]
    valid = file.arrays["log_valid"][scene, np.maximum(steps, 0), controlled]
    return log[:, [0, 1, 3, 4, 5]], valid & (steps >= 0)


def view_of(
    file: BankFile, scene: int, step: int, *controlled: int, length: int
) -> View:
    """Some objects of a scene with the log's histories, as numpy arrays."""
    rows = [history_of(file, scene, step, row, length) for row in controlled]
    return View(
        scene=np.int32(scene),
        step=np.int32(step),
        controlled=np.array(controlled, np.int32),
        history=np.stack([history for history, _ in rows]),
        history_valid=np.stack([valid for _, valid in rows]),
    )


def look(file: BankFile, view: View, config: ObservationConfig = CONFIG) -> Observation:
    """What all controlled objects see, as numpy arrays; axis `controlled` in front."""
    found = _observe(file.bank, jax.tree.map(jnp.asarray, view), config)
    return Observation(*(np.asarray(value) for value in found))


def seen(
    file: BankFile,
    scene: int,
    step: int,
    controlled: int,
    config: ObservationConfig = CONFIG,
    offset: np.ndarray | None = None,
) -> Observation:
    """The observation from the log's history, moved by `offset`, as numpy arrays."""
    view = view_of(file, scene, step, controlled, length=config.history)
    if offset is not None:
        view = view._replace(history=view.history + offset.astype(np.float32))
    return Observation(*(value[0] for value in look(file, view, config)))


def batch_of(
    file: BankFile, scene: np.ndarray, step: np.ndarray, controlled: np.ndarray
) -> Observation:
    """`observe_batch` from the log's histories, one object a row, as numpy arrays."""
    places = zip(scene, step, controlled, strict=True)
    views = [view_of(file, *row, length=CONFIG.history) for row in places]
    joined = jax.tree.map(lambda *parts: jnp.asarray(np.stack(parts)), *views)
    found = _observe_batch(file.bank, joined, CONFIG)
    return Observation(*(np.asarray(value)[:, 0] for value in found))
