"""Argoverse 2 scenarios: the real one, a hand-made one, and damaged ones."""

import json
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from sim.formats import Format, bad_records, detect, list_files, read_scenes
from sim.scene import ObjectType, RoadKind, Scene, SceneError
from tests import oracle
from tests import records_argoverse2 as records

REAL = "0a1e6f0a-1817-4a98-b02e-db8c9327d151"


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """The hand-made scenario."""
    (scene,) = read_scenes([records.write(tmp_path)])
    return scene


def _of(scene: Scene, *kinds: RoadKind) -> list[np.ndarray]:
    return [road.points for road in scene.roads if road.kind in kinds]


def test_the_real_scenario(scenes_data: Path) -> None:
    folder = scenes_data / "argoverse2"
    (scene,) = read_scenes([folder])
    assert scene.scenario_id == REAL
    assert (scene.objects, scene.steps, scene.current_step) == (58, 110, 49)
    assert (int(scene.valid.sum()), scene.dt) == (2434, 0.1)
    assert scene.valid[scene.sdc_index].all()
    kinds = Counter(road.kind for road in scene.roads)
    assert (kinds[RoadKind.LANE_STREET], kinds[RoadKind.LANE_BIKE]) == (34, 37)
    assert kinds[RoadKind.CROSSWALK] == 6
    lanes = {road.feature_id: road for road in scene.roads if road.kind.is_lane}
    joined = [
        (lane, lanes[after])
        for lane in lanes.values()
        for after in lane.exit_lanes
        if after in lanes
    ]
    assert len(joined) > 50
    for lane, after in joined:
        assert np.abs(lane.points[-1] - after.points[0]).max() < 0.5
        assert lane.feature_id in after.entry_lanes


def test_the_real_cars_stay_on_the_real_road(scenes_data: Path) -> None:
    """Outside the drivable areas, or on a border, and nowhere else, is off the road."""
    (scene,) = read_scenes([scenes_data / "argoverse2"])
    speed = np.hypot(scene.velocity[..., 0], scene.velocity[..., 1])
    moving = scene.valid & (speed > 1)
    moving &= scene.object_types[:, None] == ObjectType.VEHICLE
    corners = oracle.scene_corners(scene)[moving]
    heights = np.repeat(scene.position[moving][:, 2], 4)
    wrong = oracle.corners_offroad(
        corners.reshape(-1, 2), heights, oracle.road_edges(scene)
    ).reshape(-1, 4)
    content = json.loads(
        (scenes_data / "argoverse2" / f"log_map_archive_{REAL}.json").read_text()
    )
    areas = shapely.union_all(
        [
            shapely.Polygon([(p["x"], p["y"]) for p in area["area_boundary"]])
            for area in content["drivable_areas"].values()
        ]
    )
    inside = shapely.contains_xy(areas, corners.reshape(-1, 2)).reshape(-1, 4)
    # Where the map goes on is not known beyond its cuts: there the road may, too.
    assert not (wrong & inside).any()
    assert wrong.any(axis=1).mean() < 0.2
    sdc = np.broadcast_to(
        np.arange(scene.objects)[:, None] == scene.sdc_index, moving.shape
    )[moving]
    assert sdc.sum() > 20 and not wrong[sdc].any()


def test_velocities_are_the_positions_derivative(scenes_data: Path) -> None:
    (scene,) = read_scenes([scenes_data / "argoverse2"])
    both = scene.valid[:, 1:] & scene.valid[:, :-1]
    moved = np.diff(scene.position[..., :2], axis=1) / scene.dt
    error = np.linalg.norm(moved - scene.velocity[:, 1:], axis=-1)[both]
    assert np.median(error) < 0.2


def test_every_column_arrives(scene: Scene) -> None:
    assert scene.scenario_id == records.LOG
    assert (scene.objects, scene.steps, scene.current_step) == (4, 20, 9)
    assert scene.sdc_index == 1
    assert scene.object_ids.tolist() == [7, -2, 31, 8]  # "AV" is no number
    assert scene.object_types.tolist() == [
        ObjectType.VEHICLE,
        ObjectType.VEHICLE,
        ObjectType.PEDESTRIAN,
        ObjectType.OTHER,
    ]
    assert scene.tracks_to_predict == (2, 0)  # the focal one, then the scored
    assert scene.objects_of_interest == (2,)
    assert scene.valid.sum(axis=1).tolist() == [20, 20, 10, 1]
    np.testing.assert_allclose(scene.velocity[0, 3], [5.0, 0.0])
    np.testing.assert_allclose(scene.size[1, 0], [4.9, 1.9, 1.5])
    np.testing.assert_allclose(scene.position[0, 4, :2], [2.0, -4.0])
    assert not scene.position[2, 10:].any()


