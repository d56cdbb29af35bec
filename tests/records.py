"""Small scenes in each file format, for tests that need no data."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sim.tfrecord import frame
from sim.womd import MESSAGES
from sim.womd_example import MESSAGES as EXAMPLE_MESSAGES


def scenario(*, objects: int = 2, steps: int = 12, name: str = "abc") -> Any:
    """A WOMD `Scenario` of cars side by side that drive along x at 5 m/s."""
    message: Any = MESSAGES["Scenario"]()
    message.scenario_id = name.encode()
    message.timestamps_seconds.extend(0.1 * step for step in range(steps))
    message.current_time_index = min(10, steps - 1)
    message.sdc_track_index = objects - 1
    message.tracks_to_predict.add(track_index=0)
    message.objects_of_interest.extend([100 + objects - 1, 100])
    for index in range(objects):
        _add_track(message, index, steps)
    _add_map(message)
    for step in range(steps):
        lights = message.dynamic_map_states.add()
        if step % 2 == 0:
            light = lights.lane_states.add(lane=1, state=4)
            light.stop_point.x, light.stop_point.y = 30.0, 0.0
    return message


def _add_track(message: Any, index: int, steps: int) -> None:
    """Adds one car, which is not seen at the second step."""
    track = message.tracks.add(id=100 + index, object_type=1)
    for step in range(steps):
        track.states.add(
            center_x=0.5 * step,
            center_y=3.5 * index,
            center_z=1.0,
            length=4.5,
            width=2.0,
            height=1.5,
            heading=0.0,
            velocity_x=5.0,
            velocity_y=0.0,
            valid=step != 1,
        )


def _add_map(message: Any) -> None:
    """Adds one feature of each kind."""
    corners = ((20.0, 0.0), (24.0, 0.0), (24.0, 7.0), (20.0, 7.0))
    lane = message.map_features.add(id=1).lane
    lane.speed_limit_mph, lane.type = 25.0, 2
    lane.entry_lanes.append(7)
    lane.exit_lanes.extend([8, 9])
    edge = message.map_features.add(id=2).road_edge
    edge.type = 2
    line = message.map_features.add(id=3).road_line
    line.type = 8
    for x in (-10.0, 30.0, 60.0):
        lane.polyline.add(x=x, y=0.0, z=0.0)
        edge.polyline.add(x=x, y=-2.0, z=0.0)
        line.polyline.add(x=x, y=1.75, z=0.0)
    sign = message.map_features.add(id=4).stop_sign
    sign.position.x, sign.position.y = 30.0, -3.0
    sign.lane.append(1)
    for index, kind in enumerate(("crosswalk", "speed_bump", "driveway")):
        feature = getattr(message.map_features.add(id=5 + index), kind)
        for x, y in (*corners, corners[0]):
            feature.polygon.add(x=x, y=y, z=0.0)


def write_tfrecord(path: Path, payloads: Iterable[bytes]) -> list[int]:
    """Writes frames; returns the offset of each and, last, the file's size."""
    frames = [frame(payload) for payload in payloads]
    path.write_bytes(b"".join(frames))
    offsets = [0]
    for one in frames:
        offsets.append(offsets[-1] + len(one))
    return offsets


def gpudrive(*, objects: int = 2, steps: int = 12) -> dict[str, Any]:
    """The same scene as GPUDrive's JSON."""
    seen = [step != 1 for step in range(steps)]
    lost = -10000.0
    points = [{"x": x, "y": -2.0, "z": 0.0} for x in (-10.0, 30.0, 60.0)]
    return {
        "name": "scene.json",
        "scenario_id": "abc",
        "objects": [
            {
                "position": [
                    {"x": 0.5 * step, "y": 3.5 * index, "z": 1.0}
                    if ok
                    else {"x": lost, "y": lost, "z": lost}
                    for step, ok in enumerate(seen)
                ],
                "heading": [0.0 if ok else lost for ok in seen],
                "velocity": [
                    {"x": 5.0, "y": 0.0} if ok else {"x": lost, "y": lost}
                    for ok in seen
                ],
                "valid": list(seen),
                "length": 4.5,
                "width": 2.0,
                "height": 1.5,
                "type": "vehicle",
                "id": 100 + index,
            }
            for index in range(objects)
        ],
        "roads": [
            {"geometry": points, "type": "road_edge", "map_element_id": 16, "id": 2},
            {"geometry": points[:1], "type": "stop_sign", "id": 4},
        ],
        "tl_states": {
            "1": {
                "state": ["stop", "go"],
                "x": [30.0, 30.0],
                "y": [0.0, 0.0],
                "z": [0.0, 0.0],
                "time_index": [0, 2],
            }
        },
        "metadata": {
            "sdc_track_index": objects - 1,
            "tracks_to_predict": [{"track_index": 0, "difficulty": 0}],
            "objects_of_interest": [100 + objects - 1, 100],
        },
    }


