"""IDM: what the model's equations promise, on roads made by hand."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import environment
from sim.agents import Agent
from sim.bank import BankFile
from sim.environment import EnvironmentConfig
from sim.idm import IdmConfig, ballistic, free_road, idm, interaction
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

CONFIG = EnvironmentConfig()
MODEL = IdmConfig()
STEPS = 300
OBJECTS = 7  # of every scene here, the most that one of them needs: one compilation


@functools.cache
def rollout(agent: Agent, steps: int) -> Callable[..., jax.Array]:
    """Compiled once for an agent."""

    def one(bank, rows):
        state = environment.start_at(
            bank, jnp.int32(0), jnp.int32(CONFIG.observation.history), rows, CONFIG
        )

        def step(state, key):
            decision = agent(key, bank, state)
            state, _ = environment.advance(bank, state, decision.moved, CONFIG)
            return state, state.history[:, -1]

        keys = jax.random.split(jax.random.key(0), steps)
        return jax.lax.scan(step, state, keys)[1]

    return jax.jit(one)


IDM = idm(CONFIG)


def drive(
    file: BankFile,
    rows: Sequence[int],
    *,
    steps: int = STEPS - 10,
    agent: Agent = IDM,
) -> np.ndarray:
    """States [steps, controlled, 5] of scene 0 from its step 4 on, map frame."""
    objects = file.arrays["log"].shape[2]
    slots = np.full(objects, objects, np.int32)  # empty ones behind
    slots[: len(rows)] = rows
    states = rollout(agent, steps)(file.bank, jnp.asarray(slots))
    states = np.asarray(states, np.float64)[:, : len(rows)]
    states[..., :2] += file.origins[0][:2]
    assert np.isfinite(states).all()
    return states


def speed(states: np.ndarray) -> np.ndarray:
    return np.hypot(states[..., 3], states[..., 4])


def road(
    drivers: Sequence[np.ndarray],
    tmp_path: Path,
    *,
    lights: TrafficLights | None = None,
    kinds: Sequence[ObjectType] | None = None,
) -> BankFile:
    """A bank of one scene on a straight road; rows without a driver stay empty."""
    nobody = scenes.driver(speed=0.0, steps=STEPS)
    valid = np.zeros((OBJECTS, STEPS), bool)
    valid[: len(drivers)] = True
    scene: Scene = scenes.scene_of(
        [*drivers, *[nobody] * (OBJECTS - len(drivers))],
        roads=scenes.corridor(half=70.0, start=-200.0, end=800.0),
        lights=light(0.0, [0] * STEPS) if lights is None else lights,
        valid=valid,
    )
    if kinds is not None:
        scene.object_types[: len(kinds)] = kinds
    return scenes.bank_of([scene], tmp_path)


def light(x: float, states: Sequence[int]) -> TrafficLights:
    """A light on the road's middle with these states."""
    return TrafficLights(
        np.array([1]), np.array([[x, 0.0, 0.0]]), np.array([states], np.int64)
    )


def test_acceleration_at_hand_computed_points() -> None:
    """a_max 1.5, b 2, T 1.2, s_0 2, v_0 15: numbers worked by hand."""
    at = functools.partial(interaction, model=MODEL)
    # s* = 2 + 12 = 14 at gap 28: a quarter of a_max.
    assert float(at(jnp.float32(10), jnp.float32(28), jnp.float32(0))) == pytest.approx(
        -0.375
    )
    # Closing at 10: s* = 14 + 100 / (2 sqrt 3) = 42.87.
    assert float(
        at(jnp.float32(10), jnp.float32(42.8675), jnp.float32(10))
    ) == pytest.approx(-1.5, rel=1e-4)
    # A leader that draws away fast: s* is s_0.
    assert float(
        at(jnp.float32(10), jnp.float32(4), jnp.float32(-20))
    ) == pytest.approx(-0.375)
    free = functools.partial(free_road, model=MODEL)
    assert float(free(jnp.float32(0), jnp.float32(15))) == pytest.approx(1.5)
    assert float(free(jnp.float32(15), jnp.float32(15))) == pytest.approx(0.0)
    assert float(free(jnp.float32(40), jnp.float32(15))) == pytest.approx(-2.0)


