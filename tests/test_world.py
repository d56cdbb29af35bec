"""Several controlled objects in one scene: seen and judged where they are simulated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim import environment
from sim.bank import Bank, BankFile
from sim.environment import EnvironmentConfig, Judgement, State
from sim.observation import Observation, ObservationConfig, observe
from sim.procedural import generate_many
from sim.world import View, world_of
from tests import oracle, scenes
from tests.seeing import view_of

CONFIG = EnvironmentConfig(observation=ObservationConfig(road_rows=8))
LOOK = CONFIG.observation
NOW = scenes.CURRENT

_observe = jax.jit(observe, static_argnums=2)
_reset = jax.jit(environment.reset, static_argnums=3)
_step = jax.jit(environment.step, static_argnums=3)
_advance = jax.jit(environment.advance, static_argnums=3)
_judge = jax.jit(environment.judge, static_argnums=3)
_world = jax.jit(world_of)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    return scenes.bank_of(list(generate_many(31, 3)), tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """Two cars side by side, 10 m apart, and a third far ahead."""
    drivers = [scenes.driver(), scenes.driver(y=10.0), scenes.driver(x=40.0)]
    roads = scenes.corridor(half=30.0)
    return scenes.bank_of(
        [scenes.scene_of(drivers, roads=roads)], tmp_path_factory.mktemp("pair")
    )


def pushed(file: BankFile, scene: int, step: int, rows: list[int], seed: int) -> View:
    """Some objects, each a little off its log and at times not there."""
    view = view_of(file, scene, step, *rows, length=LOOK.history)
    rng = np.random.default_rng(seed)
    moves = rng.normal(0, [2.0, 2.0, 0.3, 1.0, 1.0], view.history.shape)
    there = rng.random(view.history_valid.shape) < 0.9
    return view._replace(
        history=(view.history + moves).astype(np.float32),
        history_valid=view.history_valid & there,
    )


def rewritten(file: BankFile, view: View) -> Bank:
    """Oracle: the bank whose log is what was simulated."""
    log, valid = file.arrays["log"].copy(), file.arrays["log_valid"].copy()
    steps = view.step - np.arange(view.history.shape[1] - 1, -1, -1)
    for slot, row in enumerate(view.controlled):
        log[view.scene, steps[:, None], row, [0, 1, 3, 4, 5]] = view.history[slot]
        valid[view.scene, steps, row] = view.history_valid[slot]
    return file.bank._replace(log=jnp.asarray(log), log_valid=jnp.asarray(valid))


def test_each_sees_the_others_where_they_are_simulated(made: BankFile) -> None:
    """Against one object at a time in a log that says what was simulated."""
    for seed, (scene, step) in enumerate([(0, 10), (1, 40), (2, 70)]):
        valid = np.flatnonzero(made.arrays["log_valid"][scene, step])
        view = pushed(made, scene, step, [int(row) for row in valid[:6]], seed)
        found = jax.device_get(_observe(made.bank, view, LOOK))
        bank = rewritten(made, view)
        assert found.agents_valid.sum() > 6
        for slot in range(6):
            alone = view._replace(
                controlled=view.controlled[slot : slot + 1],
                history=view.history[slot : slot + 1],
                history_valid=view.history_valid[slot : slot + 1],
            )
            expected = _observe(bank, alone, LOOK)
            for name in Observation._fields:
                np.testing.assert_allclose(
                    getattr(found, name)[slot],
                    getattr(expected, name)[0],
                    atol=1e-5,
                    err_msg=name,
                )


def test_moving_one_changes_what_the_other_sees_and_hits(pair: BankFile) -> None:
    """The second car cuts in: 5 m ahead of the first, then onto it."""
    state = _reset(pair.bank, jnp.int32(0), jnp.array([0, 1]), CONFIG)
    place = state.history[:, -1]
    for ahead, hit in ((5.0, False), (3.0, True)):
        moved = place.at[1, :2].set(place[0, :2] + jnp.array([ahead, 0.0]))
        after, outcome = _advance(pair.bank, state, moved, CONFIG)
        seen = _observe(pair.bank, after.view, LOOK)
        assert outcome.overlap.tolist() == [hit, hit]
        now = np.asarray(seen.agents[:, 0, 7 * (LOOK.history - 1) :])
        np.testing.assert_allclose(now[:, 0] * 30, [ahead, -ahead], atol=1e-4)
        np.testing.assert_allclose(now[:, 1] * 30, 0, atol=1e-4)


def test_a_controlled_object_alone_sees_the_log(pair: BankFile) -> None:
    """Of the other, which is not controlled now, the log counts."""
    state = _reset(pair.bank, jnp.int32(0), jnp.array([0]), CONFIG)
    after, _ = _advance(pair.bank, state, state.history[:, -1], CONFIG)
    seen = _observe(pair.bank, after.view, LOOK)
    aside = float(seen.agents[0, 0, 7 * (LOOK.history - 1) + 1]) * 30
    assert aside == pytest.approx(10.0, abs=1e-4)


def test_the_world_has_no_history_before_the_recording(pair: BankFile) -> None:
    world = _world(pair.bank, view_of(pair, 0, 1, 0, 1, length=3))
    assert world.valid.tolist() == [[False, True, True]] * 3


def test_all_metrics_of_all_objects_are_the_oracles(made: BankFile) -> None:
    """Driven at random for a while."""
    rng = np.random.default_rng(5)
    objects = made.arrays["log"].shape[2]
    everything = jnp.arange(objects, dtype=jnp.int32)
    before = _reset(made.bank, jnp.int32(1), everything, CONFIG)
    recorded = list(generate_many(31, 3))[1]
    for _ in range(25):
        action = rng.integers(0, CONFIG.action.count, objects).astype(np.int32)
        after, outcome = _step(made.bank, before, action, CONFIG)
        found = jax.device_get(_judge(made.bank, before, after, CONFIG.dt))
        assert_judged(made, recorded, before, after, found)
        known = environment.judge(made.bank, before, after, CONFIG.dt, outcome)
        assert (found.overlap == known.overlap).all()
        assert (found.offroad == known.offroad).all()
        before = after


def assert_judged(
    file: BankFile, recorded: scenes.Scene, before: State, after: State, found
) -> None:
    """A step's judgement is the oracle's but for poses at an edge or a limit."""
    step, now = int(after.step), np.asarray(after.history[:, -1], np.float64)
    valid = file.arrays["log_valid"][1, step]
    row = file.arrays["log"][1, step]
    corners = oracle.corners(now[:, :2], now[:, 2], row[:, 6], row[:, 7])
    hits = np.zeros(len(now), bool)
    hits[valid] = oracle.boxes_overlap(corners[valid]).any(1)
    np.testing.assert_array_equal(found.overlap, hits)
    edges = scenes.local_edges(recorded, file.origins[1])
    points, z = corners[valid].reshape(-1, 2), np.repeat(row[valid, 2], 4)
    wrong = oracle.corners_offroad(points, z, edges).reshape(-1, 4).any(1)
    near = oracle.edge_distance(points, z, edges).reshape(-1, 4).min(1) < 0.01
    np.testing.assert_array_equal(found.offroad[valid][~near], wrong[~near])
    assert not found.offroad[~valid].any()
    away = np.hypot(*(now[:, :2] - row[:, :2]).T)
    np.testing.assert_allclose(
        found.log_divergence, np.where(valid, away, 0), atol=1e-4
    )
    was = np.asarray(before.history[:, -1], np.float64)
    acceleration, curvature = oracle.bicycle_actions(
        was[:, 3:], now[:, 3:], was[:, 2], CONFIG.dt
    )
    excess = np.maximum(
        np.abs(acceleration) - oracle.MAX_ACCELERATION,
        np.abs(curvature) - oracle.MAX_CURVATURE,
    )
    clear = np.abs(excess) > 1e-3  # the grid of actions ends at the limit itself
    counts = valid & np.asarray(before.history_valid[:, -1])
    np.testing.assert_array_equal(
        found.kinematic_infeasibility[clear], (counts & (excess > 0))[clear]
    )


@given(st.lists(st.booleans(), min_size=6, max_size=6).filter(any), st.data())
@settings(max_examples=15, deadline=None)
def test_empty_slots_change_nothing_and_are_nothing(made, filled, data) -> None:
    """Some of six slots are emptied: the others fare as they would alone."""
    scene = data.draw(st.integers(0, made.scenes - 1))
    none = made.arrays["log"].shape[2]
    filled = np.array(filled)
    rows = np.where(filled, np.arange(6), none).astype(np.int32)
    packed = np.sort(rows)  # the same objects first, the empty slots behind
    order = np.argsort(rows, kind="stable")
    action = data.draw(st.integers(0, CONFIG.action.count - 1))
    actions = np.full(6, action, np.int32)
    one = _reset(made.bank, jnp.int32(scene), rows, CONFIG)
    other = _reset(made.bank, jnp.int32(scene), packed, CONFIG)
    for _ in range(3):
        before = one
        one, outcome = _step(made.bank, one, actions, CONFIG)
        other, expected = _step(made.bank, other, actions, CONFIG)
        judgement = jax.device_get(_judge(made.bank, before, one, CONFIG.dt))
        seen = jax.device_get(_observe(made.bank, one.view, LOOK))
        assert_nothing(outcome, judgement, seen, ~filled)
        assert not np.asarray(one.history_valid)[~filled].any()
        assert not np.asarray(one.history)[~filled].any()
        for name in ("reward", "overlap", "offroad", "terminated", "valid"):
            np.testing.assert_array_equal(
                np.asarray(getattr(outcome, name))[order], getattr(expected, name)
            )
        assert bool(outcome.truncated) == bool(expected.truncated)
        elsewhere = _observe(made.bank, other.view, LOOK)
        for name in Observation._fields:
            np.testing.assert_array_equal(
                getattr(seen, name)[order], getattr(elsewhere, name), err_msg=name
            )


def assert_nothing(
    outcome, judgement: Judgement, seen: Observation, empty: np.ndarray
) -> None:
    """Slots that hold no object are not valid, not judged, and see nothing."""
    for values in (*outcome._replace(truncated=np.zeros(6, bool)), *judgement, *seen):
        assert not np.asarray(values)[empty].any()


def test_a_scene_of_empty_slots_is_over(made: BankFile) -> None:
    none = made.arrays["log"].shape[2]
    state = _reset(made.bank, jnp.int32(0), np.full(6, none, np.int32), CONFIG)
    _, outcome = _step(made.bank, state, np.zeros(6, np.int32), CONFIG)
    assert bool(outcome.truncated)


def test_judging_and_observing_compile_once(pair: BankFile) -> None:
    state = _reset(pair.bank, jnp.int32(0), jnp.array([0, 1]), CONFIG)
    judged, judge_traces = scenes.counted(
        lambda before, after: environment.judge(pair.bank, before, after, CONFIG.dt)
    )
    seen, observe_traces = scenes.counted(lambda view: observe(pair.bank, view, LOOK))
    for action in (0, 1):
        after, _ = _step(pair.bank, state, np.full(2, action, np.int32), CONFIG)
        judged(state, after)
        seen(after.view)
        state = after
    assert len(judge_traces) == len(observe_traces) == 1