def test_objects_stand_on_the_ground(scene: Scene) -> None:
    """Half their height above the nearest point that the map has."""
    ground = scene.position[..., 2] - scene.size[..., 2] / 2
    error = ground - 0.01 * scene.position[..., 0]
    assert np.abs(error[scene.valid]).max() < 0.02


def test_lanes_run_between_their_boundaries(scene: Scene) -> None:
    lane, bike = (road for road in scene.roads if road.kind.is_lane)
    assert (lane.kind, lane.feature_id) == (RoadKind.LANE_STREET, 1)
    assert (lane.entry_lanes, lane.exit_lanes) == ((4, 5), (3,))
    np.testing.assert_allclose(lane.points[:, 1], -4.0)
    np.testing.assert_allclose(lane.points[[0, -1], 0], [-47.0, 80.0])
    np.testing.assert_allclose(lane.points[:, 2], 0.01 * lane.points[:, 0], atol=1e-9)
    assert np.diff(lane.points[:, 0]).max() < 2.1
    assert bike.kind is RoadKind.LANE_BIKE
    # The file's own centre line, whose heights of 0 are the boundaries' here.
    np.testing.assert_allclose(bike.points[:, :2], [[-47, -8], [0, -8], [80, -8]])


def test_a_shared_boundary_is_one_line(scene: Scene) -> None:
    white = _of(scene, RoadKind.LINE_SOLID_WHITE)
    assert [points[:, 1].tolist() for points in white] == [[-6, -6]]
    assert len(_of(scene, RoadKind.LINE_UNKNOWN)) == 1  # the blue one


def test_a_crossing_is_a_simple_polygon(scene: Scene) -> None:
    (points,) = _of(scene, RoadKind.CROSSWALK)
    assert points[:, :2].tolist() == [[40, -6], [40, 6], [43, 6], [43, -6]]


def test_areas_become_one_road(scene: Scene) -> None:
    """No edge between two areas, none where the map is cut, the road on the left."""
    (outer,) = _of(scene, RoadKind.EDGE_BOUNDARY)
    (island,) = _of(scene, RoadKind.EDGE_MEDIAN)
    assert outer[[0, -1], :2].tolist() == [[80, 6], [80, -6]]
    assert {-47.0, 80.0} <= set(outer[:, 0].tolist()) <= {-47.0, 20.0, 63.0, 80.0}
    np.testing.assert_allclose(outer[:, 2], 0.01 * outer[:, 0], atol=0.02)
    assert np.abs(island[:, 1]).max() == pytest.approx(1.0)
    np.testing.assert_allclose(island[0], island[-1])
    points = {
        "on the road": ([-40, 0], [19, 0], [21, 1.5], [20, 3], [63, -3], [79, 5]),
        "beyond the cut": ([90, 0], [120, 5]),
        "off the road": ([-48, 0], [0, 7], [30, -7], [79, -6.1]),
        "on the island": ([21, 0.5], [40, 0], [62.5, -0.9]),
    }
    for place, xy in points.items():
        wrong = oracle.corners_offroad(
            np.array(xy, float), np.zeros(len(xy)), oracle.road_edges(scene)
        )
        assert wrong.tolist() == [place.startswith(("off", "on the i"))] * len(xy), (
            place
        )


def test_a_gap_between_areas_is_closed(tmp_path: Path) -> None:
    content = records.map_content()
    for corner in content["drivable_areas"]["50"]["area_boundary"][2:]:
        corner["x"] -= 0.06
    (scene,) = read_scenes([records.write(tmp_path, None, content)])
    assert len(_of(scene, RoadKind.EDGE_BOUNDARY)) == 1


def test_the_test_split_has_no_future(tmp_path: Path) -> None:
    table = records.columns(steps=10, observed=10)
    (scene,) = read_scenes([records.write(tmp_path, table)])
    assert (scene.steps, scene.current_step) == (10, 8)


def test_without_the_vehicle_the_focal_track_records(tmp_path: Path) -> None:
    table = records.columns()
    table["track_id"] = [name.replace("AV", "55") for name in table["track_id"]]
    (scene,) = read_scenes([records.write(tmp_path, table)])
    assert scene.object_ids[scene.sdc_index] == 31


