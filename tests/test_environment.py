"""Reset, step, reward, ends of episodes."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import environment
from sim.bank import BankFile
from sim.dynamics import ActionConfig, ActionSpace, action_table
from sim.environment import EnvironmentConfig, Outcome, State
from sim.observation import ObservationConfig
from sim.procedural import generate_many
from tests import scenes

CONFIG = EnvironmentConfig()
ENDING = EnvironmentConfig(terminate=True)
PROGRESS = EnvironmentConfig(progress=0.5)
STEPS, NOW = scenes.STEPS, scenes.CURRENT

_reset = jax.jit(environment.reset, static_argnums=3)
_start_at = jax.jit(environment.start_at, static_argnums=4)
_step = jax.jit(environment.step, static_argnums=3)
_advance = jax.jit(environment.advance, static_argnums=3)

# Scenes of the bank: alone on a straight road; towards a parked car; leaving the
# road at an angle; half as long; with an object that appears and one that leaves.
ALONE, PARKED, LEAVING, SHORT, GAPS = range(5)


def idle(config: EnvironmentConfig = CONFIG) -> int:
    """The action that keeps speed and heading."""
    return int(np.flatnonzero((action_table(config.action) == 0).all(1))[0])


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    parked = scenes.driver(x=14.0, speed=0.0)
    valid = np.ones((3, STEPS), bool)
    valid[1, :10] = False
    valid[2, 10:] = False
    every = [
        scenes.scene_of([scenes.driver(), scenes.driver(y=3, speed=5.0)], name="a"),
        scenes.scene_of([scenes.driver(), parked], name="b"),
        scenes.scene_of([scenes.driver(yaw=0.5)], name="c"),
        scenes.scene_of([scenes.driver(steps=9)], name="d"),
        scenes.scene_of(
            [scenes.driver(y=y) for y in (-3, 0, 3)], name="e", valid=valid
        ),
    ]
    return scenes.bank_of(every, tmp_path_factory.mktemp("environment"))


def start(
    file: BankFile,
    scene: int,
    *controlled: int,
    config: EnvironmentConfig = CONFIG,
) -> State:
    """The scene at its start."""
    rows = jnp.asarray(controlled or (0,), jnp.int32)
    return _reset(file.bank, jnp.int32(scene), rows, config)


def run(
    file: BankFile, state: State, config: EnvironmentConfig = CONFIG
) -> list[tuple[State, Outcome]]:
    """Idles to the recording's end."""
    action = jnp.full(state.controlled.shape, idle(config), jnp.int32)
    results = []
    while True:
        state, outcome = _step(file.bank, state, action, config)
        results.append((state, outcome))
        if outcome.truncated:
            return results


def test_a_scene_starts_at_its_current_step_with_its_history(file) -> None:
    state = start(file, ALONE, 0, 1)
    assert int(state.step) == NOW
    assert state.history.shape == (2, 3, 5)
    assert state.history_valid.all()
    log = file.arrays["log"][ALONE, NOW - 2 : NOW + 1, :2][..., [0, 1, 3, 4, 5]]
    np.testing.assert_array_equal(state.history, log.transpose(1, 0, 2))
    np.testing.assert_allclose(state.along, [4.0, 2.0], atol=1e-4)


def test_before_the_recording_there_is_no_history(file) -> None:
    state = _start_at(file.bank, jnp.int32(ALONE), jnp.int32(1), jnp.array([0]), CONFIG)
    assert state.history_valid.tolist() == [[False, True, True]]


def test_an_idle_step_moves_on_and_shifts_the_history(file) -> None:
    before = start(file, ALONE)
    after, outcome = _step(file.bank, before, jnp.array([idle()], jnp.int32), CONFIG)
    assert int(after.step) == NOW + 1
    np.testing.assert_array_equal(after.history[:, :-1], before.history[:, 1:])
    moved = np.asarray(after.history[0, -1] - before.history[0, -1])
    np.testing.assert_allclose(moved, [1, 0, 0, 0, 0], atol=1e-5)
    assert float(after.along[0] - before.along[0]) == pytest.approx(1.0, abs=1e-4)
    assert float(outcome.reward[0]) == 0.0
    assert outcome.valid.all()
    assert not outcome.terminated.any()
    assert not outcome.truncated


def test_the_recordings_end_truncates_and_does_not_terminate(file) -> None:
    for config in (CONFIG, ENDING):
        results = run(file, start(file, ALONE, config=config), config)
        assert len(results) == STEPS - 1 - NOW
        assert not any(bool(outcome.terminated.any()) for _, outcome in results)
        assert int(results[-1][0].step) == STEPS - 1


def test_a_shorter_recording_ends_sooner(file) -> None:
    results = run(file, start(file, SHORT))
    assert len(results) == 9 - 1 - NOW
    assert int(results[-1][0].step) == 8


