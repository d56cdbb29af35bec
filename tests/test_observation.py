"""What is seen of scenes made by hand, and that the map's frame does not matter."""

from pathlib import Path

import numpy as np
import pytest

from sim.bank import BankFile
from sim.features import POSITION_SCALE, SIZE_SCALE
from sim.observation import Observation
from sim.scene import (
    LightState,
    ObjectType,
    Polyline,
    RoadKind,
    Scene,
    TrafficLights,
)
from tests import scenes
from tests.seeing import CONFIG, seen


def busy_scene() -> Scene:
    """A curving car among others, with lights and every class of map feature."""
    rng = np.random.default_rng(6)
    drivers = [scenes.driver(yaw=0.1, speed=8.0)]
    drivers += [
        scenes.driver(
            x=float(rng.uniform(-30, 30)),
            y=float(rng.uniform(-20, 20)),
            yaw=float(rng.uniform(-3, 3)),
            speed=float(rng.uniform(0, 12)),
        )
        for _ in range(9)
    ]
    roads = [
        *scenes.corridor(end=57.0),  # not a whole number of pieces
        Polyline(RoadKind.LANE_STREET, np.array([[-60, 1, 0], [57, 2, 0]], float)),
        Polyline(RoadKind.LINE_BROKEN_WHITE, np.array([[0, 3, 0], [9, 4, 0.0]])),
        Polyline(RoadKind.STOP_SIGN, np.array([[12.0, -6, 0]])),
        Polyline(
            RoadKind.CROSSWALK,
            np.array([[20, -4, 0], [23, -4, 0], [23, 5, 0], [20, 5, 0]], float),
        ),
    ]
    states = rng.integers(0, 9, (3, scenes.STEPS))
    stops = np.array([[18.0, 2, 0], [18, -2, 0], [-25, 3, 0]])
    lights = TrafficLights(np.arange(3), stops, states)
    return scenes.scene_of(drivers, roads=roads, lights=lights)


def hand_scenes() -> dict[str, Scene]:
    """One bank holds them all, so that `observe` compiles once."""
    drivers = [scenes.driver(), scenes.driver(y=59.9), scenes.driver(y=-60.1)]
    result = {"radius": scenes.scene_of(drivers)}
    appears = np.ones((2, scenes.STEPS), bool)
    appears[1, :5] = False
    result["appears"] = scenes.scene_of(
        [scenes.driver(), scenes.driver(x=6, y=3)], valid=appears
    )
    kinds = scenes.scene_of([scenes.driver(y=3.0 * row) for row in range(5)])
    kinds.object_types[:] = [
        ObjectType.VEHICLE,
        ObjectType.PEDESTRIAN,
        ObjectType.CYCLIST,
        ObjectType.OTHER,
        ObjectType.VEHICLE,
    ]
    result["kinds"] = kinds
    result["turned"] = scenes.scene_of([scenes.driver(yaw=0.7)])
    result["straight"] = scenes.scene_of([scenes.driver()])
    lane = Polyline(RoadKind.LANE_STREET, np.array([[7, 1, 0], [11, 1, 0]], float))
    sign = Polyline(RoadKind.STOP_SIGN, np.array([[-4.0, -5, 0]]))
    result["rows"] = scenes.scene_of([scenes.driver()], roads=[lane, sign])
    for kind, _ in CLASSES:
        points = np.array([[5, 1, 0], [6, 1, 0], [6, 2, 0]], float)
        road = Polyline(kind, points[:1] if kind == RoadKind.STOP_SIGN else points)
        result[kind.name] = scenes.scene_of([scenes.driver()], roads=[road])
    result["bare"] = scenes.scene_of([scenes.driver()], roads=[])
    states = np.full((3, scenes.STEPS), int(LightState.GO))
    states[1, 5:] = LightState.ARROW_STOP
    stops = np.array([[45.0, 0, 0], [15, 3, 0], [300, 0, 0]])
    result["lights"] = lit(stops, states)
    for first in (0, 3, 6):
        states = np.tile(np.arange(first, first + 3)[:, None], (1, scenes.STEPS))
        stops = np.stack([np.arange(6.0, 9), np.zeros(3), np.zeros(3)], -1)
        result[f"states{first}"] = lit(stops, states)
    rng = np.random.default_rng(1)
    result["busy"] = busy_scene()
    for number in range(10):
        turn, shift = rng.uniform(-np.pi, np.pi), rng.uniform(-2000, 2000, 2)
        result[f"moved{number}"] = scenes.moved(busy_scene(), turn, shift)
    return result


