"""Routes beyond the log's end, speed limits, stop positions, and the paths' table."""

from pathlib import Path

import numpy as np
import pytest

from sim import routes
from sim.bank import BankFile
from sim.lane_paths import MAX_CHUNKS, ON
from sim.scene import ObjectType, Polyline, RoadKind, Scene
from tests import scenes
from tests.test_lanes import lane

ORIGIN = np.zeros(3)


def made(*roads: Polyline, kind: ObjectType = ObjectType.VEHICLE, **how) -> dict:
    """The arrays of a scene with one object that drives along x, from 0 to 19 m."""
    scene = scenes.scene_of([scenes.driver(**how)], roads=roads)
    scene.object_types[:] = int(kind)
    return routes.routes_of(scene, ORIGIN)


def distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Of points to a polyline given by dense points [m]."""
    return np.hypot(*np.moveaxis(points[:, None] - line, -1, 0)).min(1)


def test_without_lanes_a_route_goes_straight_on() -> None:
    arrays = made()
    np.testing.assert_allclose(arrays["route"][0, -1], [19 + 80, 0], atol=1e-4)
    assert arrays["route_start"][0] == pytest.approx(scenes.CURRENT * 1.0)
    assert arrays["route_end"][0] == pytest.approx(19.0)
    assert (arrays["path_flags"] == 0).all()


def bend(radius: float) -> np.ndarray:
    """A left turn that begins at (20, 0), in steps of 1 cm."""
    angle = np.linspace(0, np.pi / 2, int(radius * 160))
    return np.stack([20 + radius * np.sin(angle), radius * (1 - np.cos(angle))], -1)


def test_a_route_follows_its_lane_and_what_comes_behind() -> None:
    """Round a bend, and straight on behind the last lane's end."""
    arc = bend(20.0)
    arrays = made(
        lane((0, 0), (20, 0)),
        lane(*map(tuple, arc[::50]), tuple(arc[-1])),
        lane((40, 20), (40, 60)),
    )
    route = arrays["route"][0].astype(float)
    gaps = np.hypot(*np.diff(route, axis=0).T)
    assert gaps.sum() == pytest.approx(19 + 80, abs=0.2)
    assert arrays["route_spacing"][0] == pytest.approx(99 / 63)
    onward = np.stack([np.full(9000, 40.0), np.linspace(20, 110, 9000)], -1)
    start = np.stack([np.linspace(0, 20, 2000), np.zeros(2000)], -1)
    ideal = np.concatenate([start, arc, onward])
    # A chord of the bend, from where the log left it to the lane 5 m ahead.
    assert distance(route, ideal).max() < 0.2
    np.testing.assert_allclose(route[-1], [40, 20 + 80 - 1 - 10 * np.pi], atol=0.3)


def test_at_a_fork_a_route_goes_straight() -> None:
    arrays = made(
        lane((0, 0), (30, 0)),
        lane((30, 0), (40, 1), (100, 40)),
        lane((30, 0), (40, -0.5), (100, -4)),
        lane((30, 0), (32, 0), (40, 9)),
    )
    np.testing.assert_allclose(arrays["route"][0, -1, 1], -4, atol=0.3)


@pytest.mark.parametrize(
    ("at", "straight"), [(3.4, False), (3.6, True), (-3.4, False), (-3.6, True)]
)
def test_a_route_goes_onto_a_lane_within_reach(at: float, straight: bool) -> None:
    end = made(lane((-10, at), (200, at)))["route"][0, -1]
    np.testing.assert_allclose(end[1], 0.0 if straight else at, atol=1e-3)


@pytest.mark.parametrize(("turn", "straight"), [(40.0, False), (50.0, True)])
def test_a_route_goes_onto_a_lane_of_its_heading(turn: float, straight: bool) -> None:
    slope = np.tan(np.deg2rad(turn))
    end = made(lane((9, -10 * slope), (89, 70 * slope)))["route"][0, -1]
    assert (abs(end[1]) < 1e-3) == straight


def test_pedestrians_walk_straight_on_and_have_no_paths() -> None:
    line = lane((-10, 1), (200, 1))
    walker = made(line, kind=ObjectType.PEDESTRIAN)
    assert (walker["path_flags"] == 0).all()
    np.testing.assert_allclose(walker["route"][0, -1, 1], 0.0, atol=1e-6)
    assert (made(line, kind=ObjectType.CYCLIST)["path_flags"] > 0).any()


