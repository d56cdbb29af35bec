"""What `slipstream bench sim` measures on: one scene, in any number of object slots.

A scene of more objects keeps the nearest to the SDC (`sim.slots`); one of fewer is
filled up with slots in which nothing is ever recorded (`padded`), or, where the cost of
objects is the question, with copies of its own rows (`tiled`). The true number of
objects is reported beside the slots.
"""

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from launch.errors import LaunchError
from sim.bank import BankFile, open_bank
from sim.bank_writer import write_bank
from sim.formats import Format, detect, list_files, read_scenes
from sim.procedural import generate_many
from sim.scene import Scene
from sim.slots import keep_nearest

PROCEDURAL: Final = "procedural"
DATA: Final = "SLIPSTREAM_DATA"
LOGS: Final = 8  # procedural scenes where there are no recorded ones


@dataclass(frozen=True)
class Source:
    """Where the scenes of a run come from; travels to the measuring processes."""

    kind: Literal["recorded", "procedural"]
    main: tuple[str, ...]  # files among whose scenes the measured one is
    logs: tuple[str, ...]  # files or folders of all scenes

    def scene(self) -> Scene:
        """The measured scene: the one with the most road points."""
        return max(self._read(self.main, 1), key=road_points)

    def scenes(self) -> list[Scene]:
        """All of them."""
        return self._read(self.logs, LOGS)

    def _read(self, paths: Sequence[str], generated: int) -> list[Scene]:
        if self.kind == "procedural":
            return list(generate_many(0, generated))
        return list(read_scenes([Path(path) for path in paths]))


def source_of(scenes: Sequence[str]) -> Source:
    """What was asked for; by default the recorded scenes at hand, else generated ones.

    Of the default's files the one in WOMD's `tf.Example` form is measured.
    """
    data = os.environ.get(DATA, "")
    if tuple(scenes) == (PROCEDURAL,) or (not scenes and not data):
        return Source("procedural", (), ())
    named = tuple(scenes) or (data,)
    files = list_files([Path(name) for name in named])
    formats = {str(file): detect(file) for file in files}
    if Format.BANK in formats.values():
        bank = next(name for name, kind in formats.items() if kind is Format.BANK)
        raise LaunchError(
            f"{bank}: is a bank, which holds no road points for the oracle; give "
            "--scenes the files it was made from"
        )
    examples = tuple(n for n, kind in formats.items() if kind is Format.WOMD_EXAMPLE)
    main = tuple(formats) if scenes else examples or tuple(formats)
    return Source("recorded", main, named)


def road_points(scene: Scene) -> int:
    """All points of the map."""
    return sum(len(road.points) for road in scene.roads)


def description(source: Source, scene: Scene) -> dict[str, Any]:
    """What was measured on, for the report."""
    edges = sum(len(road.points) for road in scene.roads if road.kind.is_edge)
    return {
        "kind": source.kind,
        "id": scene.scenario_id,
        "objects": scene.objects,
        "steps": scene.steps,
        "road_points": road_points(scene),
        "road_edge_points": edges,
    }


def padded(scene: Scene, slots: int) -> Scene:
    """At least `slots` rows, those added never valid."""
    return _with_rows(scene, slots, real=False)


def tiled(scene: Scene, slots: int) -> Scene:
    """At least `slots` rows, those added copies of the scene's own in turn."""
    return _with_rows(scene, slots, real=True)


def _with_rows(scene: Scene, slots: int, *, real: bool) -> Scene:
    extra = slots - scene.objects
    if extra <= 0:
        return scene
    rows = np.arange(slots) % scene.objects
    valid = scene.valid[rows]
    valid[scene.objects :] &= real
    last = int(scene.object_ids.max())
    new_ids = last + 1 + np.arange(extra)
    return dataclasses.replace(
        scene,
        object_ids=np.concatenate([scene.object_ids, new_ids]),
        object_types=scene.object_types[rows],
        position=scene.position[rows],
        yaw=scene.yaw[rows],
        velocity=scene.velocity[rows],
        size=scene.size[rows],
        valid=valid,
    )


@dataclass(frozen=True)
class Sized:
    """The scene in exactly `slots` slots, as a bank."""

    scene: Scene
    file: BankFile
    objects: int  # of the slots, those that hold a recorded object


def sized(scene: Scene, slots: int, folder: Path, *, tile: bool = False) -> Sized:
    """Cuts or fills the scene to `slots` objects and writes its bank to `folder`."""
    kept = keep_nearest(scene, slots=slots)
    filled = tiled(kept, slots) if tile else padded(kept, slots)
    path = folder / f"{'tiled' if tile else 'padded'}-{slots}.bank"
    if not path.exists():
        write_bank([filled], path)
    return Sized(filled, open_bank(path), kept.objects)
