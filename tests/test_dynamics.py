"""Dynamics: exact solutions, inverses, and the discrete grids."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim import dynamics
from sim.dynamics import ActionConfig, ActionSpace, ObjectState
from tests.scenes import counted

DT = 0.1
PLACES = st.floats(-100, 100, width=32)
ANGLES = st.floats(-3.125, 3.125, width=32)
SPEEDS = st.floats(0.75, 30, width=32)
BICYCLE = ActionConfig()
DELTA = ActionConfig(space=ActionSpace.DELTA)
STEERING = ActionConfig(space=ActionSpace.STEERING)
GRIDS = pytest.mark.parametrize(
    "config", [BICYCLE, DELTA, STEERING], ids=["bicycle", "delta", "steering"]
)

bicycle = jax.jit(dynamics.bicycle, static_argnums=2)
bicycle_inverse = jax.jit(dynamics.bicycle_inverse, static_argnums=2)
steering = jax.jit(dynamics.steering, static_argnums=(2, 3))
steering_inverse = jax.jit(dynamics.steering_inverse, static_argnums=(2, 3))
delta = jax.jit(dynamics.delta, static_argnums=2)
delta_inverse = jax.jit(dynamics.delta_inverse)
limit_reverse = jax.jit(dynamics.limit_reverse, static_argnums=2)
inverse = jax.jit(dynamics.inverse, static_argnums=(2, 3))
replay = jax.jit(dynamics.replay, static_argnums=(2, 3))
apply_discrete = jax.jit(dynamics.apply_discrete, static_argnums=(2, 3))
nearest_action = jax.jit(dynamics.nearest_action, static_argnums=2)


def state(
    x: float = 0, y: float = 0, yaw: float = 0, v_x: float = 0, v_y: float = 0
) -> ObjectState:
    """A state of float32 scalars."""
    return ObjectState(*(jnp.float32(value) for value in (x, y, yaw, v_x, v_y)))


def driving(x: float, y: float, yaw: float, speed: float) -> ObjectState:
    """A state whose velocity lies along its yaw."""
    return state(x, y, yaw, speed * np.cos(yaw), speed * np.sin(yaw))


def assert_same(one: ObjectState, other: ObjectState, atol: float) -> None:
    """Equal but for rounding; angles on the circle."""
    turn = (float(one.yaw) - float(other.yaw) + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn) < atol
    for name in ("x", "y", "v_x", "v_y"):
        assert float(getattr(one, name)) == pytest.approx(
            float(getattr(other, name)), abs=atol
        )


@given(PLACES, PLACES, ANGLES, PLACES, PLACES, ANGLES)
@settings(max_examples=100, deadline=None)
def test_delta_forward_undoes_its_inverse(x, y, yaw, to_x, to_y, to_yaw) -> None:
    before = state(x, y, yaw, 1, 2)
    after = state(to_x, to_y, to_yaw, (to_x - x) / DT, (to_y - y) / DT)
    reached = delta(before, delta_inverse(before, after), DT)
    assert_same(reached, after, atol=1e-2)  # velocities: 1e-5 m / 0.1 s, twice
    assert -np.pi <= float(reached.yaw) < np.pi


@given(PLACES, PLACES, ANGLES, SPEEDS, st.floats(-6, 6), st.floats(-0.3, 0.3))
@settings(max_examples=200, deadline=None)
def test_bicycle_inverse_finds_the_action(x, y, yaw, speed, a, kappa) -> None:
    after_speed = speed + a * DT
    if after_speed < dynamics.SLOW:
        a = (0.75 - speed) / DT
    action = jnp.array([a, kappa], jnp.float32)
    before = driving(x, y, yaw, speed)
    after = bicycle(before, action, DT)
    found = bicycle_inverse(before, after, DT)
    assert float(found[0]) == pytest.approx(a, abs=1e-3)
    # An error of the heading, 1e-6 rad, over the shortest way, 0.07 m.
    assert float(found[1]) == pytest.approx(kappa, abs=1e-4)
    assert_same(bicycle(before, found, DT), after, atol=1e-3)


def test_a_straight_drive_along_x_has_no_curvature() -> None:
    """The paper's printed arctan(v_x'/v_y') says 90 degrees here."""
    found = bicycle_inverse(driving(0, 0, 0, 10), driving(1, 0, 0, 10), DT)
    np.testing.assert_allclose(found, [0.0, 0.0], atol=1e-6)
    printed = np.arctan(np.float32(10) / np.float32(1e-9))
    assert printed / (10 * DT) > 1.5  # 1/m: what the misprint would have steered


