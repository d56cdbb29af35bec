"""A recorded scene, as every loader and the procedural generator hand it over.

Units are metres, radians, metres per second and seconds; the frame is the map's,
x east and y north for WOMD, yaw counter-clockwise from x. Arrays are ragged from
scene to scene: `sim.bank` makes fixed tables of them. Definitions follow the Waymo
Open Motion Dataset's `scenario.proto` and `map.proto`, whose conventions the other
formats are converted to.
"""

import enum
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int


class SceneError(Exception):
    """A scene file cannot be read; the message says what, where and what to do."""


class ObjectType(enum.IntEnum):
    """WOMD's `Track.ObjectType`."""

    UNSET = 0
    VEHICLE = 1
    PEDESTRIAN = 2
    CYCLIST = 3
    OTHER = 4


class RoadKind(enum.IntEnum):
    """What a polyline is. Numbers are WOMD's road-graph type ids (`tf.Example`)."""

    LANE_UNKNOWN = 0
    LANE_FREEWAY = 1
    LANE_STREET = 2
    LANE_BIKE = 3
    LINE_UNKNOWN = 5
    LINE_BROKEN_WHITE = 6
    LINE_SOLID_WHITE = 7
    LINE_DOUBLE_WHITE = 8
    LINE_BROKEN_YELLOW = 9
    LINE_BROKEN_DOUBLE_YELLOW = 10
    LINE_SOLID_YELLOW = 11
    LINE_SOLID_DOUBLE_YELLOW = 12
    LINE_PASSING_DOUBLE_YELLOW = 13
    EDGE_UNKNOWN = 14
    EDGE_BOUNDARY = 15
    EDGE_MEDIAN = 16
    STOP_SIGN = 17
    CROSSWALK = 18
    SPEED_BUMP = 19
    DRIVEWAY = 20

    @property
    def is_lane(self) -> bool:
        """Whether this is a lane's centre line."""
        return self <= RoadKind.LANE_BIKE

    @property
    def is_edge(self) -> bool:
        """Whether this bounds the drivable surface (which lies on its left)."""
        return RoadKind.EDGE_UNKNOWN <= self <= RoadKind.EDGE_MEDIAN


class LightState(enum.IntEnum):
    """WOMD's `TrafficSignalLaneState.State`."""

    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


@dataclass(frozen=True)
class Polyline:
    """One map feature. Polygons (crosswalk, bump, driveway) repeat no point."""

    kind: RoadKind
    points: Float[np.ndarray, "points 3"]  # m; a stop sign has one point
    feature_id: int = -1  # the source's id, -1 where it has none
    entry_lanes: tuple[int, ...] = ()  # lanes only: feature ids
    exit_lanes: tuple[int, ...] = ()
    speed_limit: float = 0.0  # m/s, 0 where unknown
    stop_lanes: tuple[int, ...] = ()  # stop signs only: feature ids of their lanes


@dataclass(frozen=True)
class LanePath:
    """One way that the SDC could have gone: a path sample of WOMD 1.3.1."""

    points: Float[np.ndarray, "points 3"]  # m, along the lanes' centres
    on_route: bool  # whether the recorded drive went along it


@dataclass(frozen=True)
class TrafficLights:
    """The lights of a scene: a state per controlled lane and step."""

    lane_ids: Int[np.ndarray, " lights"]
    stop_points: Float[np.ndarray, "lights 3"]  # m
    states: Int[np.ndarray, "lights steps"]  # `LightState`


def no_lights(steps: int) -> TrafficLights:
    """A scene without traffic lights."""
    return TrafficLights(
        np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, steps), np.int64)
    )


@dataclass(frozen=True)
class Scene:
    """One recorded scene. Values where `valid` is False mean nothing."""

    scenario_id: str
    dt: float  # s between steps
    current_step: int  # the first step that an agent acts at; before it is history
    sdc_index: int  # the recording vehicle's row
    object_ids: Int[np.ndarray, " objects"]
    object_types: Int[np.ndarray, " objects"]  # `ObjectType`
    position: Float[np.ndarray, "objects steps 3"]  # m, the box's centre
    yaw: Float[np.ndarray, "objects steps"]  # rad
    velocity: Float[np.ndarray, "objects steps 2"]  # m/s
    size: Float[np.ndarray, "objects steps 3"]  # m: length, width, height
    valid: Bool[np.ndarray, "objects steps"]
    roads: tuple[Polyline, ...]
    lights: TrafficLights
    tracks_to_predict: tuple[int, ...] = ()
    objects_of_interest: tuple[int, ...] = ()  # rows, as tracks_to_predict
    sdc_paths: tuple[LanePath, ...] = ()  # none where the source has no samples
    left_out: int = 0  # map features of an unknown kind or without points
    source: str = field(default="", compare=False)  # file and record, for messages

    @property
    def objects(self) -> int:
        """Number of objects."""
        return int(self.valid.shape[0])

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return int(self.valid.shape[1])
