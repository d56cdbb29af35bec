"""A scene as the viewer needs it, and its traffic lights in Rerun.

Positions are metres in the scene's local frame (float32 needs an origin near the
scene, which `view_scene_of` subtracts; bank coordinates are already local).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from jaxtyping import Bool, Float, Int, Shaped

from sim.scene import LightState, RoadKind, Scene

Colour = tuple[int, int, int, int]

_RED: Colour = (255, 69, 58, 255)
_AMBER: Colour = (255, 190, 40, 255)
_GREEN: Colour = (52, 211, 103, 255)
_DARK: Colour = (90, 96, 106, 255)
LIGHT_COLOURS: dict[LightState, Colour] = {
    LightState.UNKNOWN: _DARK,
    LightState.ARROW_STOP: _RED,
    LightState.ARROW_CAUTION: _AMBER,
    LightState.ARROW_GO: _GREEN,
    LightState.STOP: _RED,
    LightState.CAUTION: _AMBER,
    LightState.GO: _GREEN,
    LightState.FLASHING_STOP: _RED,
    LightState.FLASHING_CAUTION: _AMBER,
}


@dataclass(frozen=True, kw_only=True)
class ViewScene:
    """What the viewer needs of a scene. Values where `valid` is False mean nothing."""

    scenario_id: str
    dt: float  # s between steps
    polylines: tuple[tuple[RoadKind, Float[np.ndarray, "_ 3"]], ...]
    position: Float[np.ndarray, "objects steps 3"]  # m, the box's centre
    yaw: Float[np.ndarray, "objects steps"]  # rad
    speed: Float[np.ndarray, "objects steps"]  # m/s
    size: Float[np.ndarray, "objects steps 3"]  # m: length, width, height
    valid: Bool[np.ndarray, "objects steps"]
    object_types: Int[np.ndarray, " objects"]  # `ObjectType`
    light_points: Float[np.ndarray, "lights 3"]  # m
    light_states: Int[np.ndarray, "lights light_steps"]  # `LightState`


SceneSource = Callable[[int], ViewScene]
"""Hands over a scene of the bank by its index."""


def view_scene_of(scene: Scene) -> ViewScene:
    """Brings a scene to its local frame: the first valid SDC position is the origin."""
    sdc = scene.sdc_index
    first = int(np.argmax(scene.valid[sdc]))
    origin = scene.position[sdc, first]
    return ViewScene(
        scenario_id=scene.scenario_id,
        dt=scene.dt,
        polylines=tuple(
            (road.kind, (road.points - origin).astype(np.float32))
            for road in scene.roads
        ),
        position=(scene.position - origin).astype(np.float32),
        yaw=scene.yaw.astype(np.float32),
        speed=np.linalg.norm(scene.velocity, axis=-1).astype(np.float32),
        size=scene.size.astype(np.float32),
        valid=scene.valid,
        object_types=scene.object_types,
        light_points=(scene.lights.stop_points - origin).astype(np.float32),
        light_states=scene.lights.states,
    )


def send(
    recording: rr.RecordingStream,
    entity: str,
    at: Sequence[int] | Int[np.ndarray, " rows"],
    columns: Iterable[rr.ComponentColumn],
) -> None:
    """Sends columns at rows of the timeline `step`."""
    index = rr.TimeColumn("step", sequence=np.asarray(at))
    recording.send_columns(entity, [index], columns)


def log_lights(
    recording: rr.RecordingStream,
    root: str,
    scene: ViewScene,
    steps: Shaped[np.ndarray, " frames"],
    at: Int[np.ndarray, " frames"],
) -> None:
    """Logs the traffic lights' states at steps of the log."""
    count, recorded = scene.light_states.shape
    if count == 0 or recorded == 0:
        empty = rr.Points3D.columns(positions=np.zeros((0, 3), np.float32))
        send(recording, f"{root}/lights", at[:1], empty.partition([0]))
        return
    states = scene.light_states[:, np.clip(steps, 0, recorded - 1)].T
    colours = [LIGHT_COLOURS[LightState(int(state))] for state in states.flat]
    columns = rr.Points3D.columns(
        positions=np.tile(scene.light_points, (len(at), 1)),
        colors=colours,
        radii=np.full(states.size, 0.6, np.float32),
    )
    send(recording, f"{root}/lights", at, columns.partition([count] * len(at)))