def test_the_step_stops_rather_than_reverses() -> None:
    after, way = ballistic(jnp.float32(1.0), jnp.float32(-8.0), 0.5)
    assert (float(after), float(way)) == (0.0, pytest.approx(1 / 16))
    after, way = ballistic(jnp.float32(4.0), jnp.float32(2.0), 0.5)
    assert (float(after), float(way)) == (pytest.approx(5.0), pytest.approx(2.25))
    after, way = ballistic(jnp.float32(0.0), jnp.float32(0.0), 0.1)
    assert (float(after), float(way)) == (0.0, 0.0)


def test_equilibrium_gap_behind_a_leader(tmp_path: Path) -> None:
    """s_e(v) = (s_0 + v T) / sqrt(1 - (v / v_0)^4)."""
    v = 8.0
    drivers = [
        scenes.driver(speed=v, steps=STEPS),
        scenes.driver(x=40.0, speed=v, steps=STEPS),
    ]
    states = drive(road(drivers, tmp_path), [0])
    leader = drivers[1][4:, 0][: len(states)]
    gap = leader - states[:, 0, 0] - scenes.LENGTH
    expected = (2.0 + v * 1.2) / np.sqrt(1 - (v / 15.0) ** 4)
    assert gap[-1] == pytest.approx(expected, abs=0.1)
    assert speed(states)[-1, 0] == pytest.approx(v, abs=0.02)


def test_a_free_road_is_driven_at_the_desired_speed(tmp_path: Path) -> None:
    states = drive(road([scenes.driver(speed=2.0, steps=STEPS)], tmp_path), [0])
    assert speed(states)[-1, 0] == pytest.approx(MODEL.desired_speed, abs=0.3)
    assert (np.diff(speed(states)[:, 0]) >= -1e-4).all()


def test_it_stops_behind_a_standing_car(tmp_path: Path) -> None:
    drivers = [
        scenes.driver(speed=15.0, steps=STEPS),
        scenes.driver(x=90.0, speed=0.0, steps=STEPS),
    ]
    states = drive(road(drivers, tmp_path), [0])
    gap = 90.0 - states[:, 0, 0] - scenes.LENGTH
    assert gap.min() == pytest.approx(MODEL.standing_gap, abs=0.2)
    assert speed(states)[-1, 0] < 0.05
    braking = np.diff(speed(states)[:, 0]) / 0.1
    assert braking.min() > -5.0


def test_it_brakes_for_who_stands_across(tmp_path: Path) -> None:
    """A box across the path leads by its near side, wherever its centre is."""
    drivers = [
        scenes.driver(speed=10.0, steps=STEPS),
        scenes.driver(x=60.0, y=2.0, yaw=np.pi / 2, speed=0.0, steps=STEPS),
    ]
    states = drive(road(drivers, tmp_path), [0])
    gap = 60.0 - scenes.WIDTH / 2 - scenes.LENGTH / 2 - states[:, 0, 0]
    assert gap.min() == pytest.approx(MODEL.standing_gap, abs=0.2)


def test_who_is_beside_the_corridor_does_not_lead(tmp_path: Path) -> None:
    beside = scenes.WIDTH + MODEL.margin + 0.1
    drivers = [
        scenes.driver(speed=15.0, steps=STEPS),
        scenes.driver(x=40.0, y=beside, speed=0.0, steps=STEPS),
    ]
    states = drive(road(drivers, tmp_path), [0])
    assert speed(states)[:, 0].min() > 14.5


def test_it_stops_at_red_and_starts_at_green(tmp_path: Path) -> None:
    states_ = [int(LightState.STOP)] * 150 + [int(LightState.GO)] * 150
    file = road(
        [scenes.driver(speed=12.0, steps=STEPS)], tmp_path, lights=light(70.0, states_)
    )
    states = drive(file, [0])
    front = states[:, 0, 0] + scenes.LENGTH / 2
    red = slice(0, 140)
    assert 70.0 - front[red].max() == pytest.approx(MODEL.stop.gap, abs=0.3)
    assert speed(states)[139, 0] < 0.1
    assert front[-1] > 75.0
    assert speed(states)[-1, 0] > 8.0