def test_hitting_a_parked_car_costs_one_a_step(file) -> None:
    """Both are 4 m long: they meet with their centres 4 m apart, and drive on."""
    results = run(file, start(file, PARKED))
    x = np.array([float(state.history[0, -1, 0]) for state, _ in results]) + 4
    hit = np.array([bool(outcome.overlap[0]) for _, outcome in results])
    apart = np.abs(x - 14.0)
    clear = np.abs(apart - 4) > 1e-3
    np.testing.assert_array_equal(hit[clear], (apart < 4)[clear])
    assert hit.any()
    assert not hit.all()
    for overlaps, (_, outcome) in zip(hit, results, strict=True):
        assert float(outcome.reward[0]) == -float(overlaps)
        assert not outcome.offroad.any()


def test_leaving_the_road_costs_one_a_step(file) -> None:
    results = run(file, start(file, LEAVING))
    off = [bool(outcome.offroad[0]) for _, outcome in results]
    assert off[0] is False
    assert off[-1] is True
    for offroad, (_, outcome) in zip(off, results, strict=True):
        assert float(outcome.reward[0]) == -float(offroad)


def test_penalties_are_as_configured(file) -> None:
    config = EnvironmentConfig(overlap_penalty=3.0, offroad_penalty=0.25)
    hit = run(file, start(file, PARKED, config=config), config)[8][1]
    assert float(hit.reward[0]) == -3.0
    off = run(file, start(file, LEAVING, config=config), config)[-1][1]
    assert float(off.reward[0]) == -0.25


def test_a_failure_terminates_only_where_asked(file) -> None:
    for scene in (PARKED, LEAVING):
        for config in (CONFIG, ENDING):
            for _, outcome in run(file, start(file, scene, config=config), config):
                failed = bool(outcome.overlap[0] | outcome.offroad[0])
                assert bool(outcome.terminated[0]) is (failed and config.terminate)


def test_progress_is_rewarded_only_when_on(file) -> None:
    """0.5 a metre, up to the log's end: 15 m from the current step."""
    paper = run(file, start(file, ALONE))
    assert sum(float(outcome.reward[0]) for _, outcome in paper) == 0.0
    rewarded = run(file, start(file, ALONE, config=PROGRESS), PROGRESS)
    total = sum(float(outcome.reward[0]) for _, outcome in rewarded)
    assert total == pytest.approx(0.5 * 15, abs=1e-3)


def test_speeding_pays_no_more_than_keeping_up_with_the_log(file) -> None:
    table = action_table(PROGRESS.action)
    fastest = int(np.flatnonzero((table == [6.0, 0.0]).all(1))[0])
    state, total = start(file, ALONE, config=PROGRESS), 0.0
    for _ in range(STEPS - 1 - NOW):
        state, outcome = _step(
            file.bank, state, jnp.array([fastest], jnp.int32), PROGRESS
        )
        total += float(outcome.reward[0])
    assert float(state.along[0]) > 20
    assert total <= 0.5 * 15 + 1e-3


def test_behind_the_log_every_metre_counts_both_ways(file) -> None:
    state = start(file, ALONE, config=PROGRESS)
    here = state.history[:, -1]
    on, gained = _advance(
        file.bank, state, here + jnp.array([[0.5, 0, 0, 0, 0]]), PROGRESS
    )
    _, lost = _advance(file.bank, on, here, PROGRESS)
    assert float(gained.reward[0]) == pytest.approx(0.25, abs=1e-3)
    assert float(lost.reward[0]) == pytest.approx(-0.25, abs=1e-3)


def test_far_from_the_route_nothing_counts(file) -> None:
    """5 m aside is off the road here too, which costs 1."""
    state = start(file, ALONE, config=PROGRESS)
    aside = state.history[:, -1] + jnp.array([[0.5, -5.0, 0, 0, 0]])
    _, outcome = _advance(file.bank, state, aside, PROGRESS)
    assert float(outcome.reward[0]) == -1.0


def test_comfort_costs_the_acceleration_of_what_is_driven(file) -> None:
    """1 m/s over 0.1 s is 10 m/s^2; the second object is the log's until step 10."""
    config = EnvironmentConfig(comfort=0.25, overlap_penalty=0.0, offroad_penalty=0.0)
    state = start(file, GAPS, 0, 1, config=config)
    for change, cost in (([0.0, 0.0], 0.0), ([0.6, -0.8], 2.5)):
        moved = np.asarray(state.history[:, -1]) + np.array([0, 0, 0, *change])
        _, outcome = _advance(file.bank, state, jnp.asarray(moved, "float32"), config)
        np.testing.assert_allclose(outcome.reward, [-cost, 0.0], atol=1e-5)