def lit(stops: np.ndarray, states: np.ndarray) -> Scene:
    """A car alone on a straight road with traffic lights."""
    lights = TrafficLights(np.arange(len(stops)), stops, states)
    return scenes.scene_of([scenes.driver()], lights=lights)


CLASSES = (
    (RoadKind.LANE_BIKE, 0),
    (RoadKind.LINE_SOLID_YELLOW, 1),
    (RoadKind.EDGE_MEDIAN, 2),
    (RoadKind.STOP_SIGN, 3),
    (RoadKind.CROSSWALK, 4),
    (RoadKind.SPEED_BUMP, 5),
)
HAND = tuple(hand_scenes())


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    made_by_hand = list(hand_scenes().values())
    return scenes.bank_of(made_by_hand, tmp_path_factory.mktemp("hand"))


def by_hand(file: BankFile, name: str, step: int = 5, **more) -> Observation:
    """What the first car of a hand-made scene sees."""
    return seen(file, HAND.index(name), step, 0, **more)


def test_turning_and_moving_the_map_changes_nothing(hand: BankFile) -> None:
    """Ten random moves of one scene."""
    for controlled in (0, 3):
        one = seen(hand, HAND.index("busy"), 8, controlled)
        for index in range(10):
            other = seen(hand, HAND.index(f"moved{index}"), 8, controlled)
            for name in ("ego", "agents", "agents_valid", "lights", "lights_valid"):
                np.testing.assert_allclose(
                    getattr(one, name), getattr(other, name), atol=1e-3, err_msg=name
                )
            # The map has fewer segments than rows: the same ones, in any order,
            # for rows are listed by cells of the map.
            assert one.road_valid.sum() < CONFIG.road_rows
            np.testing.assert_allclose(
                in_order(one.road), in_order(other.road), atol=2e-3
            )


def in_order(rows: np.ndarray) -> np.ndarray:
    """Rows by kind and rounded middle, so that sets can be compared."""
    keys = np.round(rows, 1)
    return rows[np.lexsort((keys[:, 1], keys[:, 0], *keys[:, 5:].T))]


def test_the_radius_bounds_what_is_seen(hand: BankFile) -> None:
    assert by_hand(hand, "radius").agents_valid.sum() == 1


def test_a_neighbours_history_is_masked_step_by_step(hand: BankFile) -> None:
    """It appears at step 5: at step 6, two of three steps were recorded."""
    assert not by_hand(hand, "appears", 4).agents_valid.any()
    found = by_hand(hand, "appears", 6).agents[0]
    features = found[: 7 * 3].reshape(3, 7)
    assert features[:, 6].tolist() == [0, 1, 1]
    assert not features[0].any()
    # A metre a step ahead: seen from step 6, it was 5 m ahead at step 5.
    np.testing.assert_allclose(features[1:, 0] * POSITION_SCALE, [5, 6], atol=1e-4)
    np.testing.assert_allclose(features[1:, 1] * POSITION_SCALE, [3, 3], atol=1e-4)
    np.testing.assert_allclose(features[1:, 2:4], [[1, 0], [1, 0]], atol=1e-6)
    size = np.array([scenes.LENGTH, scenes.WIDTH]) / SIZE_SCALE
    np.testing.assert_allclose(found[7 * 3 :], [*size, 1, 0, 0], atol=1e-6)


def test_kinds_of_objects_are_told_apart(hand: BankFile) -> None:
    kinds = by_hand(hand, "kinds").agents[:4, -3:]
    assert kinds.tolist() == [[0, 1, 0], [0, 0, 1], [0, 0, 0], [1, 0, 0]]