def test_bicycle_inverse_on_every_heading() -> None:
    for yaw in np.linspace(-np.pi, np.pi, 9):
        before = driving(0, 0, yaw, 10)
        after = bicycle(before, jnp.array([0.0, 0.1]), DT)
        found = bicycle_inverse(before, after, DT)
        np.testing.assert_allclose(found, [0.0, 0.1], atol=1e-4)


def circle_error(dt: float, kappa: float = 0.05, speed: float = 10.0) -> float:
    """Distance from the exact circle after 2 s at constant speed and curvature."""
    now = driving(0, 0, 0, speed)
    for _ in range(round(2.0 / dt)):
        now = bicycle(now, jnp.array([0.0, kappa]), dt)
    angle = kappa * speed * 2.0
    exact = np.array([np.sin(angle), 1 - np.cos(angle)]) / kappa
    assert float(now.yaw) == pytest.approx(angle, abs=1e-4)  # exact in the yaw
    return float(np.hypot(float(now.x) - exact[0], float(now.y) - exact[1]))


def test_bicycle_converges_to_the_circle_in_first_order() -> None:
    """Halving dt halves the distance from the exact circle."""
    errors = np.array([circle_error(dt) for dt in (0.2, 0.1, 0.05)])
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.15)


def test_bicycle_accelerates_exactly_on_a_straight() -> None:
    now = driving(0, 0, 0.5, 4.0)
    for _ in range(20):
        now = bicycle(now, jnp.array([1.5, 0.0]), DT)
    travelled = 4.0 * 2 + 0.5 * 1.5 * 2**2
    assert_same(
        now,
        driving(travelled * np.cos(0.5), travelled * np.sin(0.5), 0.5, 4.0 + 1.5 * 2),
        atol=1e-4,
    )


@given(st.floats(-1000, 1000, width=32))
@settings(max_examples=200, deadline=None)
def test_wrap_keeps_the_direction(angle) -> None:
    wrapped = float(dynamics.wrap(jnp.float32(angle)))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(np.float32(angle)), abs=5e-4)
    assert np.sin(wrapped) == pytest.approx(np.sin(np.float32(angle)), abs=5e-4)


def test_wrap_at_its_ends() -> None:
    half = jnp.float32(jnp.pi)
    assert float(dynamics.wrap(half)) == pytest.approx(-np.pi)
    assert float(dynamics.wrap(jnp.float32(0.0))) == 0.0


@given(ANGLES, st.floats(0, 30, width=32), st.floats(-20, 5), st.floats(-0.3, 0.3))
@settings(max_examples=200, deadline=None)
def test_limited_braking_never_reverses(yaw, speed, a, kappa) -> None:
    before = driving(3, -2, yaw, speed)
    action = jnp.array([a, kappa], jnp.float32)
    limited = limit_reverse(before, action, DT)
    after = bicycle(before, limited, DT)
    ahead = after.v_x * jnp.cos(after.yaw) + after.v_y * jnp.sin(after.yaw)
    assert float(ahead) >= -1e-5
    moved = (after.x - before.x) * np.cos(yaw) + (after.y - before.y) * np.sin(yaw)
    assert float(moved) >= -1e-5
    if speed + a * DT > 1e-3:  # strong enough brakes only are changed
        np.testing.assert_allclose(limited, action, atol=1e-30)
    assert float(limited[1]) == pytest.approx(float(action[1]), abs=1e-30)


