"""Procedural scenes: reproducible, drivable, and worth learning from."""

import itertools
from functools import cache

import numpy as np
import pytest

from sim.procedural import generate, generate_many
from sim.procedural_geometry import stations_of
from sim.scene import LightState, ObjectType, Polyline, RoadKind, Scene
from tests import oracle

SCENES = 72
FAMILIES = ("crossing", "curved", "merge")


@cache
def scenes() -> tuple[Scene, ...]:
    """The bank that most tests look at."""
    return tuple(generate_many(11, SCENES))


def family(scene: Scene) -> str:
    """The family's name, the id's first word."""
    return scene.scenario_id.split("-")[0]


def vehicles(scene: Scene) -> np.ndarray:
    """Rows of vehicles."""
    return scene.object_types == ObjectType.VEHICLE


def moved(scene: Scene) -> float:
    """Metres that the recording vehicle drives after the current step."""
    path = scene.position[scene.sdc_index, scene.current_step :, :2]
    return float(np.hypot(*np.diff(path, axis=0).T).sum())


def coasting(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners and valid steps of the recording vehicle with frozen velocity."""
    now, row = scene.current_step, scene.sdc_index
    seconds = scene.dt * np.arange(scene.steps - now)
    start = scene.position[row, now, :2]
    centre = start + seconds[:, None] * scene.velocity[row, now]
    yaw = np.full(len(seconds), scene.yaw[row, now])
    size = scene.size[row, now:]
    return oracle.corners(centre, yaw, size[:, 0], size[:, 1]), scene.valid[:, now:]


def coast_fails(scene: Scene) -> tuple[bool, bool]:
    """Whether coasting overlaps another object; leaves the road."""
    boxes, valid = coasting(scene)
    logged = oracle.scene_corners(scene)[:, scene.current_step :]
    others = np.arange(scene.objects) != scene.sdc_index
    hit = any(
        oracle.boxes_overlap(
            np.concatenate([boxes[t : t + 1], logged[others & valid[:, t], t]])
        )[0].any()
        for t in range(len(boxes))
    )
    height = scene.position[scene.sdc_index, scene.current_step, 2]
    corners = boxes.reshape(-1, 2)
    off = oracle.corners_offroad(
        corners, np.full(len(corners), height), oracle.road_edges(scene)
    )
    return hit, bool(off.any())


def test_a_scene_depends_on_seed_and_index_only() -> None:
    """Bit for bit, however many scenes are asked for."""
    again = generate(11)
    first = next(generate_many(11, 1))
    for scene in (again, first):
        assert scene.scenario_id == scenes()[0].scenario_id
        for name in ("position", "yaw", "velocity", "size", "valid"):
            np.testing.assert_array_equal(
                getattr(scene, name), getattr(scenes()[0], name)
            )
        for road, other in zip(scene.roads, scenes()[0].roads, strict=True):
            np.testing.assert_array_equal(road.points, other.points)


def test_seeds_and_indices_differ() -> None:
    """No two scenes share a recording vehicle's start."""
    drawn = [*scenes()[:20], *(generate(seed) for seed in (12, 13))]
    starts = {tuple(scene.position[scene.sdc_index, 0]) for scene in drawn}
    assert len(starts) == len(drawn)


def test_womd_shape() -> None:
    """91 steps at 10 Hz, 8 to 24 objects, a recording vehicle that is valid."""
    for scene in scenes():
        assert (scene.steps, scene.current_step, scene.dt) == (91, 10, 0.1)
        assert 8 <= scene.objects <= 24
        assert scene.valid[scene.sdc_index].all()
        assert scene.valid[:, scene.current_step].all()
        assert vehicles(scene)[scene.sdc_index]
        assert scene.lights.states.shape == (len(scene.lights.lane_ids), 91)
        assert len({road.feature_id for road in scene.roads}) == len(scene.roads)
        for array in (scene.position, scene.yaw, scene.velocity, scene.size):
            assert np.isfinite(array).all()


def test_every_family_and_kind_of_object_occurs() -> None:
    """Also lights of every state, stop signs, medians, crosswalks, parked vehicles."""
    assert {family(scene) for scene in scenes()} == set(FAMILIES)
    assert all(
        sum(family(scene) == name for scene in scenes()) > 0.1 * SCENES
        for name in FAMILIES
    )
    kinds = {road.kind for scene in scenes() for road in scene.roads}
    assert {
        RoadKind.LANE_FREEWAY,
        RoadKind.LANE_STREET,
        RoadKind.EDGE_BOUNDARY,
        RoadKind.EDGE_MEDIAN,
        RoadKind.LINE_SOLID_DOUBLE_YELLOW,
        RoadKind.LINE_BROKEN_WHITE,
        RoadKind.STOP_SIGN,
        RoadKind.CROSSWALK,
    } <= kinds
    types = {int(kind) for scene in scenes() for kind in scene.object_types}
    assert types == {1, 2, 3}
    states = {int(s) for scene in scenes() for s in np.unique(scene.lights.states)}
    assert {LightState.GO, LightState.CAUTION, LightState.STOP} <= states
    assert {LightState.ARROW_GO, LightState.ARROW_STOP} <= states
    parked = [
        vehicles(scene) & (np.ptp(scene.position[..., :2], axis=1).max(-1) < 0.01)
        for scene in scenes()
    ]
    assert sum(rows.any() for rows in parked) > 0.2 * SCENES


def test_logged_objects_keep_apart() -> None:
    """No two full-size boxes, each grown by 0.15 m, ever meet."""
    for scene in scenes():
        boxes = oracle.corners(
            scene.position[..., :2],
            scene.yaw,
            scene.size[..., 0] + 0.3,
            scene.size[..., 1] + 0.3,
        )
        for step in range(scene.steps):
            near = oracle.boxes_overlap(boxes[scene.valid[:, step], step])
            assert not near.any(), (scene.scenario_id, step)


def test_logged_vehicles_stay_on_the_road() -> None:
    """By the brute-force oracle; people walk where they like."""
    for scene in scenes():
        boxes = oracle.scene_corners(scene)[vehicles(scene)][:, ::3]
        heights = scene.position[vehicles(scene), ::3, 2]
        seen = scene.valid[vehicles(scene), ::3]
        # Parked ones once.
        still = np.ptp(scene.position[vehicles(scene), :, 0], axis=1) == 0
        seen[still, 1:] = False
        corners = boxes[seen].reshape(-1, 2)
        off = oracle.corners_offroad(
            corners, np.repeat(heights[seen], 4), oracle.road_edges(scene)
        )
        assert not off.any(), scene.scenario_id


def test_logs_are_feasible_by_a_large_margin() -> None:
    """Acceleration, curvature and lateral acceleration of the inverse bicycle."""
    for scene in scenes():
        assert not oracle.kinematic(scene)[vehicles(scene)].any()
        rows = vehicles(scene)
        speed = np.hypot(*np.moveaxis(scene.velocity[rows], -1, 0))
        both = scene.valid[rows, 1:] & scene.valid[rows, :-1]
        acceleration = np.diff(speed, axis=1) / scene.dt
        assert np.abs(acceleration[both]).max() <= 6.0, scene.scenario_id
        turned = np.diff(np.unwrap(scene.yaw[rows], axis=1), axis=1)
        travelled = 0.5 * (speed[:, 1:] + speed[:, :-1]) * scene.dt
        moving = both & (speed[:, 1:] > 0.6) & (speed[:, :-1] > 0.6)
        curvature = np.abs(turned[moving] / travelled[moving])
        assert curvature.max() <= 0.25, scene.scenario_id
        assert (curvature * speed[:, :-1][moving] ** 2).max() <= 3.2, scene.scenario_id


def test_velocity_is_the_change_of_position() -> None:
    """And points where the vehicle points."""
    for scene in scenes():
        both = scene.valid[:, 1:] & scene.valid[:, :-1]
        mean = 0.5 * (scene.velocity[:, 1:] + scene.velocity[:, :-1])
        change = np.diff(scene.position[..., :2], axis=1) / scene.dt
        assert np.abs(mean - change)[both].max() < 0.08, scene.scenario_id
        heading = np.stack([np.cos(scene.yaw), np.sin(scene.yaw)], axis=-1)
        speed = np.hypot(*np.moveaxis(scene.velocity, -1, 0))
        across = scene.velocity - speed[..., None] * heading
        assert np.abs(across[scene.valid]).max() < 1e-6, scene.scenario_id


def test_objects_stand_on_the_ground() -> None:
    """Centres are half a height above the plane that the road edges span."""
    for scene in scenes():
        ground = np.concatenate(oracle.road_edges(scene))
        columns = [ground[:, 0], ground[:, 1], np.ones(len(ground))]
        plane = np.linalg.lstsq(np.stack(columns, -1), ground[:, 2], rcond=None)[0]
        at = scene.position[..., :2] @ plane[:2] + plane[2]
        bottom = scene.position[..., 2] - scene.size[..., 2] / 2
        assert np.abs(bottom - at)[scene.valid].max() < 1e-3, scene.scenario_id


def test_lanes_join_end_to_start() -> None:
    """Exits and entries name each other and meet within 0.1 m, without a kink."""
    joined = 0
    for scene in scenes():
        lanes = {road.feature_id: road for road in scene.roads if road.kind.is_lane}
        for lane in lanes.values():
            for name in lane.exit_lanes:
                follower = lanes[name]
                assert lane.feature_id in follower.entry_lanes
                gap = follower.points[0] - lane.points[-1]
                assert np.linalg.norm(gap) < 0.1, scene.scenario_id
                ends = lane.points[-1] - lane.points[-2]
                begins = follower.points[1] - follower.points[0]
                cos = ends @ begins
                cos /= np.linalg.norm(ends) * np.linalg.norm(begins)
                assert cos > 0.98, (scene.scenario_id, lane.feature_id, name)
                joined += 1
            for name in lane.entry_lanes:
                assert lane.feature_id in lanes[name].exit_lanes
    assert joined > 3 * SCENES


def test_lights_belong_to_lanes_that_begin_at_their_stop_point() -> None:
    """As in WOMD: the controlled lane is the one behind the line."""
    seen = 0
    for scene in scenes():
        lanes = {road.feature_id: road for road in scene.roads if road.kind.is_lane}
        lights = scene.lights
        for name, point in zip(lights.lane_ids, lights.stop_points, strict=True):
            assert np.linalg.norm(lanes[int(name)].points[0] - point) < 0.1
            seen += 1
    assert seen > 0


def test_drivable_side_is_left() -> None:
    """Lane centre lines lie left of the nearest edge, all the way."""
    for scene in scenes():
        lanes = [road.points for road in scene.roads if road.kind.is_lane]
        points = np.concatenate(
            [(1 - t) * p[:-1] + t * p[1:] for p in lanes for t in (0.3, 0.8)]
        )
        wrong = oracle.corners_offroad(
            points[:, :2], points[:, 2], oracle.road_edges(scene)
        )
        assert not wrong.any(), scene.scenario_id


def test_beyond_every_kerb_is_off_road() -> None:
    """A step across an edge is off the road unless it reaches another road."""
    for scene in scenes()[:24]:
        edges = oracle.road_edges(scene)
        for edge in edges:
            step = np.diff(edge[:, :2], axis=0)
            long = np.hypot(*step.T) > 0.5
            right = np.stack([step[:, 1], -step[:, 0]], -1)[long]
            right /= np.hypot(*right.T)[:, None]
            middle = 0.5 * (edge[1:] + edge[:-1])[long]
            outside = middle[:, :2] + 0.1 * right
            wrong = oracle.corners_offroad(outside, middle[:, 2], edges)
            assert wrong.all(), scene.scenario_id
            inside = middle[:, :2] - 0.1 * right
            assert not oracle.corners_offroad(inside, middle[:, 2], edges).any()


def test_map_points_are_near_enough_and_not_too_many() -> None:
    """At most 10 m apart (a sample more where the last one falls), bends finer."""
    for scene in scenes():
        for road in scene.roads:
            if len(road.points) > 2 and road.kind != RoadKind.CROSSWALK:
                gaps = np.hypot(*np.diff(road.points[:, :2], axis=0).T)
                assert gaps.max() <= 10.6, (scene.scenario_id, road.kind)
        assert sum(len(road.points) for road in scene.roads) < 6000


def test_the_recording_vehicle_drives() -> None:
    """It moves from the start, nearly always for 30 m or more; speeds vary."""
    distance = np.array([moved(scene) for scene in scenes()])
    assert (distance >= 30.0).mean() > 0.9
    assert distance.min() > 10.0
    assert distance.std() > 15.0
    for scene in scenes():
        assert np.hypot(*scene.velocity[scene.sdc_index, 0]) > 1.9
    speed = [np.hypot(*scene.velocity[scene.sdc_index, 10:].T) for scene in scenes()]
    braked = np.mean([s.min() < 0.6 * s[0] for s in speed])
    assert 0.15 < braked < 0.8
    turned = [np.ptp(np.unwrap(s.yaw[s.sdc_index, 10:])) > 0.4 for s in scenes()]
    assert 0.08 < np.mean(turned) < 0.7


def test_road_goes_on_where_the_recording_vehicle_could_drive() -> None:
    """Lanes lead on for 150 m or more from where it is at the current step."""
    for scene in scenes():
        lanes = {road.feature_id: road for road in scene.roads if road.kind.is_lane}
        here = scene.position[scene.sdc_index, scene.current_step, :2]
        yaw = scene.yaw[scene.sdc_index, scene.current_step]
        ahead = max(_ahead(lanes, name, here, yaw) for name in lanes)
        assert ahead >= 150.0, scene.scenario_id


def _ahead(
    lanes: dict[int, Polyline], name: int, here: np.ndarray, yaw: float
) -> float:
    """Length of the longest way on, if `here` lies on this lane in its direction."""
    points = lanes[name].points[:, :2]
    step = np.diff(points, axis=0)
    along = ((here - points[:-1]) * step).sum(-1) / (step**2).sum(-1)
    foot = points[:-1] + np.clip(along, 0, 1)[:, None] * step
    gap = np.hypot(*(here - foot).T)
    k = int(gap.argmin())
    if gap[k] > 2.5 or step[k] @ np.array([np.cos(yaw), np.sin(yaw)]) <= 0:
        return 0.0
    rest = stations_of(points)[-1] - stations_of(points)[k]
    return rest + max((_onward(lanes, n) for n in lanes[name].exit_lanes), default=0.0)


def _onward(lanes: dict[int, Polyline], name: int) -> float:
    """Length of the longest way that begins with this lane."""
    own = stations_of(lanes[name].points[:, :2])[-1]
    return own + max((_onward(lanes, n) for n in lanes[name].exit_lanes), default=0.0)


def test_coasting_fails_often_in_both_ways() -> None:
    """Frozen heading and speed fail in 55 to 80% (here with sampling slack)."""
    fails = np.array([coast_fails(scene) for scene in scenes()])
    assert 0.5 <= fails.any(axis=1).mean() <= 0.85
    assert fails[:, 0].mean() > 0.1
    assert fails[:, 1].mean() > 0.2


@pytest.mark.slow
def test_five_hundred_scenes() -> None:
    """The bounds on coasting as promised, and no failure of any log."""
    many = list(generate_many(2025, 500))
    fails = np.array([coast_fails(scene) for scene in many])
    assert 0.55 <= fails.any(axis=1).mean() <= 0.80
    for scene in many:
        assert not oracle.offroad(scene)[vehicles(scene)].any()
        assert not oracle.overlap(scene).any()
        assert not oracle.kinematic(scene)[vehicles(scene)].any()


def test_traffic_obeys_red_lights() -> None:
    """No vehicle's front crosses a stop point while its light says stop."""
    checked = 0
    for scene in scenes():
        for light in range(len(scene.lights.lane_ids)):
            red = np.isin(scene.lights.states[light], (1, 4))
            point = scene.lights.stop_points[light, :2]
            lane = next(
                r for r in scene.roads if r.feature_id == scene.lights.lane_ids[light]
            )
            way = lane.points[1, :2] - lane.points[0, :2]
            way /= np.hypot(*way)
            for row in np.nonzero(vehicles(scene))[0]:
                checked += 1
                yaw = scene.yaw[row]
                heading = np.stack([np.cos(yaw), np.sin(yaw)], -1)
                half = scene.size[row, :, 0, None] / 2
                front = scene.position[row, :, :2] + half * heading - point
                along, aside = front @ way, way[0] * front[:, 1] - way[1] * front[:, 0]
                on = (np.abs(aside) < 1.2) & (heading @ way > 0.9)
                passes = on[:-1] & (along[:-1] < 0) & (along[1:] >= 0)
                # A metre of creeping over the line is not running the light.
                ran = passes & red[:-1] & red[1:] & (along.max() > 2.0)
                ran &= _same_light(scene, lane.feature_id, int(row))
                assert not ran.any(), (scene.scenario_id, int(row))
    assert checked > 0


def _same_light(scene: Scene, name: int, row: int) -> bool:
    """Whether the vehicle drives along this connector, not a neighbour's."""
    points = next(r.points for r in scene.roads if r.feature_id == name)[:, :2]
    middle = points[len(points) // 2]
    if len(points) == 2:
        middle = points.mean(axis=0)
    gap = np.hypot(*(scene.position[row, :, :2] - middle).T)
    return bool(gap.min() < 1.5)


def test_traffic_reacts() -> None:
    """Somewhere a follower brakes to stay behind; queues stand at red lights."""
    standing = 0
    for scene in scenes():
        rows = vehicles(scene)
        speed = np.hypot(*np.moveaxis(scene.velocity[rows], -1, 0))
        moves = speed.max(axis=1) > 3.0
        standing += int((moves & (speed.min(axis=1) < 0.3)).any())
    assert standing > 0.15 * SCENES


def test_generation_is_lazy() -> None:
    """An iterator: a bank of 10,000 scenes is never in memory."""
    assert len(list(itertools.islice(generate_many(0, 10**9), 2))) == 2
