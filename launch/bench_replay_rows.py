"""The project's own rows in `slipstream bench replay`, and their observations.

A row of log-replayed traffic is 128 bytes; what it stands for are two observations,
rendered from it by one jitted call (`launch.learning.make_render`). Rows are the
recording vehicles' own motion through the scenes of a bank, at random steps.
"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np

from actors.rows import columns_of, render, row_spec
from launch.bench_programs import waited
from launch.config import PRESETS
from replay.spec import RowSpec
from sim.bank import open_bank
from sim.observation import Observation

Rendered = Callable[[np.ndarray], tuple[Observation, Observation]]
FIELDS: Final = (0, 1, 3, 4, 5)  # x, y, yaw, v_x, v_y of the log's
ROUNDS: Final = 16  # different batches that are rendered in turn


def bank_rows(path: Path, spec: RowSpec, count: int) -> np.ndarray:
    """Transitions of the recording vehicles, at random scenes and steps."""
    file = open_bank(path)
    arrays = file.arrays
    random = np.random.default_rng(0)
    rows = np.zeros(count, spec.dtype)
    states = rows["states"].shape[1]
    scene = random.integers(0, file.scenes, count)
    step = random.integers(states - 1, arrays["steps"][scene])
    rows["scene"], rows["step"] = scene, step
    rows["controlled"] = arrays["sdc"][scene]
    steps = step[:, None] - np.arange(states)[::-1]
    where = (scene[:, None], steps, rows["controlled"][:, None])
    rows["states"] = arrays["log"][where][..., FIELDS]
    rows["valid"] = arrays["log_valid"][where]
    rows["discount"] = 1.0
    rows["serial"] = np.arange(count)
    return rows


def renderer(path: Path, preset: str, *, rows: int) -> Rendered:
    """Rows to both observations as a preset has them, compiled for so many rows."""
    config = PRESETS[preset]().environment.observation
    bank = open_bank(path).bank
    compiled = jax.jit(functools.partial(render, config=config))

    def rendered(batch: np.ndarray) -> tuple[Observation, Observation]:
        return waited(compiled(bank, columns_of(batch)))

    rendered(bank_rows(path, row_spec(config.history), rows))
    return rendered


def rendering(request: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Observations/s of a learner's batches, nothing else; in a process of one core."""
    path, preset, count = Path(request["bank"]), request["preset"], request["rows"]
    use = renderer(path, preset, rows=count)
    spec = row_spec(PRESETS[preset]().environment.observation.history)
    batches = bank_rows(path, spec, ROUNDS * count).reshape(ROUNDS, count)
    use(batches[0])
    observations, began, spent = 0, time.perf_counter(), time.process_time()
    while time.perf_counter() < began + request["seconds"]:
        for batch in batches:
            use(batch)
        observations += 2 * batches.size
    size = sum(part.nbytes for part in jax.tree.leaves(use(batches[0])))
    yield {
        "preset": preset,
        "rows": count,
        "observations_per_s": observations / (time.perf_counter() - began),
        "cpu_us_per_observation": (time.process_time() - spent) / observations * 1e6,
        "bytes_of_two_observations": size // count,
    }
