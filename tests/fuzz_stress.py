"""Large but sound files of each format: 1,000 objects on a map of 10^6 points.

The map is a square kilometre of parallel roads along x, each polyline with 2,300
points, that sway by 5 cm, as recorded ones do.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests import records, records_argoverse2

OBJECTS, STEPS = 1000, 91
LINES, POINTS = 500, 2300


def _x() -> np.ndarray:
    """The points' places along each polyline [m]."""
    return np.linspace(0.0, 999.0, POINTS)


def _y(line: int) -> np.ndarray:
    """How far aside a polyline's points are [m]."""
    return 2.0 * line + 0.05 * np.sin(_x() / 15.0)


def _lines() -> Iterator[tuple[int, list[tuple[float, float, float]]]]:
    """Kind (0 and 4: edges, on either side of a road) and points of each polyline."""
    x = _x()
    for line in range(LINES):
        xyz = np.stack([x, _y(line), np.zeros(POINTS)], -1)
        kind = line % 5
        yield kind, [tuple(point) for point in (xyz[::-1] if kind == 4 else xyz)]


def _start(index: int) -> tuple[float, float]:
    """Where an object starts: 40 by 25 of them over the map [m]."""
    return 20.0 * (index % 40) + 10.0, 40.0 * (index // 40) + 4.0


def scenario(folder: Path) -> Path:
    """A WOMD `Scenario`."""
    message = records.scenario(objects=OBJECTS, steps=STEPS)
    for index, track in enumerate(message.tracks):
        x, y = _start(index)
        for step, state in enumerate(track.states):
            state.center_x, state.center_y = x + 0.5 * step, y
    message.ClearField("map_features")
    for index, (kind, points) in enumerate(_lines()):
        feature = message.map_features.add(id=index)
        name = ("road_edge", "road_line", "lane", "road_line", "road_edge")[kind]
        part = getattr(feature, name)
        part.type = 1
        for x, y, z in points:
            part.polyline.add(x=x, y=y, z=z)
    path = folder / "large.tfrecord"
    records.write_tfrecord(path, [message.SerializeToString()])
    return path


def example(folder: Path) -> Path:
    """A flat example with path samples."""
    features = records.with_paths(
        records.example(slots=OBJECTS + 1, past=10, future=80)
    )
    for period, first, count in (
        ("past", 0, 10),
        ("current", 10, 1),
        ("future", 11, 80),
    ):
        starts = np.array([_start(index) for index in range(OBJECTS + 1)])
        steps = np.arange(first, first + count)
        x = starts[:, :1] + 0.5 * steps
        features[f"state/{period}/x"] = x.ravel().tolist()
        y = np.repeat(starts[:, 1], count)
        features[f"state/{period}/y"] = y.tolist()
    types = (15, 6, 2, 7, 15)
    lines = list(_lines())
    features |= {
        "roadgraph_samples/xyz": [v for _, points in lines for p in points for v in p],
        "roadgraph_samples/type": [types[kind] for kind, _ in lines for _ in _x()],
        "roadgraph_samples/id": [i for i in range(LINES) for _ in _x()],
        "roadgraph_samples/valid": [1] * (LINES * POINTS),
    }
    path = folder / "large.tfrecord"
    records.write_tfrecord(path, [records.encode_example(features)])
    return path


def gpudrive(folder: Path) -> Path:
    """GPUDrive's JSON."""
    content = records.gpudrive(objects=OBJECTS, steps=STEPS)
    for index, track in enumerate(content["objects"]):
        x, y = _start(index)
        track["position"] = [
            {"x": x + 0.5 * step, "y": y, "z": 1.0} for step in range(STEPS)
        ]
    types = (15, 6, 2, 7, 15)
    content["roads"] = [
        {
            "geometry": [{"x": x, "y": y, "z": z} for x, y, z in points],
            "type": "lane",
            "map_element_id": types[kind],
            "id": index,
        }
        for index, (kind, points) in enumerate(_lines())
    ]
    path = folder / "large.json"
    path.write_text(json.dumps(content))
    return path


def argoverse2(folder: Path) -> Path:
    """Argoverse 2's Parquet and map."""
    rows = [(index, step) for index in range(OBJECTS) for step in range(STEPS)]
    starts = [_start(index) for index in range(OBJECTS)]
    constant = {
        "object_type": "vehicle",
        "object_category": 1,
        "heading": 0.0,
        "velocity_x": 5.0,
        "velocity_y": 0.0,
        "scenario_id": records_argoverse2.LOG,
        "focal_track_id": "0",
    }
    table: dict[str, list] = {
        "track_id": [str(index) for index, _ in rows],
        "timestep": [step for _, step in rows],
        "observed": [step < 50 for _, step in rows],
        "position_x": [starts[index][0] + 0.5 * step for index, step in rows],
        "position_y": [starts[index][1] for index, _ in rows],
        **{name: [value] * len(rows) for name, value in constant.items()},
    }
    return records_argoverse2.write(folder, table, _map())


def _map() -> dict[str, Any]:
    """Lanes between each second pair of polylines, 200 marks, and 100 areas."""
    lines = [
        [
            {"x": x, "y": y, "z": z}
            for x, y, z in zip(_x(), _y(i), 0 * _x(), strict=True)
        ]
        for i in range(LINES)
    ]
    lanes = {
        str(i): {
            "id": i,
            "lane_type": "VEHICLE",
            "left_lane_boundary": lines[i + 1],
            "right_lane_boundary": lines[i],
            "left_lane_mark_type": "SOLID_WHITE" if i < 390 else "NONE",
        }
        for i in range(0, LINES, 2)
    }
    areas = {
        str(i): {"area_boundary": lines[i] + lines[i + 4][::-1]}
        for i in range(0, LINES, 5)
    }
    return {"lane_segments": lanes, "drivable_areas": areas}


STRESS: dict[str, Callable[[Path], Path]] = {
    "large scenario": scenario,
    "large example": example,
    "large gpudrive": gpudrive,
    "large argoverse2": argoverse2,
}