@pytest.mark.parametrize(
    ("at", "state", "stops"),
    [
        (40.0, LightState.CAUTION, True),  # needs 2 m/s^2
        (22.0, LightState.CAUTION, False),  # 4
        (22.0, LightState.STOP, True),
        (10.0, LightState.STOP, False),  # 7.2
        (40.0, LightState.ARROW_STOP, True),
        (40.0, LightState.FLASHING_CAUTION, False),
        (40.0, LightState.UNKNOWN, False),
    ],
)
def test_which_lights_hold(at: float, state: LightState, stops, tmp_path: Path) -> None:
    """At 12 m/s; the line `at` metres ahead of the bumper at the first step."""
    x = at + 12.0 * 0.3 + scenes.LENGTH / 2
    file = road(
        [scenes.driver(speed=12.0, steps=STEPS)],
        tmp_path,
        lights=light(x, [int(state)] * STEPS),
    )
    states = drive(file, [0])
    assert (speed(states)[:, 0].min() < 0.5) == stops
    if stops:
        assert states[:, 0, 0].max() + scenes.LENGTH / 2 < x


def test_at_a_stop_sign_it_stands_then_goes(tmp_path: Path) -> None:
    """Flashing red is one: the same rule."""
    flashing = [int(LightState.FLASHING_STOP)] * STEPS
    file = road(
        [scenes.driver(speed=12.0, steps=STEPS)], tmp_path, lights=light(70.0, flashing)
    )
    states = drive(file, [0])
    slow = speed(states)[:, 0] < 0.1
    assert slow.any()
    front = states[:, 0, 0] + scenes.LENGTH / 2
    assert 0.0 < 70.0 - front[slow].max() < MODEL.stop.zone
    assert front[-1] > 100.0
    assert np.abs(np.diff(slow.astype(int))).sum() == 2  # it stops once


@pytest.mark.slow
def test_a_stop_sign_holds_and_who_stands_on_a_lane_is_not_parked(
    tmp_path: Path,
) -> None:
    """A limit of 10 m/s, a sign 70 m along; a car stands on the lane, one beside it."""
    line = np.stack([np.arange(-150.0, 700.0, 5.0), *np.zeros((2, 170))], -1)
    lane = Polyline(RoadKind.LANE_STREET, line, feature_id=7, speed_limit=10.0)
    sign = Polyline(RoadKind.STOP_SIGN, np.array([[70.0, -4.0, 0.0]]), stop_lanes=(7,))
    drivers = [
        scenes.driver(speed=8.0, steps=STEPS),
        scenes.driver(x=-100.0, speed=0.0, steps=STEPS),
        scenes.driver(x=-100.0, y=-4.0, speed=0.0, steps=STEPS),
    ]
    roads = [*scenes.corridor(half=70.0, start=-200.0, end=800.0), lane, sign]
    file = scenes.bank_of([scenes.scene_of(drivers, roads=roads)], tmp_path)
    states = drive(file, [0, 1, 2])
    pace, front = speed(states), states[..., 0] + scenes.LENGTH / 2
    slow = pace[:, 0] < 0.1
    assert slow.any()
    assert 0.0 < 70.0 - front[slow, 0].max() < MODEL.stop.zone
    assert front[-1, 0] > 100.0
    assert pace[:, 0].max() < 10.1
    assert front[-1, 1] > -60.0
    np.testing.assert_allclose(pace[:, 2], 0.0, atol=1e-6)


