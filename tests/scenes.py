"""Scenes made by hand, and banks of scenes, for the simulator's tests."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sim.bank import BankFile, open_bank
from sim.bank_writer import write_bank
from sim.formats import read_scenes
from sim.scene import (
    ObjectType,
    Polyline,
    RoadKind,
    Scene,
    TrafficLights,
    no_lights,
)
from tests import oracle

STEPS = 20
CURRENT = 4
LENGTH, WIDTH, HEIGHT = 4.0, 2.0, 1.5


def edge(*points: Sequence[float], kind: RoadKind = RoadKind.EDGE_BOUNDARY) -> Polyline:
    """A road edge through points (x, y) or (x, y, z); the road is on its left."""
    rows = np.zeros((len(points), 3))
    for row, point in zip(rows, points, strict=True):
        row[: len(point)] = point
    return Polyline(kind, rows)


def corridor(half: float = 5.0, start: float = -60.0, end: float = 200.0) -> tuple:
    """The two edges of a straight road along x."""
    return (edge((start, -half), (end, -half)), edge((end, half), (start, half)))


def driver(
    *,
    x: float = 0.0,
    y: float = 0.0,
    yaw: float = 0.0,
    speed: float = 10.0,
    steps: int = STEPS,
) -> np.ndarray:
    """[steps, 5] states of an object that keeps speed and heading, from (x, y)."""
    travelled = speed * 0.1 * np.arange(steps)
    states = np.zeros((steps, 5))
    states[:, 0] = x + travelled * np.cos(yaw)
    states[:, 1] = y + travelled * np.sin(yaw)
    states[:, 2] = yaw
    states[:, 3] = speed * np.cos(yaw)
    states[:, 4] = speed * np.sin(yaw)
    return states


def scene_of(
    drivers: Sequence[np.ndarray],
    *,
    roads: Sequence[Polyline] | None = None,
    lights: TrafficLights | None = None,
    valid: np.ndarray | None = None,
    z: float = 0.0,
    name: str = "hand",
    current_step: int = CURRENT,
) -> Scene:
    """A scene of cars with the given states; the first is the recording vehicle."""
    states = np.stack(drivers)
    objects, steps = states.shape[:2]
    position = np.concatenate([states[..., :2], np.full((objects, steps, 1), z)], -1)
    return Scene(
        scenario_id=name,
        dt=0.1,
        current_step=current_step,
        sdc_index=0,
        object_ids=np.arange(objects),
        object_types=np.full(objects, int(ObjectType.VEHICLE)),
        position=position,
        yaw=states[..., 2],
        velocity=states[..., 3:],
        size=np.broadcast_to([LENGTH, WIDTH, HEIGHT], (objects, steps, 3)).copy(),
        valid=np.ones((objects, steps), bool) if valid is None else valid,
        roads=tuple(corridor() if roads is None else roads),
        lights=no_lights(steps) if lights is None else lights,
    )


def moved(scene: Scene, turn: float, shift: Sequence[float]) -> Scene:
    """The whole scene, turned about the map's origin [rad], then shifted [m]."""
    cos, sin = np.cos(turn), np.sin(turn)

    def turned(points: np.ndarray) -> np.ndarray:
        result = points.copy()
        result[..., 0] = cos * points[..., 0] - sin * points[..., 1]
        result[..., 1] = sin * points[..., 0] + cos * points[..., 1]
        return result

    def placed(points: np.ndarray) -> np.ndarray:
        result = turned(points)
        result[..., :2] += shift
        return result

    return dataclasses.replace(
        scene,
        position=placed(scene.position),
        yaw=(scene.yaw + turn + np.pi) % (2 * np.pi) - np.pi,
        velocity=turned(scene.velocity),
        roads=tuple(
            dataclasses.replace(road, points=placed(road.points))
            for road in scene.roads
        ),
        lights=dataclasses.replace(
            scene.lights, stop_points=placed(scene.lights.stop_points)
        ),
    )


def bank_of(scenes: Sequence[Scene], folder: Path, name: str = "scenes") -> BankFile:
    """The scenes as an opened bank."""
    path = folder / f"{name}.bank"
    write_bank(scenes, path)
    return open_bank(path)


def real(data: Path) -> tuple[Scene, ...]:
    """Every recorded scene."""
    return tuple(read_scenes([data / "gpudrive", data / "womd"]))


def local_edges(scene: Scene, origin: Sequence[float]) -> list[np.ndarray]:
    """The road edges as the bank places them: less its origin, in double precision."""
    return [points - np.array(origin) for points in oracle.road_edges(scene)]


def planar_distance(points: np.ndarray, edges: Sequence[np.ndarray]) -> np.ndarray:
    """Distance in the plane to the nearest edge, whatever its height [m]."""
    flat = [np.concatenate([e[:, :2], np.zeros((len(e), 1))], 1) for e in edges]
    return oracle.edge_distance(points, np.zeros(len(points)), flat)


def poses_around_edges(
    rng: np.random.Generator, edges: Sequence[np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Random boxes (x, y, yaw, length, width) near edges, and their heights z.

    All values are float32's, so that both precisions judge the same boxes.
    """
    points = np.concatenate(edges)
    at = points[rng.integers(len(points), size=count)]
    boxes = np.stack(
        [
            at[:, 0] + rng.normal(0, 4, count),
            at[:, 1] + rng.normal(0, 4, count),
            rng.uniform(-np.pi, np.pi, count),
            rng.uniform(0.5, 9.0, count),
            rng.uniform(0.4, 3.0, count),
        ],
        -1,
    )
    z = at[:, 2] + rng.uniform(0.0, 2.0, count)
    return boxes.astype(np.float32), z.astype(np.float32)


def counted(function: Callable[..., Any]) -> tuple[Callable[..., Any], list[None]]:
    """The function jitted, and a list that grows with every trace of it."""
    traces: list[None] = []

    def traced(*args: Any) -> Any:
        traces.append(None)
        return function(*args)

    return jax.jit(traced), traces