def write_json(path: Path, content: Any) -> None:
    """Writes JSON over several lines."""
    path.write_text(json.dumps(content, indent=1))


def example(*, slots: int = 3, past: int = 2, future: int = 3) -> dict[str, Any]:
    """The same scene as a flat example: two cars and an empty slot."""
    cars = slots - 1
    features: dict[str, Any] = {
        "scenario/id": b"abc",
        "state/id": [100.0 + i for i in range(cars)] + [-1.0],
        "state/type": [1.0] * cars + [-1.0],
        "state/is_sdc": [0] * (cars - 1) + [1, -1],
        "state/tracks_to_predict": [1] + [0] * (cars - 1) + [-1],
        "state/objects_of_interest": [1] * cars + [-1],
        "roadgraph_samples/valid": [1, 1, 1, 1, 0],
        "roadgraph_samples/id": [2, 2, 2, 3, -1],
        "roadgraph_samples/type": [16, 16, 16, 7, -1],
        "roadgraph_samples/xyz": [
            *(-10.0, -2.0, 0.0, 30.0, -2.0, 0.0, 60.0, -2.0, 0.0),
            *(0.0, 1.75, 0.0, -1.0, -1.0, -1.0),
        ],
    }
    start = 0
    for period, count in (("past", past), ("current", 1), ("future", future)):
        steps = range(start, start + count)
        start += count
        constants = {
            **{"y": None, "z": 1.0, "bbox_yaw": 0.0, "velocity_x": 5.0},
            **{"velocity_y": 0.0, "length": 4.5, "width": 2.0, "height": 1.5},
        }
        group = f"state/{period}"
        features[f"{group}/valid"] = [
            int(i < cars) for i in range(slots) for _ in steps
        ]
        features[f"{group}/x"] = [0.5 * s for _ in range(slots) for s in steps]
        for name, value in constants.items():
            features[f"{group}/{name}"] = [
                3.5 * i if value is None else value for i in range(slots) for _ in steps
            ]
        group = f"traffic_light_state/{period}"
        # Two slots, of which the lane that is seen changes over to the other.
        features[f"{group}/valid"] = [int(s % 2 == j) for s in steps for j in (0, 1)]
        features[f"{group}/id"] = [
            1 if s % 2 == j else -1 for s in steps for j in (0, 1)
        ]
        features[f"{group}/state"] = [4 for _ in steps for _ in (0, 1)]
        for axis, value in (("x", 30.0), ("y", 0.0), ("z", 0.0)):
            features[f"{group}/{axis}"] = [value for _ in steps for _ in (0, 1)]
    return features


def with_paths(features: dict[str, Any]) -> dict[str, Any]:
    """Adds path samples: one on the route, one off it, an empty slot; 3 points each."""
    xs = (0.0, 10.0, 20.0)
    valid = [[1, 1, 0], [1, 1, 1], [0, 0, 0]]
    points = [(x, 3.5 * lane, 1.0) for lane in range(3) for x in xs]
    return features | {
        "path_samples/xyz": [value for point in points for value in point],
        "path_samples/valid": [flag for path in valid for flag in path],
        "path_samples/id": [1] * 3 + [7] * 3 + [-1] * 3,
        "path_samples/arc_length": [*xs, *xs, *xs],
        "path_samples/on_route": [1, 0, -1],
    }


def encode_example(features: dict[str, Any]) -> bytes:
    """Serialises a flat example."""
    message: Any = EXAMPLE_MESSAGES["Example"]()
    for name, values in features.items():
        entry = message.features.feature.add(key=name.encode())
        if isinstance(values, bytes):
            entry.value.bytes_list.value.append(values)
        elif any(isinstance(value, float) for value in values):
            entry.value.float_list.value.extend(values)
        else:
            entry.value.int64_list.value.extend(values)
    return bytes(message.SerializeToString())
