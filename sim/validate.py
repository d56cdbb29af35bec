"""Checks a scene before anything is computed from it.

A scene passes when all shapes agree, every value that `valid` vouches for is finite
and of a magnitude that float32 arithmetic survives, boxes have positive sizes, and
indices point into the scene. Loaders call it on what they built, so what reaches the
bank holds no NaN, whatever the file said. What the values mean is not judged: cars
may overlap and lights may all be green.
"""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float

from sim.scene import LightState, ObjectType, Scene, SceneError

# Beyond these no road user or map is real, and squares would leave float32's range.
_POSITION_LIMIT = 1e8  # m; a map grid's coordinates reach 1e7
_SPEED_LIMIT = 1e4  # m/s
_SIZE_LIMIT = 1e3  # m
_YAW_LIMIT = 1e4  # rad
_SIDE_LIMIT = 5e4  # m: farther out float32's steps reach 4 mm
_AREA_LIMIT = 25e6  # m^2 that the map and the logs span: tables cover all of it


def check_scene(scene: Scene) -> Scene:
    """Returns `scene` if it is sound, else raises `SceneError` with what is not."""
    for problem in _problems(scene):
        where = scene.source or f"scene {scene.scenario_id!r}"
        raise SceneError(f"{where}: {problem}")
    return scene


def _problems(scene: Scene) -> Iterator[str]:
    """Yields what is wrong; later checks rely on earlier ones having passed."""
    yield from _shape_problems(scene)
    yield from _index_problems(scene)
    yield from _state_problems(scene)
    yield from _map_problems(scene)
    yield from _path_problems(scene)
    yield from _extent_problems(scene)
    yield from _light_problems(scene)


def _shape_problems(scene: Scene) -> Iterator[str]:
    """Whether all arrays are of the same objects and steps."""
    if scene.valid.ndim != 2:
        yield f"valid has {scene.valid.ndim} axes, expected objects and steps"
        return
    grid = (scene.objects, scene.steps)
    expected: tuple[tuple[str, np.ndarray, tuple[int, ...]], ...] = (
        ("object_ids", scene.object_ids, grid[:1]),
        ("object_types", scene.object_types, grid[:1]),
        ("position", scene.position, (*grid, 3)),
        ("yaw", scene.yaw, grid),
        ("velocity", scene.velocity, (*grid, 2)),
        ("size", scene.size, (*grid, 3)),
        ("light states", scene.lights.states, (len(scene.lights.lane_ids), grid[1])),
        ("stop points", scene.lights.stop_points, (len(scene.lights.lane_ids), 3)),
    )
    for name, array, shape in expected:
        if array.shape != shape:
            yield f"{name} has shape {array.shape}, expected {shape}"


def _index_problems(scene: Scene) -> Iterator[str]:
    """Whether the scene has objects and steps, and its indices point at them."""
    if not scene.scenario_id:
        yield "the scenario has no id"
    if scene.objects == 0:
        yield "there is no object"
    if scene.steps < 2:
        yield f"there are {scene.steps} steps, at least 2 are needed"
    if not (math.isfinite(scene.dt) and scene.dt > 0):
        yield f"the step length is {scene.dt} s, expected a positive number"
    indices = (
        ("current step", scene.current_step, scene.steps - 1, "steps to act at"),
        ("SDC index", scene.sdc_index, scene.objects, "objects"),
        *(
            ("track to predict", index, scene.objects, "objects")
            for index in scene.tracks_to_predict
        ),
        *(
            ("object of interest", index, scene.objects, "objects")
            for index in scene.objects_of_interest
        ),
    )
    for name, index, count, of in indices:
        if not 0 <= index < count:
            yield f"{name} {index} is not among {count} {of}"
    if not np.isin(scene.object_types, list(ObjectType)).all():
        yield "an object is of an unknown type"


def _state_problems(scene: Scene) -> Iterator[str]:
    """Whether what `valid` vouches for is finite, and boxes have positive sizes."""
    limits: tuple[tuple[str, np.ndarray, float], ...] = (
        ("position", scene.position, _POSITION_LIMIT),
        ("yaw", scene.yaw, _YAW_LIMIT),
        ("velocity", scene.velocity, _SPEED_LIMIT),
        ("size", scene.size, _SIZE_LIMIT),
    )
    for name, values, limit in limits:
        bad = ~_within(values, limit)
        bad = np.asarray(bad.any(axis=-1)) if bad.ndim == 3 else bad
        yield from _first(
            bad & scene.valid, f"{name} is not finite or beyond {limit:g}"
        )
    flat = (scene.size[..., :2] <= 0).any(axis=-1)
    yield from _first(flat & scene.valid, "length or width is not positive")


def _within(values: Float[np.ndarray, "..."], limit: float) -> Bool[np.ndarray, "..."]:
    """Whether each value is a number of at most this magnitude (NaN is not)."""
    return np.asarray(np.abs(values) <= limit)


def _first(bad: Bool[np.ndarray, "objects steps"], what: str) -> Iterator[str]:
    """Names the first object and step where `bad` holds."""
    found = np.argwhere(bad)
    if len(found):
        yield f"object {found[0][0]} at step {found[0][1]}: {what}"


def _map_problems(scene: Scene) -> Iterator[str]:
    """Whether every polyline has finite points of three coordinates."""
    for index, road in enumerate(scene.roads):
        if road.points.ndim != 2 or road.points.shape[1:] != (3,):
            yield f"map feature {index} has points of shape {road.points.shape}"
        elif not len(road.points):
            yield f"map feature {index} has no point"
        elif not _within(road.points, _POSITION_LIMIT).all():
            yield f"map feature {index} has a point that is not finite"
        elif not (math.isfinite(road.speed_limit) and road.speed_limit >= 0):
            yield f"map feature {index} has speed limit {road.speed_limit}"


def _path_problems(scene: Scene) -> Iterator[str]:
    """Whether every path sample leads from one finite point to another."""
    for index, path in enumerate(scene.sdc_paths):
        if path.points.ndim != 2 or path.points.shape[1:] != (3,):
            yield f"SDC path {index} has points of shape {path.points.shape}"
        elif len(path.points) < 2 or not _within(path.points, _POSITION_LIMIT).all():
            yield f"SDC path {index} has a point that is not finite, or fewer than two"


def _extent_problems(scene: Scene) -> Iterator[str]:
    """Whether the map and all recorded positions lie near enough to each other."""
    points = [road.points[:, :2] for road in scene.roads]
    every = np.concatenate([*points, scene.position[scene.valid][:, :2]])
    if not len(every):
        yield "no object is ever valid, and there is no map"
        return
    width, height = (every.max(axis=0) - every.min(axis=0)).tolist()
    if max(width, height) > _SIDE_LIMIT or width * height > _AREA_LIMIT:
        yield (
            f"the map and the recorded positions span {width:.0f} x {height:.0f} m, at "
            f"most {_SIDE_LIMIT:g} m and {_AREA_LIMIT:g} m^2; crop them, or correct "
            "the point that is far off"
        )


def _light_problems(scene: Scene) -> Iterator[str]:
    """Whether lights stand somewhere and have known states."""
    if not _within(scene.lights.stop_points, _POSITION_LIMIT).all():
        yield "a traffic light's stop point is not finite"
    states = scene.lights.states
    if states.size and not np.isin(states, list(LightState)).all():
        yield "a traffic light is in an unknown state"