def test_the_speed_limit_is_that_of_the_lane_where_it_starts() -> None:
    slow = Polyline(
        RoadKind.LANE_STREET,
        np.array([[-5.0, 0, 0], [10, 0, 0]]),
        feature_id=1,
        exit_lanes=(2,),
        speed_limit=8.0,
    )
    fast = Polyline(
        RoadKind.LANE_STREET,
        np.array([[10.0, 0, 0], [90, 0, 0]]),
        feature_id=2,
        speed_limit=20.0,
    )
    assert made(slow, fast)["route_speed"][0] == 8.0
    assert made(slow, fast, x=7.0)["route_speed"][0] == 20.0
    assert made(slow, fast, y=9.0)["route_speed"][0] == 0.0


def sign(x: float, y: float, *stop_lanes: int) -> Polyline:
    """A stop sign."""
    return Polyline(
        RoadKind.STOP_SIGN, np.array([[x, y, 0.0]]), stop_lanes=tuple(stop_lanes)
    )


def test_stop_positions_are_on_the_lanes_that_a_sign_names() -> None:
    arrays = made(
        lane((0, 0), (50, 0), name=1),
        lane((0, 3), (50, 3), name=2),
        sign(40.0, -30.0, 1, 2, 77),
    )
    np.testing.assert_allclose(arrays["stop_position"], [[40, 0], [40, 3]], atol=1e-5)


@pytest.mark.parametrize(
    ("x", "y", "stop"),
    [
        (40.0, -4.0, [40.0, 0.0]),  # at the right of the lane that goes along x
        (40.0, 8.0, [40.0, 3.5]),  # of the one that comes back
        (40.0, -10.5, None),  # too far
        (60.5, -1.0, None),  # too far behind the end
    ],
)
def test_a_sign_without_lanes_stands_for_the_one_at_its_left(x, y, stop) -> None:
    arrays = made(lane((0, 0), (50, 0)), lane((50, 3.5), (0, 3.5)), sign(x, y))
    expected = np.array([] if stop is None else stop).reshape(-1, 2)
    np.testing.assert_allclose(arrays["stop_position"], expected, atol=1e-5)


def test_the_farthest_off_route_chunks_are_left_out() -> None:
    """A ladder of 300 lanes that leave the road."""
    roads = [lane((0, 0), (30, 0), name=0, exits=(1, *range(2, 302)))]
    roads.append(lane((30, 0), (200, 0), name=1))
    roads += [lane((30, 0), (40, 30 + i), name=2 + i) for i in range(300)]
    arrays = made(*roads, speed=20.0)
    assert arrays["path_chunk"].shape == (1, MAX_CHUNKS)
    flags, offsets = arrays["path_flags"][0], arrays["path_offset"][0]
    assert (flags > 0).all()
    assert (flags & ON > 0).sum() == 2
    assert sorted(offsets[flags & ON > 0]) == pytest.approx([-8.0, 22.0])


def test_an_empty_map_and_an_object_that_never_was(tmp_path: Path) -> None:
    valid = np.ones((2, scenes.STEPS), bool)
    valid[1] = False
    drivers = [scenes.driver(), scenes.driver(y=4.0)]
    file = scenes.bank_of([scenes.scene_of(drivers, roads=(), valid=valid)], tmp_path)
    assert (file.arrays["path_flags"] == 0).all()
    assert file.arrays["stops"][0] == 0
    assert all(
        np.isfinite(array).all()
        for array in file.arrays.values()
        if array.dtype.kind == "f"
    )


def test_scenes_in_one_bank_do_not_mix(
    real: tuple[tuple[Scene, ...], BankFile],
) -> None:
    """Each object's chunks are those of its scene converted alone."""
    recorded, file = real
    for row in (0, len(recorded) - 1):
        alone = routes.routes_of(recorded[row], np.array(file.origins[row]))
        width = alone["path_chunk"].shape[1]
        for name in routes.PER_CHUNK:
            whole = file.arrays[name][row, : recorded[row].objects]
            np.testing.assert_array_equal(whole[:, :width], alone[name])
            assert not whole[:, width:].any()
        start = file.arrays["chunk_start"][row]
        np.testing.assert_array_equal(
            file.arrays["chunks"][start : start + len(alone["chunks"])], alone["chunks"]
        )


def test_the_paths_of_real_scenes_take_little_room(real) -> None:
    """At most 100 KB a scene of 128 objects."""
    recorded, file = real
    table = sum(file.arrays[name].nbytes for name in routes.PER_CHUNK)
    table += file.arrays["chunks"].nbytes
    objects = file.arrays["log"].shape[2] * len(recorded)
    assert table / objects * 128 < 100_000