def test_ego_by_hand(hand: BankFile) -> None:
    """A steady car on a straight: 10 m/s, 4 m by 2 m, on its route, 14 m to go."""
    ego = by_hand(hand, "turned").ego
    np.testing.assert_allclose(ego[:5], [10 / 15, 4 / 5, 2 / 5, 0, 0], atol=1e-5)
    past = ego[5:13].reshape(2, 4)
    np.testing.assert_allclose(past[:, 0] * POSITION_SCALE, [-2, -1], atol=1e-4)
    np.testing.assert_allclose(past[:, 1:3], 0, atol=1e-5)
    np.testing.assert_allclose(past[:, 3], 10 / 15, atol=1e-5)
    np.testing.assert_allclose(ego[13:16], [1, 0, 0], atol=1e-4)
    np.testing.assert_allclose(ego[16:18], [14 / 30, 1], atol=1e-4)
    ahead = np.arange(1, 9) * CONFIG.route_gap / POSITION_SCALE
    np.testing.assert_allclose(ego[18:26], ahead, atol=1e-4)
    np.testing.assert_allclose(ego[26:], 0, atol=1e-4)


def test_the_route_is_seen_from_beside_it(hand: BankFile) -> None:
    ego = by_hand(hand, "straight", offset=np.array([0, -1, 0.5, 0, 0])).ego
    np.testing.assert_allclose(ego[13:15], [np.cos(0.5), -np.sin(0.5)], atol=1e-4)
    assert ego[15] * 2 == pytest.approx(np.cos(0.5), abs=1e-4)  # m, to its left


def test_history_that_was_not_recorded_is_zero(hand: BankFile) -> None:
    assert not by_hand(hand, "straight", 0).ego[3:13].any()
    ego = by_hand(hand, "straight", 1).ego
    assert not ego[5:9].any()
    assert ego[9] < 0


def test_road_rows_by_hand(hand: BankFile) -> None:
    """A lane piece from 2 to 6 m ahead, 1 m to the left; a stop sign behind."""
    found = by_hand(hand, "rows")  # at x = 5
    assert found.road_valid.sum() == 2
    lane = [4 / 30, 1 / 30, 1, 0, 4 / 5 / 2, 1, 0, 0, 0, 0, 0]
    sign = [-9 / 30, -5 / 30, 0, 0, 0, 0, 0, 0, 1, 0, 0]
    np.testing.assert_allclose(found.road[:2], [lane, sign], atol=1e-5)


def test_the_classes_of_the_map(hand: BankFile) -> None:
    for kind, column in CLASSES:
        found = by_hand(hand, kind.name)
        assert found.road_valid.any()
        assert set(found.road[found.road_valid, 5:].argmax(1)) == {column}
        assert (found.road[found.road_valid, 5:].sum(1) == 1).all()


def test_a_map_without_rows_is_masked(hand: BankFile) -> None:
    found = by_hand(hand, "bare")
    assert not found.road_valid.any()
    assert not found.road.any()


def test_lights_by_hand(hand: BankFile) -> None:
    found = by_hand(hand, "lights")
    assert found.lights_valid.tolist() == [True, True, False, False]
    np.testing.assert_allclose(found.lights[0], [1 / 3, 0.1, 0, 0, 1, 0], atol=1e-5)
    np.testing.assert_allclose(found.lights[1], [4 / 3, 0, 1, 0, 0, 0], atol=1e-5)
    before = by_hand(hand, "lights", 4)
    np.testing.assert_allclose(before.lights[0, 2:], [1, 0, 0, 0])


def test_every_state_of_a_light_has_its_class(hand: BankFile) -> None:
    go, caution, stop, unknown = range(4)
    expected = [unknown, stop, caution, go, stop, caution, go, stop, caution]
    for first in (0, 3, 6):
        found = by_hand(hand, f"states{first}").lights[:3, 2:]
        assert found.argmax(1).tolist() == expected[first : first + 3]


def test_scenes_in_one_bank_do_not_mix(hand: BankFile, tmp_path: Path) -> None:
    alone = scenes.bank_of([busy_scene()], tmp_path)
    for step in (5, 15):
        one, other = seen(hand, HAND.index("busy"), step, 0), seen(alone, 0, step, 0)
        for name, value in one._asdict().items():
            np.testing.assert_allclose(
                value, getattr(other, name), atol=1e-6, err_msg=name
            )
