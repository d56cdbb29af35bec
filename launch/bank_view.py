"""Scenes of a bank for the viewer.

A bank keeps the map as short segments in the plane and no object's height: what the
simulator does not use. So these scenes are flat, every box stands on the ground, and
heights are nominal. Segments that follow one another become polylines again.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

from launch.scene_view import SceneSource, ViewScene
from launch.words import ActionLabels
from sim.bank import BankFile
from sim.convert import LOG_FIELDS
from sim.dynamics import ActionConfig, ActionSpace, action_table
from sim.scene import ObjectType, RoadKind

HEIGHTS = {ObjectType.PEDESTRIAN: 1.75, ObjectType.CYCLIST: 1.7}  # m
VEHICLE_HEIGHT = 1.6  # m
_FIELD = {name: column for column, name in enumerate(LOG_FIELDS)}
_POLYGONS = (RoadKind.CROSSWALK, RoadKind.SPEED_BUMP)
_NAMES = {
    ActionSpace.BICYCLE: ("acceleration [m/s²]", "curvature [1/m]"),
    ActionSpace.STEERING: ("acceleration [m/s²]", "wheel [rad]"),
    ActionSpace.DELTA: ("ahead [m]", "left [m]", "turn [rad]"),
}


def labels_of(config: ActionConfig) -> ActionLabels:
    """What the indices of a grid of actions mean."""
    return ActionLabels(names=_NAMES[config.space], values=action_table(config))


def chained(
    segments: Float[np.ndarray, "segments 4"], kinds: Int[np.ndarray, " segments"]
) -> tuple[tuple[RoadKind, Float[np.ndarray, "_ 3"]], ...]:
    """Joins segments, each beginning where the one before it ends, to polylines.

    Polygons end where they have come back to their beginning, which they then repeat
    no more.
    """
    if not len(segments):
        return ()
    joins = (kinds[1:] == kinds[:-1]) & (segments[1:, :2] == segments[:-1, 2:]).all(1)
    lines = []
    breaks = np.flatnonzero(~joins) + 1
    for first, last in zip([0, *breaks], [*breaks, len(segments)], strict=True):
        part = segments[first:last]
        kind = RoadKind(int(kinds[first]))
        points = np.concatenate([part[:1, :2], part[:, 2:]])
        if kind == RoadKind.STOP_SIGN:
            points = points[:1]
        for polygon in _polygons(points) if kind in _POLYGONS else [points]:
            flat = np.zeros((len(polygon), 3), np.float32)
            flat[:, :2] = polygon
            lines.append((kind, flat))
    return tuple(lines)


def _polygons(points: Float[np.ndarray, "points 2"]) -> list[np.ndarray]:
    """Splits a chain into polygons where it comes back to its beginning."""
    found, first = [], 0
    for index in range(1, len(points)):
        if index > first and (points[index] == points[first]).all():
            found.append(points[first:index])
            first = index
    return found


def bank_scene(file: BankFile, scene: int) -> ViewScene:
    """One scene of a bank; its rows are copied, the file is not kept mapped by them."""
    arrays = file.arrays
    objects, steps = int(arrays["objects"][scene]), int(arrays["steps"][scene])
    lights = int(arrays["lights"][scene])
    log = arrays["log"][scene, :steps, :objects].swapaxes(0, 1)
    types = arrays["object_type"][scene, :objects]
    heights = np.array(
        [HEIGHTS.get(ObjectType(int(t)), VEHICLE_HEIGHT) for t in types], np.float32
    )
    height = np.broadcast_to(heights[:, None], log.shape[:2])
    columns = [log[..., _FIELD[name]] for name in ("x", "y", "length", "width")]
    stop_points = np.zeros((lights, 3), np.float32)
    stop_points[:, :2] = arrays["light_position"][scene, :lights]
    first, last = _segment_range(file, scene)
    return ViewScene(
        scenario_id=file.scenario_ids[scene],
        dt=file.dt,
        polylines=chained(
            arrays["segments"][first:last], arrays["segment_kind"][first:last]
        ),
        position=np.stack([*columns[:2], height / 2], axis=-1),
        yaw=log[..., _FIELD["yaw"]].copy(),
        speed=np.hypot(log[..., _FIELD["v_x"]], log[..., _FIELD["v_y"]]),
        size=np.stack([*columns[2:], height], axis=-1),
        valid=arrays["log_valid"][scene, :steps, :objects].T.copy(),
        object_types=types.astype(np.int64),
        light_points=stop_points,
        light_states=arrays["light_state"][scene, :steps, :lights].T.astype(np.int64),
    )


def _segment_range(file: BankFile, scene: int) -> tuple[int, int]:
    """First and last + 1 row of a scene's segments."""
    starts = file.arrays["segment_start"]
    following = int(starts[scene + 1]) if scene + 1 < file.scenes else None
    return int(starts[scene]), following or len(file.arrays["segments"])


def bank_scenes(file: BankFile, *, kept: int = 64) -> SceneSource:
    """The scenes of a bank by index, the last `kept` ones remembered."""

    @lru_cache(maxsize=kept)
    def scene_of(scene: int) -> ViewScene:
        if not 0 <= scene < file.scenes:
            raise IndexError(f"scene {scene} of a bank of {file.scenes}")
        return bank_scene(file, scene)

    return scene_of