def test_an_object_that_is_not_recorded_yet_follows_the_log(file) -> None:
    state = start(file, GAPS, 0, 1, 2)
    assert state.history_valid[:, -1].tolist() == [True, False, True]
    for state, outcome in run(file, state):  # noqa: B020 - the newest state
        step = int(state.step)
        assert outcome.valid.tolist() == [True, step >= 10, step < 10]
        logged = file.arrays["log"][GAPS, step, :3][:, [0, 1, 3, 4, 5]]
        # All idle as they were recorded; the second only from step 11 on.
        np.testing.assert_allclose(state.history[:, -1], logged, atol=1e-4)


def test_an_object_that_is_not_recorded_fails_nothing(file) -> None:
    """Put onto another one, before and after it appears."""
    before = start(file, GAPS, 1)
    onto = before.history[:, -1].at[:, 1].set(0.0)  # the first one's place
    _, outcome = _advance(file.bank, before, onto, CONFIG)
    assert not outcome.overlap.any()
    assert not outcome.valid.any()
    assert bool(outcome.truncated)  # nobody is left to act
    at_ten = _start_at(
        file.bank, jnp.int32(GAPS), jnp.int32(10), jnp.array([1]), CONFIG
    )
    onto = at_ten.history[:, -1].at[:, 1].set(0.0).at[:, 0].add(1.0)
    _, outcome = _advance(file.bank, at_ten, onto, CONFIG)
    assert outcome.overlap.all()


def test_controlled_objects_meet_where_they_are_not_where_they_were(file) -> None:
    """Two controlled cars swap places with the log's ghosts: only they count."""
    state = start(file, ALONE, 0, 1)
    apart = state.history[:, -1] + jnp.array([[0, 0, 0, 0, 0], [0, 50.0, 0, 0, 0]])
    _, outcome = _advance(file.bank, state, apart, CONFIG)
    assert not outcome.overlap.any()
    onto = jnp.stack([apart[1], apart[1]])
    _, outcome = _advance(file.bank, state, onto, CONFIG)
    assert outcome.overlap.all()


def test_a_batch_is_its_scenes(tmp_path: Path) -> None:
    """`jax.vmap` outside gives what one scene alone gives."""
    file = scenes.bank_of(list(generate_many(4, 3)), tmp_path)
    bank = file.bank
    rng = np.random.default_rng(0)
    index = jnp.array([0, 1, 2, 1], jnp.int32)
    controlled = jnp.tile(jnp.arange(4, dtype=jnp.int32), (4, 1))

    def one(scene, rows, actions):
        state = environment.reset(bank, scene, rows, PROGRESS)
        return jax.lax.scan(
            lambda now, action: environment.step(bank, now, action, PROGRESS),
            state,
            actions,
        )

    actions = jnp.asarray(rng.integers(0, PROGRESS.action.count, (4, 20, 4)), jnp.int32)
    batched_state, batched = jax.jit(jax.vmap(one))(index, controlled, actions)
    single = jax.jit(one)
    for row in range(4):
        state, outcome = single(index[row], controlled[row], actions[row])
        for name, value in outcome._asdict().items():
            np.testing.assert_allclose(
                value, getattr(batched, name)[row], atol=1e-4, err_msg=name
            )
        np.testing.assert_allclose(state.history, batched_state.history[row], atol=1e-4)


@pytest.mark.slow
def test_random_driving_stays_finite(tmp_path: Path) -> None:
    """Whatever the policy does, what it sees and gets are numbers."""
    file = scenes.bank_of(list(generate_many(4, 3)), tmp_path)
    for space in ActionSpace:
        config = EnvironmentConfig(
            action=ActionConfig(space=space),
            observation=ObservationConfig(neighbours=4, road_rows=8),
            progress=1.0,
        )

        def one(scene, actions, bank, config=config):
            def step(state, action):
                state, outcome = environment.step(bank, state, action[None], config)
                seen = environment.observe_state(bank, state, config)
                return state, (seen, outcome.reward)

            state = environment.reset(bank, scene, bank.sdc[scene][None], config)
            return jax.lax.scan(step, state, actions)[1]

        rng = np.random.default_rng(2)
        actions = rng.integers(0, config.action.count, (15, 80)).astype(np.int32)
        index = (np.arange(15) % 3).astype(np.int32)
        drive = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))
        seen, reward = drive(index, actions, file.bank)
        assert np.isfinite(reward).all()
        for name, value in seen._asdict().items():
            assert np.isfinite(value).all(), name


def test_every_entry_point_compiles_once(file) -> None:
    bank = file.bank
    functions = {
        "reset": lambda scene: environment.reset(bank, scene, scene[None] * 0, CONFIG),
    }
    for name, function in functions.items():
        jitted, traces = scenes.counted(function)
        for scene in (0, 1, 2):
            jitted(jnp.int32(scene))
        assert len(traces) == 1, name
    stepped, traces = scenes.counted(
        lambda state, action: environment.step(bank, state, action, CONFIG)
    )
    state = start(file, ALONE)
    for action in (0, 1, 2):
        state, _ = stepped(state, jnp.array([action], jnp.int32))
    assert len(traces) == 1
