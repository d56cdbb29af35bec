"""WOMD records: the real ones, hand-made ones, and damaged ones."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.formats import Format, detect, read_scenes
from sim.scene import LightState, ObjectType, RoadKind, Scene, SceneError
from sim.tfrecord import Record, read_records
from sim.validate import check_scene
from sim.womd import parse_scenario
from sim.womd_example import is_example, parse_example
from tests import oracle, records


def _parse(message: Any) -> Scene:
    return parse_scenario(message.SerializeToString(), source="made.tfrecord")


def test_the_real_scenario(scenes_data: Path) -> None:
    path = scenes_data / "womd" / "motion_data_one_scenario.tfrecord"
    assert detect(path) is Format.WOMD_SCENARIO
    (scene,) = read_scenes([path])
    assert scene.scenario_id == "637f20cafde22ff8"
    assert (scene.objects, scene.steps, scene.current_step) == (83, 91, 10)
    assert (scene.sdc_index, scene.dt) == (82, 0.1)
    assert scene.valid[scene.sdc_index].all()
    lanes = [road for road in scene.roads if road.kind.is_lane]
    assert (len(lanes), sum(bool(lane.exit_lanes) for lane in lanes)) == (199, 167)
    assert max(lane.speed_limit for lane in lanes) < 35  # m/s, not miles per hour
    kinds = Counter(road.kind for road in scene.roads if not road.kind.is_lane)
    assert sum(kinds[k] for k in kinds if k.is_edge) == 28
    lines = [k for k in kinds if k.name.startswith("LINE")]
    assert sum(kinds[k] for k in lines) == 59
    assert kinds[RoadKind.CROSSWALK] == 4
    assert kinds[RoadKind.STOP_SIGN] == 8
    assert kinds[RoadKind.SPEED_BUMP] == 3
    # 1,092 states are 12 lights at each of 91 steps.
    assert scene.lights.states.shape == (12, 91)
    ids = {lane.feature_id for lane in lanes}
    signs = [road for road in scene.roads if road.kind is RoadKind.STOP_SIGN]
    named = [lane for sign in signs for lane in sign.stop_lanes]
    assert len(named) == 8 and set(named) <= ids  # five signs name none
    assert scene.sdc_paths == ()
    assert set(scene.lights.lane_ids.tolist()) <= ids


def test_velocities_are_the_positions_derivative(scenes_data: Path) -> None:
    """Holds units, the order of axes and the step length of each format together."""
    for scene in read_scenes([scenes_data / "womd", scenes_data / "gpudrive"]):
        both = scene.valid[:, 1:] & scene.valid[:, :-1]
        moved = np.diff(scene.position[..., :2], axis=1) / scene.dt
        error = np.linalg.norm(moved - scene.velocity[:, 1:], axis=-1)[both]
        assert np.median(error) < 0.2
        fast = both & (np.linalg.norm(scene.velocity[:, 1:], axis=-1) > 3)
        heading = np.arctan2(scene.velocity[:, 1:, 1], scene.velocity[:, 1:, 0])
        turned = np.abs(np.angle(np.exp(1j * (heading - scene.yaw[:, 1:]))))
        assert np.median(turned[fast]) < 0.1


def test_the_recording_car_stays_on_the_road(scenes_data: Path) -> None:
    """Road edges have the drivable side on their left, in every format."""
    for scene in read_scenes([scenes_data / "womd", scenes_data / "gpudrive"]):
        boxes = oracle.scene_corners(scene)[scene.sdc_index]
        heights = np.repeat(scene.position[scene.sdc_index, :, 2], 4)
        edges = oracle.road_edges(scene)
        wrong = oracle.corners_offroad(boxes.reshape(-1, 2), heights, edges)
        assert not wrong.any(), scene.source


def test_every_field_arrives() -> None:
    scene = _parse(records.scenario())
    assert scene.scenario_id == "abc"
    assert (scene.dt, scene.current_step, scene.sdc_index) == (0.1, 10, 1)
    assert scene.object_ids.tolist() == [100, 101]
    assert scene.object_types.tolist() == [ObjectType.VEHICLE] * 2
    assert scene.valid.tolist() == [[s != 1 for s in range(12)]] * 2
    np.testing.assert_allclose(scene.position[1, 4], [2.0, 3.5, 1.0])
    np.testing.assert_allclose(scene.velocity[0, 3], [5.0, 0.0])
    np.testing.assert_allclose(scene.size[0, 0], [4.5, 2.0, 1.5])
    assert scene.tracks_to_predict == (0,)
    assert scene.objects_of_interest == (1, 0)
    assert scene.lights.lane_ids.tolist() == [1]
    assert scene.lights.states[0, :3].tolist() == [LightState.STOP, 0, LightState.STOP]
    np.testing.assert_allclose(scene.lights.stop_points, [[30.0, 0.0, 0.0]])


def test_every_map_feature_arrives() -> None:
    roads = {road.feature_id: road for road in _parse(records.scenario()).roads}
    kinds = {feature_id: road.kind for feature_id, road in roads.items()}
    assert kinds == {
        1: RoadKind.LANE_STREET,
        2: RoadKind.EDGE_MEDIAN,
        3: RoadKind.LINE_PASSING_DOUBLE_YELLOW,
        4: RoadKind.STOP_SIGN,
        5: RoadKind.CROSSWALK,
        6: RoadKind.SPEED_BUMP,
        7: RoadKind.DRIVEWAY,
    }
    assert (roads[1].entry_lanes, roads[1].exit_lanes) == ((7,), (8, 9))
    assert roads[4].stop_lanes == (1,)
    assert roads[1].speed_limit == pytest.approx(11.176)  # 25 mph
    assert roads[2].points.tolist() == [[-10, -2, 0], [30, -2, 0], [60, -2, 0]]
    assert len(roads[5].points) == 4  # the closing point is not repeated


def test_ids_of_interest_that_no_track_has_are_left_out() -> None:
    message = records.scenario()
    del message.objects_of_interest[:]
    message.objects_of_interest.extend([7, 101, 101])
    message.tracks_to_predict.add(track_index=0)
    scene = _parse(message)
    assert scene.objects_of_interest == (1,)
    assert scene.tracks_to_predict == (0,)  # named twice, controlled once


def test_invalid_states_are_masked() -> None:
    message = records.scenario()
    message.tracks[0].states[1].center_x = float("nan")
    message.tracks[0].states[1].length = -1.0
    assert not _parse(message).position[0, 1].any()


def test_newer_types_are_read_as_unknown() -> None:
    message = records.scenario()
    message.map_features[0].lane.type = 77
    message.dynamic_map_states[0].lane_states[0].state = 77
    message.map_features.add(id=50)  # a kind of feature that is not in the table
    message.map_features.add(id=51).road_edge.type = 1  # without points
    scene = _parse(message)
    assert scene.roads[0].kind is RoadKind.LANE_UNKNOWN
    assert scene.lights.states[0, 0] == LightState.UNKNOWN
    assert len(scene.roads) == 7


def test_no_map_and_no_lights_is_a_scene() -> None:
    message = records.scenario()
    message.ClearField("map_features")
    message.ClearField("dynamic_map_states")
    scene = _parse(message)
    assert scene.roads == ()
    assert scene.lights.states.shape == (0, 12)


def _set(path: str, value: object) -> Any:
    """A change to a message, by a dotted path whose numbers are indices."""

    def change(message: Any) -> None:
        *owners, last = path.split(".")
        for owner in owners:
            message = (
                message[int(owner)] if owner.isdigit() else getattr(message, owner)
            )
        setattr(message, last, value)

    return change


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (_set("sdc_track_index", 2), "SDC index 2 is not among 2 objects"),
        (_set("sdc_track_index", -1), "SDC index -1 is not among"),
        (_set("current_time_index", 12), "current step 12 is not among 11"),
        (_set("tracks_to_predict.0.track_index", 9), "track to predict 9 is not"),
        (_set("scenario_id", b""), "the scenario has no id"),
        (_set("tracks.1.object_type", 9), "track 1 is of unknown type 9"),
        (_set("tracks.1.object_type", -9), "an object is of an unknown type"),
        (_set("tracks.1.states.3.center_x", float("nan")), "object 1 at step 3: pos"),
        (_set("tracks.1.states.3.center_z", float("inf")), "object 1 at step 3: pos"),
        (_set("tracks.0.states.0.heading", float("nan")), "object 0 at step 0: yaw"),
        (_set("tracks.0.states.0.velocity_y", float("inf")), "at step 0: velocity"),
        (_set("tracks.0.states.0.length", float("nan")), "at step 0: size"),
        (_set("tracks.0.states.0.width", 0.0), "length or width is not positive"),
        (_set("map_features.1.road_edge.polyline.0.x", float("nan")), "map feature 1"),
        (_set("map_features.0.lane.speed_limit_mph", -1.0), "map feature 0 has speed"),
        (
            _set("dynamic_map_states.0.lane_states.0.stop_point.x", float("inf")),
            "a traffic light's stop point is not finite",
        ),
        (lambda m: m.tracks[1].states.add(), "track 1 has 13 states"),
        (lambda m: m.ClearField("tracks"), "or without tracks"),
        (lambda m: m.timestamps_seconds.sort(reverse=True), "do not increase"),
        (lambda m: m.ClearField("timestamps_seconds"), "0 timestamps"),
    ],
)
def test_what_is_wrong_is_named(change: Any, problem: str) -> None:
    message = records.scenario()
    change(message)
    with pytest.raises(SceneError, match=problem) as caught:
        _parse(message)
    assert str(caught.value).startswith("made.tfrecord: ")
    assert "\n" not in str(caught.value)


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused(payload: bytes) -> None:
    for parse in (parse_scenario, parse_example):
        with pytest.raises(SceneError, match=r"^here: "):
            parse(payload, source="here")


_SCENARIO = records.scenario(steps=4).SerializeToString()
_EXAMPLE = records.encode_example(records.example())


@given(st.data())
def test_damage_behind_a_right_checksum(data: st.DataObject) -> None:
    """Flipped bits and a cut: a sound scene or a SceneError, nothing else."""
    whole, parse = data.draw(
        st.sampled_from([(_SCENARIO, parse_scenario), (_EXAMPLE, parse_example)])
    )
    payload = bytearray(whole)
    for bit in data.draw(st.lists(st.integers(0, 8 * len(whole) - 1), max_size=3)):
        payload[bit // 8] ^= 1 << (bit % 8)
    cut = data.draw(st.integers(0, len(payload)) | st.just(len(payload)))
    try:
        scene = parse(bytes(payload[:cut]), source="here")
    except SceneError as error:
        assert str(error).startswith("here: ")
    else:
        assert check_scene(scene) is scene
        assert np.isfinite(scene.position).all()


def test_the_real_example(scenes_data: Path) -> None:
    path = scenes_data / "womd" / "motion_data_one_example.tfrecord"
    assert detect(path) is Format.WOMD_EXAMPLE
    (scene,) = read_scenes([path])
    assert scene.scenario_id == "a3bb37c25ce56418"
    assert (scene.objects, scene.steps, scene.current_step) == (128, 91, 10)
    assert sum(len(road.points) for road in scene.roads) == 20_000
    assert scene.valid[scene.sdc_index].all()
    assert scene.lights.states.shape[1] == 91
    assert len(set(scene.lights.lane_ids.tolist())) == len(scene.lights.lane_ids)


def test_every_feature_of_an_example_arrives() -> None:
    scene = parse_example(_EXAMPLE, source="made")
    assert (scene.objects, scene.steps, scene.current_step) == (2, 6, 2)
    assert scene.sdc_index == 1
    assert scene.tracks_to_predict == (0,)
    assert scene.objects_of_interest == (0, 1)
    assert scene.sdc_paths == ()
    assert scene.object_ids.tolist() == [100, 101]
    np.testing.assert_allclose(scene.position[1, 4], [2.0, 3.5, 1.0])
    np.testing.assert_allclose(scene.velocity[1, 4], [5.0, 0.0])
    np.testing.assert_allclose(scene.size[1, 4], [4.5, 2.0, 1.5])
    edge, line = scene.roads
    assert (edge.kind, edge.feature_id) == (RoadKind.EDGE_MEDIAN, 2)
    assert edge.points.tolist() == [[-10, -2, 0], [30, -2, 0], [60, -2, 0]]
    assert (line.kind, len(line.points)) == (RoadKind.LINE_SOLID_WHITE, 1)
    # One lane, whose light moves between two slots from step to step.
    assert scene.lights.lane_ids.tolist() == [1]
    assert scene.lights.states.tolist() == [[LightState.STOP] * 6]


def test_path_samples_arrive() -> None:
    """Valid points only; a slot without any is no path."""
    features = records.with_paths(records.example())
    scene = parse_example(records.encode_example(features), source="made")
    on, off = scene.sdc_paths
    assert (on.on_route, off.on_route) == (True, False)
    assert on.points.tolist() == [[0, 0, 1], [10, 0, 1]]
    assert off.points.tolist() == [[0, 3.5, 1], [10, 3.5, 1], [20, 3.5, 1]]


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        ("xyz", [0.0] * 24, "do not divide into paths"),
        ("valid", [1] * 8, "do not divide into paths"),
        ("on_route", [], "no numbers under 'path_samples/on_route'"),
        ("xyz", [float("nan")] * 27, "SDC path 0 has a point that is not finite"),
    ],
)
def test_broken_path_samples_are_named(name: str, values: list, problem: str) -> None:
    features = records.with_paths(records.example())
    del features[f"path_samples/{name}"]
    features |= {f"path_samples/{name}": values} if values else {}
    with pytest.raises(SceneError, match=problem):
        parse_example(records.encode_example(features), source="here")


@pytest.mark.parametrize("name", sorted(records.with_paths(records.example())))
def test_each_feature_of_an_example_is_needed_whole(name: str) -> None:
    """Without it, or with a value less, no other error than SceneError."""
    for change in ("gone", "short", "text", "nan"):
        features = records.with_paths(records.example())
        values = features.pop(name)
        if change == "short":
            features[name] = values[:-1]
        elif change == "text":
            features[name] = b"text" if name != "scenario/id" else [1]
        elif change == "nan":
            features[name] = [float("nan")] * len(values)
        try:
            check_scene(parse_example(records.encode_example(features), source="here"))
        except SceneError as error:
            assert str(error).startswith("here: ")
        else:
            # The future (as in the test split), lights and paths may be missing.
            missing = name.startswith(("state/future/x", "traffic_light_state"))
            unread = name in ("path_samples/id", "path_samples/arc_length")
            assert (
                missing
                or unread
                or (name, change)
                in (
                    ("scenario/id", "short"),
                    ("state/objects_of_interest", "gone"),
                    ("path_samples/xyz", "gone"),
                )
            )


def test_the_two_messages_are_told_apart() -> None:
    assert is_example(_EXAMPLE)
    assert not is_example(_SCENARIO)
    assert not is_example(b"")
    assert not is_example(b"\x0a" + b"\xff" * 12)


def test_real_frames_are_at_their_offsets(scenes_data: Path) -> None:
    path = scenes_data / "womd" / "motion_data_one_scenario.tfrecord"
    (record,) = read_records(path)
    assert isinstance(record, Record)
    assert record.offset == 0
    assert len(record.payload) + 16 == path.stat().st_size


def test_a_point_that_is_far_off_is_refused() -> None:
    """Tables cover all between the points: a stray one would cost all memory."""
    message = records.scenario()
    message.map_features[1].road_edge.polyline[0].y = 1e6
    with pytest.raises(SceneError, match="at most 50000 m and"):
        _parse(message)