def test_a_folder_lists_the_scenario_alone(tmp_path: Path) -> None:
    path = records.write(tmp_path / "a")
    skipped: list[str] = []
    assert list_files([tmp_path], on_skip=skipped.append) == [path]
    assert skipped == []
    assert detect(path) is Format.ARGOVERSE2
    assert detect(next(path.parent.glob("*.json"))) is Format.ARGOVERSE2_MAP


def test_a_map_by_itself_is_refused(tmp_path: Path) -> None:
    path = records.write(tmp_path)
    (problem,) = bad_records(list(tmp_path.glob("*.json")))
    assert "give the scenario's Parquet file" in problem
    path.unlink()
    with pytest.raises(SceneError, match="no scene in this folder"):
        list_files([tmp_path])


def test_a_missing_map_is_named(tmp_path: Path) -> None:
    path = records.write(tmp_path)
    (tmp_path / f"log_map_archive_{records.LOG}.json").unlink()
    expected = f"log_map_archive_{records.LOG}.json is not in {tmp_path}; put it there"
    with pytest.raises(SceneError, match=re.escape(expected)):
        list(read_scenes([path]))


def _column(name: str, row: int, value: object) -> Any:
    """A change of one cell."""

    def change(table: dict[str, list], content: dict[str, Any]) -> None:
        table[name][row] = value

    return change


def _drop(name: str) -> Any:
    return lambda table, content: table.pop(name)


def _map(value: Any, *keys: str | int) -> Any:
    """A change of the map at a path of keys."""

    def change(table: dict[str, list], content: dict[str, Any]) -> None:
        place: Any = content
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


BOUNDARY = ("drivable_areas", "50", "area_boundary")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (_drop("heading"), "Parquet without an Argoverse 2 scenario's columns"),
        (_column("timestep", 3, 2), "track 0 has two states at step 2"),
        (_column("timestep", 3, -1), "timesteps -1 to 19, expected 0"),
        (_column("timestep", 3, 10**12), "to 1000000000000, expected 0"),
        (_column("position_x", 0, float("nan")), "object 0 at step 0: position"),
        (_column("heading", 0, float("inf")), "object 0 at step 0: yaw"),
        (_column("velocity_x", 0, None), "column 'velocity_x' has 1 empty cells"),
        (_column("track_id", 0, None), "column 'track_id' has 1 empty cells"),
        (
            lambda table, _: table.update(position_y=["x"] * 51),
            "column 'position_y': Failed to parse string",
        ),
        (_column("scenario_id", 0, "../x"), "its map log_map_archive_<scenario id>"),
        (
            lambda table, _: table.update(
                track_id=["1"] * 51, timestep=list(range(51)), focal_track_id=["2"] * 51
            ),
            "neither the track 'AV' nor the focal track is there",
        ),
        (_map([], "lane_segments", "1", "left_lane_boundary"), "segment 1 lacks a b"),
        (_map([], "pedestrian_crossings", "9", "edge1"), "crossing 9 lacks an edge"),
        (_map({"x": 1e12, "y": 0}, *BOUNDARY, 0), "not finite or beyond"),
        (_map("x", *BOUNDARY), "not an Argoverse 2 map: Expected `array`"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, change: Any, problem: str) -> None:
    table, content = records.columns(), records.map_content()
    change(table, content)
    path = records.write(tmp_path, table, content)
    (line,) = bad_records([path])
    assert problem in line and "\n" not in line
    assert line.startswith(str(tmp_path))


def test_a_cut_file_is_named(tmp_path: Path) -> None:
    path = records.write(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    (line,) = bad_records([tmp_path])
    assert f"truncated at byte {len(whole) - 20}" in line


def test_a_map_may_be_empty(tmp_path: Path) -> None:
    content = {"lane_segments": {}, "drivable_areas": {}}
    (scene,) = read_scenes([records.write(tmp_path, None, content)])
    assert scene.roads == ()
    np.testing.assert_allclose(scene.position[1, 0, 2], 0.75)  # half the AV's height


def test_the_libraries_wait_for_such_a_file() -> None:
    """Whoever reads other formats does not pay for pyarrow and shapely."""
    program = (
        "import sys, sim.formats; "
        "sys.exit(bool({'pyarrow', 'shapely'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
