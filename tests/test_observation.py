"""What a controlled object sees: against brute force, and whatever the map's frame."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim.bank import BankFile
from sim.observation import (
    POSITION_SCALE,
    SIZE_SCALE,
    Observation,
    ObservationConfig,
    observation_sizes,
    observe,
    observe_batch,
)
from sim.procedural import generate_many
from sim.scene import (
    LightState,
    ObjectType,
    Polyline,
    RoadKind,
    Scene,
    TrafficLights,
)
from tests import scenes

CONFIG = ObservationConfig()
SMALL = ObservationConfig(
    history=2, neighbours=2, road_rows=3, lights=1, route_points=1, radius=20.0
)

_observe = jax.jit(observe, static_argnums=6)
_observe_batch = jax.jit(observe_batch, static_argnums=6)


def history_of(
    file: BankFile, scene: int, step: int, controlled: int, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """The logged states up to `step`, and which are valid."""
    steps = np.arange(step - length + 1, step + 1)
    log = file.arrays["log"][scene, np.maximum(steps, 0), controlled]
    valid = file.arrays["log_valid"][scene, np.maximum(steps, 0), controlled]
    return log[:, [0, 1, 3, 4, 5]], valid & (steps >= 0)


def seen(
    file: BankFile,
    scene: int,
    step: int,
    controlled: int,
    config: ObservationConfig = CONFIG,
    offset: np.ndarray | None = None,
) -> Observation:
    """The observation from the log's history, moved by `offset`, as numpy arrays."""
    history, valid = history_of(file, scene, step, controlled, config.history)
    if offset is not None:
        history = history + offset.astype(np.float32)
    found = _observe(
        file.bank,
        jnp.int32(scene),
        jnp.int32(step),
        jnp.int32(controlled),
        jnp.asarray(history),
        jnp.asarray(valid),
        config,
    )
    return Observation(*(np.asarray(value) for value in found))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    return scenes.bank_of(list(generate_many(21, 3)), tmp_path_factory.mktemp("made"))


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


@pytest.mark.parametrize("config", [CONFIG, SMALL], ids=["default", "small"])
def test_shapes_are_the_announced_sizes(made: BankFile, config) -> None:
    found, sizes = seen(made, 0, 20, 1, config), observation_sizes(config)
    assert found.ego.shape == (sizes.ego,)
    assert found.agents.shape == (sizes.neighbours, sizes.agent)
    assert found.agents_valid.shape == (sizes.neighbours,)
    assert found.road.shape == (sizes.rows, sizes.road)
    assert found.road_valid.shape == (sizes.rows,)
    assert found.lights.shape == (sizes.lights, sizes.light)
    assert found.lights_valid.shape == (sizes.lights,)
    assert all(
        value.dtype == (bool if name.endswith("valid") else np.float32)
        for name, value in found._asdict().items()
    )


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"history": 1}, "history=1 must be >= 2"),
        ({"road_rows": 0}, "road_rows=0 must be 1 to 64"),
        ({"road_rows": 65}, "road_rows=65 must be 1 to 64"),
    ],
)
def test_sizes_that_show_nothing_are_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ObservationConfig(**wrong)


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


def test_values_that_are_not_valid_are_zero(made: BankFile) -> None:
    for step, controlled in ((10, 0), (40, 2), (90, 5)):
        found = seen(made, 1, step, controlled)
        for name in ("agents", "road", "lights"):
            values, valid = getattr(found, name), getattr(found, f"{name}_valid")
            assert not values[~valid].any(), name
            assert (np.abs(values[valid]).sum(-1) > 0).all(), name


def test_neighbours_are_the_nearest_valid_ones(made: BankFile) -> None:
    for scene in range(made.scenes):
        for step in (10, 45, 80):
            log = made.arrays["log"][scene, step]
            valid = made.arrays["log_valid"][scene, step]
            for controlled in np.flatnonzero(valid)[:4]:
                own = log[controlled]
                distance = np.hypot(*(log[:, :2] - own[:2]).T)
                others = [
                    row
                    for row in np.argsort(distance, kind="stable")
                    if valid[row] and row != controlled and distance[row] < 60.0
                ][: CONFIG.neighbours]
                found = seen(made, scene, step, int(controlled))
                assert found.agents_valid.sum() == len(others)
                assert found.agents_valid[: len(others)].all()
                cos, sin = np.cos(own[3]), np.sin(own[3])
                place = log[others, :2] - own[:2]
                ahead = (cos * place[:, 0] + sin * place[:, 1]) / POSITION_SCALE
                aside = (cos * place[:, 1] - sin * place[:, 0]) / POSITION_SCALE
                now = found.agents[: len(others), 7 * (CONFIG.history - 1) :]
                np.testing.assert_allclose(now[:, 0], ahead, atol=1e-5)
                np.testing.assert_allclose(now[:, 1], aside, atol=1e-5)


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