def test_below_walking_speed_the_inverse_does_not_steer() -> None:
    """The velocity's heading is noise there: its sign alone would ask for a U-turn."""
    for before, after in ((0.5, 0.5), (0.5, 0.7), (0.7, 0.5), (0.0, 0.0)):
        found = bicycle_inverse(driving(0, 0, 0, before), driving(0, 0, 3.0, after), DT)
        assert float(found[1]) == 0.0
        assert float(found[0]) == pytest.approx((after - before) / DT, abs=1e-4)
    found = bicycle_inverse(driving(0, 0, 0, 0.7), driving(0, 0, 0.01, 0.7), DT)
    assert float(found[1]) == pytest.approx(0.01 / 0.07, abs=1e-3)


def test_replay_below_walking_speed_takes_the_recorded_yaw() -> None:
    replay = jax.jit(dynamics.bicycle_replay, static_argnums=2)
    slow = replay(driving(5, 5, 1, 0.5), state(0, 0, 0.3), DT)
    assert float(slow.yaw) == pytest.approx(0.3)
    fast = replay(driving(5, 5, 1, 5), driving(5.3, 5.4, 1.2, 5), DT)
    assert float(fast.yaw) == pytest.approx(1.2, abs=1e-4)  # along the new velocity


@given(st.floats(-6, 6), st.floats(1.5, 5), st.floats(10, 20))
@settings(max_examples=100, deadline=None)
def test_steering_wheel_and_curvature_are_inverse(wheel, axle, ratio) -> None:
    kappa = dynamics.steering_to_curvature(jnp.float32(wheel), axle, ratio)
    assert float(kappa) == pytest.approx(np.sin(wheel / ratio) / axle, abs=1e-5)
    back = dynamics.curvature_to_steering(kappa, axle, ratio)
    assert float(back) == pytest.approx(wheel, abs=1e-3)


@given(PLACES, PLACES, ANGLES, PLACES, PLACES, ANGLES, PLACES, PLACES)
@settings(max_examples=50, deadline=None)
def test_playback_takes_the_state(x, y, yaw, to_x, to_y, to_yaw, v_x, v_y) -> None:
    before, after = state(x, y, yaw, 1, 2), state(to_x, to_y, to_yaw, v_x, v_y)
    assert dynamics.playback(before, dynamics.playback_inverse(before, after)) == after


@given(PLACES, PLACES, ANGLES, SPEEDS, st.floats(-6, 6), st.floats(-9, 9))
@settings(max_examples=100, deadline=None)
def test_steering_forward_undoes_its_inverse(x, y, yaw, speed, a, angle) -> None:
    a = max(a, (0.75 - speed) / DT)
    before, wheel = driving(x, y, yaw, speed), STEERING.steering
    action = jnp.array([a, angle], jnp.float32)
    after = steering(before, action, wheel, DT)
    kappa = np.sin(angle / wheel.steer_ratio) / wheel.axle_distance
    assert_same(after, bicycle(before, jnp.array([a, kappa], jnp.float32), DT), 1e-4)
    found = steering_inverse(before, after, wheel, DT)
    assert float(found[0]) == pytest.approx(a, abs=1e-3)
    assert float(found[1]) == pytest.approx(angle, abs=1e-2)
    assert_same(steering(before, found, wheel, DT), after, atol=1e-3)


def test_a_curvature_beyond_the_wheel_is_clipped() -> None:
    wheel = dynamics.curvature_to_steering(jnp.float32(2.0), 3.0, 15.0)
    assert float(wheel) == pytest.approx(15.0 * np.pi / 2)


@GRIDS
def test_grids_have_a_zero_and_reach_their_limits(config: ActionConfig) -> None:
    table = dynamics.action_table(config)
    assert len(table) == config.count
    assert (table == 0).all(1).sum() == 1
    assert len(np.unique(table, axis=0)) == config.count
    limits = {
        ActionSpace.BICYCLE: (config.acceleration, config.curvature),
        ActionSpace.STEERING: (config.acceleration, config.wheel),
        ActionSpace.DELTA: (config.forward, config.sideways, config.turn),
    }[config.space]
    np.testing.assert_allclose(table.max(0), limits, rtol=1e-6)
    lowest = -np.array(limits)
    if config.space == ActionSpace.DELTA:
        lowest[0] = 0.0  # none backwards
    np.testing.assert_allclose(table.min(0), lowest, rtol=1e-6)


