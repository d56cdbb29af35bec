"""A small Argoverse 2 scenario, for tests that need no data.

The road lies along x, 12 m wide, from -47 to 80 m, in four areas whose tiles meet at
x = 20 and x = 63; between the last of these it goes around an island. The map is cut at
x = 80, and the ground rises by a hundredth of x.
"""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

LOG = "0a-b1"


def point(x: float, y: float) -> dict[str, float]:
    """A point on the ground."""
    return {"x": x, "y": y, "z": 0.01 * x}


def line(*points: tuple[float, float]) -> list[dict[str, float]]:
    """Points on the ground."""
    return [point(*p) for p in points]


def _box(x0: float, x1: float, y0: float, y1: float) -> dict[str, Any]:
    """A rectangular area, clockwise as drawn by some."""
    return {"area_boundary": line((x0, y0), (x0, y1), (x1, y1), (x1, y0))}


def _lane(number: int, y: float, **changes: Any) -> dict[str, Any]:
    """A lane along x, 4 m wide, around y."""
    return {
        "id": number,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": line((-47, y + 2), (20, y + 2), (80, y + 2)),
        "left_lane_mark_type": "NONE",
        "left_neighbor_id": None,
        "right_lane_boundary": line((-47, y - 2), (80, y - 2)),
        "right_lane_mark_type": "SOLID_WHITE",
        "right_neighbor_id": None,
        "predecessors": [],
        "successors": [],
    } | changes


def map_content() -> dict[str, Any]:
    """The map file's content."""
    areas = (
        _box(-47, 20, -6, 6),
        _box(20, 63, -6, -1),
        _box(20, 63, 1, 6),
        _box(63, 80, -6, 6),
    )
    return {
        "drivable_areas": {
            str(i): area | {"id": i} for i, area in enumerate(areas, 50)
        },
        "lane_segments": {
            "1": _lane(1, -4, successors=[3], predecessors=[4, 5]),
            "2": _lane(
                2,
                -8,
                lane_type="BIKE",
                left_lane_boundary=line((80, -6), (-47, -6)),
                left_lane_mark_type="SOLID_WHITE",
                right_lane_mark_type="SOLID_BLUE",
                centerline=[{"x": x, "y": -8.0, "z": 0.0} for x in (-47, 0, 80)],
            ),
        },
        "pedestrian_crossings": {
            "9": {
                "id": 9,
                "edge1": line((40, -6), (40, 6)),
                "edge2": line((43, 6), (43, -6)),
            }
        },
    }


def columns(*, steps: int = 20, observed: int = 10) -> dict[str, list]:
    """The table by column: a scored car, the AV, a pedestrian of the first half."""
    tracks = (
        ("7", "vehicle", 2, steps, -4.0),
        ("AV", "vehicle", 1, steps, 0.0),
        ("31", "pedestrian", 3, steps // 2, 5.0),
        ("8", "static", 0, 1, 5.5),
    )
    rows = [
        {
            "observed": step < observed,
            "track_id": name,
            "object_type": kind,
            "object_category": category,
            "timestep": step,
            "position_x": 0.5 * step,
            "position_y": y,
            "heading": 0.0,
            "velocity_x": 5.0,
            "velocity_y": 0.0,
            "scenario_id": LOG,
            "focal_track_id": "31",
            "num_timestamps": steps,
            "city": "austin",
        }
        for name, kind, category, seen, y in tracks
        for step in range(seen)
    ]
    return {name: [row[name] for row in rows] for name in rows[0]}


def write(
    folder: Path,
    table: dict[str, list] | None = None,
    content: dict[str, Any] | None = None,
) -> Path:
    """Writes both files as the data set names them; returns the table's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"scenario_{LOG}.parquet"
    parquet.write_table(pa.table(columns() if table is None else table), path)
    content = map_content() if content is None else content
    (folder / f"log_map_archive_{LOG}.json").write_text(json.dumps(content))
    return path