def test_a_platoon_damps_what_its_leader_does(tmp_path: Path) -> None:
    """Nobody hits anybody, and the disturbance shrinks from car to car."""
    followers = OBJECTS - 1
    time = 0.1 * np.arange(STEPS)
    pace = np.where((time > 10) & (time < 12), 6.0, 10.0)
    leader = scenes.driver(x=0.0, steps=STEPS)
    leader[:, 0] = np.concatenate([[0.0], np.cumsum(pace[:-1] * 0.1)])
    leader[:, 3] = pace
    spacing = (2.0 + 12.0) / np.sqrt(1 - (10 / 15) ** 4) + scenes.LENGTH
    drivers = [leader] + [
        scenes.driver(x=-spacing * (k + 1), speed=10.0, steps=STEPS)
        for k in range(followers)
    ]
    states = drive(road(drivers, tmp_path), list(range(1, OBJECTS)))
    first = leader[4 : 4 + len(states), 0]
    places = np.concatenate([first[:, None], states[..., 0]], 1)
    gaps = places[:, :-1] - places[:, 1:] - scenes.LENGTH
    assert gaps.min() > MODEL.standing_gap
    dips = 10.0 - speed(states)[60:].min(0)
    assert dips[0] > 0.5
    assert (np.diff(dips) < 0).all()


def test_who_starts_beside_its_path_returns_to_it(tmp_path: Path) -> None:
    """Over `settling` metres, without a jump of the yaw."""
    states = scenes.driver(speed=10.0, steps=STEPS)
    states[:6, 1] = 0.8
    states[:6, 2] = 0.2
    file = road([states], tmp_path)
    driven = drive(file, [0])
    assert abs(driven[-1, 0, 1]) < 0.02
    assert abs(driven[-1, 0, 2]) < 0.01
    yaw = np.concatenate([[0.2], driven[:, 0, 2]])
    assert np.abs(np.diff(yaw)).max() / (10.0 * 0.1) < 0.1  # 1/m


def test_pedestrians_and_the_parked_do_as_logged(tmp_path: Path) -> None:
    drivers = [
        scenes.driver(speed=10.0, steps=STEPS),
        scenes.driver(y=30.0, speed=1.2, yaw=1.0, steps=STEPS),
        scenes.driver(y=-30.0, speed=0.0, steps=STEPS),
        scenes.driver(y=60.0, speed=4.0, steps=STEPS),
    ]
    kinds = [
        ObjectType.VEHICLE,
        ObjectType.PEDESTRIAN,
        ObjectType.VEHICLE,
        ObjectType.CYCLIST,
    ]
    states = drive(road(drivers, tmp_path, kinds=kinds), [0, 1, 2, 3])
    np.testing.assert_allclose(
        states[:, 1, :2], drivers[1][4 : 4 + len(states), :2], atol=1e-4
    )
    np.testing.assert_allclose(states[:, 2], drivers[2][4 : 4 + len(states)], atol=1e-4)
    assert speed(states)[-1, 3] == pytest.approx(MODEL.cyclist_speed, abs=0.1)


def test_empty_slots_drive_nowhere_and_break_nothing(tmp_path: Path) -> None:
    """Every test here has them; without any, the same comes out."""
    drivers = [
        scenes.driver(x=-20.0 * k, speed=8.0 + k, steps=STEPS) for k in range(OBJECTS)
    ]
    file = road(drivers, tmp_path)
    some, every = drive(file, [0, 1, 2]), drive(file, range(OBJECTS))
    np.testing.assert_allclose(every[:, :3], some, atol=1e-3)


@pytest.mark.slow
def test_generated_traffic_reacts_without_a_crash_from_behind(tmp_path: Path) -> None:
    """All objects driven: speeds stay speeds, nobody is driven backwards."""
    file = scenes.bank_of(list(generate_many(5, 1)), tmp_path)
    objects = int(file.arrays["objects"][0])
    states = drive(file, range(objects), steps=80)
    assert speed(states).max() < 40.0
    way = np.diff(states[..., :2], axis=0)
    heading = np.stack([np.cos(states[:-1, :, 2]), np.sin(states[:-1, :, 2])], -1)
    vehicle = file.arrays["object_type"][0] == ObjectType.VEHICLE
    assert (way * heading).sum(-1)[:, vehicle[:objects]].min() > -0.05