def test_road_rows_are_the_nearest_to_the_cell(made: BankFile) -> None:
    """Cells are 5 m wide: a row that is left out is nearly as far as the last seen."""
    config = ObservationConfig(road_rows=12)
    few, all_rows = seen(made, 0, 30, 1, config), seen(made, 0, 30, 1)
    np.testing.assert_array_equal(few.road, all_rows.road[:12])

    def distance(rows: np.ndarray) -> np.ndarray:
        middle = rows[:, :2] * POSITION_SCALE
        half = rows[:, 2:4] * rows[:, 4:5] * SIZE_SCALE
        along = np.clip(
            -(middle * half).sum(1) / np.maximum((half**2).sum(1), 1e-9), -1, 1
        )
        return np.hypot(*(middle + along[:, None] * half).T)

    rows = all_rows.road[all_rows.road_valid]
    slack = 5 * np.sqrt(2) + 0.2
    assert distance(rows[:12]).max() <= distance(rows[12:]).min() + slack


def test_far_from_the_map_nothing_breaks(made: BankFile) -> None:
    found = seen(made, 0, 30, 1, offset=np.array([5e4, -5e4, 0, 0, 0]))
    assert all(np.isfinite(value).all() for value in found)
    assert not found.agents_valid.any()


def test_scenes_in_one_bank_do_not_mix(hand: BankFile, tmp_path: Path) -> None:
    alone = scenes.bank_of([busy_scene()], tmp_path)
    for step in (5, 15):
        one, other = seen(hand, HAND.index("busy"), step, 0), seen(alone, 0, step, 0)
        for name, value in one._asdict().items():
            np.testing.assert_allclose(
                value, getattr(other, name), atol=1e-6, err_msg=name
            )


def batch_of(
    file: BankFile, scene: np.ndarray, step: np.ndarray, controlled: np.ndarray
) -> Observation:
    """`observe_batch` from the log's histories, as numpy arrays."""
    rows = [
        history_of(file, *row, CONFIG.history)
        for row in zip(scene, step, controlled, strict=True)
    ]
    found = _observe_batch(
        file.bank,
        *(jnp.asarray(value, jnp.int32) for value in (scene, step, controlled)),
        jnp.asarray(np.stack([history for history, _ in rows])),
        jnp.asarray(np.stack([valid for _, valid in rows])),
        CONFIG,
    )
    return Observation(*(np.asarray(value) for value in found))


def test_the_real_scenes_bit_for_bit_in_batches_of_any_size(real) -> None:
    """All finite and of about unit range, too."""
    recorded, file = real
    rng = np.random.default_rng(3)
    scene = rng.integers(0, len(recorded), 512)
    step = rng.integers(0, 91, 512)
    controlled = np.array([rng.integers(file.arrays["objects"][row]) for row in scene])
    whole = batch_of(file, scene, step, controlled)
    for name, value in whole._asdict().items():
        assert np.isfinite(value).all(), name
        assert np.abs(value).max() < 50, name
    places = [slice(row, row + 1) for row in range(100)] + [slice(0, 33)]
    for place in places:
        part = batch_of(file, scene[place], step[place], controlled[place])
        for name, value in part._asdict().items():
            np.testing.assert_array_equal(
                value, getattr(whole, name)[place], err_msg=f"{name} of {place}"
            )


def test_observing_compiles_once(made: BankFile) -> None:
    jitted, traces = scenes.counted(lambda *args: observe_batch(*args, SMALL))
    for start in (0, 1):
        rows = np.full(4, start, np.int32)
        jitted(
            made.bank,
            rows,
            rows + 10,
            rows,
            jnp.zeros((4, 2, 5)) + start,
            jnp.ones((4, 2), bool),
        )
    assert len(traces) == 1