def test_one_bin_is_zero() -> None:
    table = dynamics.action_table(ActionConfig(acceleration_bins=1, curvature_bins=1))
    np.testing.assert_array_equal(table, [[0.0, 0.0]])


@GRIDS
@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_nearest_action_is_the_nearest(config: ActionConfig, data) -> None:
    table = dynamics.action_table(config).astype(np.float64)
    limits = np.abs(table).max(0)
    yaw = data.draw(ANGLES)
    own = np.array([data.draw(st.floats(-1.2, 1.2)) * limit for limit in limits])
    action = own.copy()
    if config.space == ActionSpace.DELTA:  # the log's actions are the map's
        cos, sin = np.cos(yaw), np.sin(yaw)
        action[:2] = cos * own[0] - sin * own[1], sin * own[0] + cos * own[1]
    index = nearest_action(state(yaw=yaw), jnp.asarray(action, jnp.float32), config)
    distance = (((table - own) / limits) ** 2).sum(1)
    assert distance[int(index)] == pytest.approx(distance.min(), abs=1e-5)


@GRIDS
def test_a_grids_own_action_is_found_again(config: ActionConfig) -> None:
    before = driving(1, 2, 0.7, 8)
    for index in range(0, config.count, 5):
        after = apply_discrete(before, jnp.int32(index), config, DT)
        action = inverse(before, after, config, DT)
        assert int(nearest_action(before, action, config)) == index


def test_discrete_delta_moves_ahead_whatever_the_yaw() -> None:
    table = dynamics.action_table(DELTA)
    index = int(np.flatnonzero((table == [3.0, 0.0, 0.0]).all(1))[0])
    for yaw in (0.0, 1.0, -2.0):
        after = apply_discrete(driving(0, 0, yaw, 1), jnp.int32(index), DELTA, DT)
        assert_same(after, driving(3 * np.cos(yaw), 3 * np.sin(yaw), yaw, 30), 1e-4)


def test_discrete_bicycle_stands_rather_than_reverses() -> None:
    table = dynamics.action_table(BICYCLE)
    hardest = int(table[:, 0].argmin())
    now = driving(0, 0, 0.3, 1.0)
    for _ in range(5):
        now = apply_discrete(now, jnp.int32(hardest), BICYCLE, DT)
    assert float(jnp.hypot(now.v_x, now.v_y)) == pytest.approx(0.0, abs=1e-6)
    assert float(now.x) > 0


@pytest.mark.parametrize(
    "name",
    ["acceleration_bins", "curvature_bins", "wheel_bins", "sideways_bins", "turn_bins"],
)
@pytest.mark.parametrize("bins", [0, 4, -1])
def test_grids_without_a_zero_are_refused(name: str, bins: int) -> None:
    with pytest.raises(ValueError, match=f"{name}={bins} must be odd"):
        dataclasses.replace(BICYCLE, **{name: bins})


def test_stepping_compiles_once() -> None:
    step, traces = counted(
        lambda now, index: dynamics.apply_discrete(now, index, BICYCLE, DT)
    )
    for speed, index in ((1.0, 3), (2.0, 50)):
        step(driving(0, 0, 0, speed), jnp.int32(index))
    assert len(traces) == 1


def test_a_single_bin_is_no_distance():
    """All actions have that component: what it lacks is the same for each."""
    config = ActionConfig(space=ActionSpace.DELTA, sideways_bins=1)
    table = dynamics.action_table(config)
    state = ObjectState(*jnp.zeros(5))
    for index in (0, 5, len(table) - 1):
        action = jnp.asarray(table[index] + np.array([0.01, 0.15, 0.001], np.float32))
        assert int(dynamics.nearest_action(state, action, config)) == index
