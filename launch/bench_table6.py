"""Sections `table6` and `oracle` of `slipstream bench sim`."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import jax
import numpy as np

from launch import bench_oracle, bench_programs
from launch.bench_paper import paper_row
from launch.bench_programs import Program, Step
from launch.bench_scenes import Sized, sized
from launch.bench_timing import side_by_side, timed
from sim.bank import Bank
from sim.environment import EnvironmentConfig
from sim.scene import Scene

VARIANTS: Final = {
    "all points": {"only_edges": False, "rows": False},
    "all points, as rows of three": {"only_edges": False, "rows": True},
    "edge points only": {"only_edges": True, "rows": False},
}
YARDSTICK: Final = "all points"


@dataclass(frozen=True)
class Work:
    """What the sections measure with; `say` tells a person how far it is."""

    scene: Scene
    folder: Path  # for banks, temporary
    objects: tuple[int, ...]
    batches: tuple[int, ...]
    steps: tuple[tuple[int, int], ...]  # controlled, environments
    environments: tuple[int, ...]
    scale_objects: tuple[int, ...]
    seconds: float  # per timed program
    say: Callable[[str], None]

    def sized(self, objects: int) -> Sized:
        """The scene in so many slots."""
        return sized(self.scene, objects, self.folder)


def configuration(dt: float) -> EnvironmentConfig:
    """The paper's environment at the scenes' step length."""
    return EnvironmentConfig(dt=dt)


def devices() -> list[jax.Device]:
    """The processor, and the accelerator where there is one."""
    found = [jax.devices("cpu")[0]]
    default = jax.devices()[0]
    return found if default.platform == "cpu" else [*found, default]


def measured(programs: dict[str, Program], seconds: float) -> dict[str, Any]:
    """Times and peak memory of each program."""
    return {
        name: {
            **timed(program.call, seconds=seconds).json(),
            "peak_bytes": program.peak_bytes,
            "temporary_bytes": program.temporary_bytes,
        }
        for name, program in programs.items()
    }


def bank_bytes(bank: Bank) -> int:
    """Memory of all of a bank's arrays."""
    return sum(values.nbytes for values in bank)


def table6(work: Work) -> Iterator[dict[str, Any]]:
    """One row per device, batch and number of slots."""
    for device in devices():
        for batch in work.batches:
            for slots in work.objects:
                work.say(f"table 6: {device.platform}, batch {batch}, {slots} objects")
                yield _row(work, device, batch, slots)


def _row(work: Work, device: jax.Device, batch: int, slots: int) -> dict[str, Any]:
    scene = work.sized(slots)
    config = configuration(scene.file.dt)
    with jax.default_device(device):
        bank = scene.file.bank
        figures = measured(bench_programs.ours(bank, batch, config), work.seconds)
    platform = "cpu" if device.platform == "cpu" else "gpu"
    paper = paper_row(platform, batch, slots)
    return {
        "device": platform,
        "device_kind": device.device_kind,
        "batch": batch,
        "slots": slots,
        "objects": scene.objects,
        "programs": figures,
        "peak_memory_bytes": max(f["peak_bytes"] for f in figures.values()),
        "bank_bytes": bank_bytes(bank),
        "paper": None if paper is None else paper._asdict(),
    }


def oracle(work: Work) -> Iterator[dict[str, Any]]:
    """Ours and the oracle's variants side by side, batch 1, on the processor.

    The variants that are not the yardstick are measured at the largest size only.
    """
    largest = max(work.objects)
    with jax.default_device(jax.devices("cpu")[0]):
        for slots in work.objects:
            chosen = [YARDSTICK] if slots < largest else list(VARIANTS)
            yield beside_oracle(work, slots, chosen)


def beside_oracle(work: Work, slots: int, variants: list[str]) -> dict[str, Any]:
    """One size: ours and some variants of the oracle."""
    scene = work.sized(slots)
    bank, config = scene.file.bank, configuration(scene.file.dt)
    own = bench_programs.ours(bank, 1, config, ("metrics", "rollout"))
    work.say(f"oracle: {slots} objects")
    row: dict[str, Any] = {"slots": slots, "objects": scene.objects, "oracle": {}}
    for variant in variants:
        form = VARIANTS[variant]
        road = bench_oracle.road_points(
            scene.scene, scene.file.origins[0], only_edges=form["only_edges"]
        )
        theirs = bench_programs.oracle(bank, road, config, rows=form["rows"])
        row["oracle"][variant] = {
            "points": int(road.x.shape[0]),
            **{name: beside(own[name], theirs[name], work.seconds) for name in theirs},
        }
        if variant == YARDSTICK:
            row["agreement"] = agreement(
                own["rollout"].call(), theirs["rollout"].call()
            )
    return row


def beside(own: Program, theirs: Program, seconds: float) -> dict[str, Any]:
    """Both times and how many times faster ours is."""
    one, other = side_by_side(own.call, theirs.call, seconds=seconds)
    return {
        "ours": one.json(),
        "oracle": other.json(),
        "ratio": other.median_ms / one.median_ms,
        "ratio_of_least": other.least_ms / one.least_ms,
    }


def agreement(one: Step, other: Step) -> dict[str, Any]:
    """Share of the recorded (object, step) pairs of a rollout judged alike."""
    one, other = jax.device_get((one, other))
    valid = np.asarray(one.valid)
    pairs = max(int(valid.sum()), 1)
    apart = np.abs(one.log_divergence - other.log_divergence)
    alike = {
        name: float((getattr(one, name) == getattr(other, name))[valid].mean())
        if valid.any()
        else 1.0
        for name in ("overlap", "offroad", "kinematic_infeasibility")
    }
    return {
        "pairs": pairs,
        "steps": len(valid),
        **alike,
        "log_divergence_largest_difference_m": float(apart.max(initial=0.0)),
    }
