"""The Gymnasium adapters against Gymnasium's own checkers and the simulator."""

import dataclasses

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from sim.bank import BankError, BankFile
from sim.dynamics import ActionConfig, ActionSpace, action_table
from sim.environment import EnvironmentConfig, reset, step
from sim.gymnasium_env import DrivingEnv, DrivingVectorEnv
from sim.observation import ObservationConfig
from tests import scenes

CONFIG = EnvironmentConfig(
    observation=ObservationConfig(neighbours=2, road_rows=4, lights=1, route_points=2),
    terminate=True,
)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """A straight road with two cars, and one car that is about to leave it."""
    one = scenes.scene_of([scenes.driver(), scenes.driver(x=-20.0)], name="straight")
    off = scenes.scene_of([scenes.driver(yaw=0.6, speed=8.0)], name="leaving")
    return scenes.bank_of((one, off), tmp_path_factory.mktemp("gym"))


@pytest.mark.parametrize("continuous", [False, True])
def test_gymnasium_accepts_it(file, continuous):
    check_env(DrivingEnv(file, CONFIG, continuous=continuous))


def test_a_step_is_the_simulators(file):
    env = DrivingEnv(file, CONFIG)
    _, info = env.reset(seed=3, options={"scene": 0})
    assert info["scenario_id"] == "straight"
    bank = file.bank
    state = reset(bank, jnp.int32(0), bank.sdc[0][None], CONFIG)
    stepped = jax.jit(step, static_argnames="config")
    for action in (0, 40, 90, 45):
        _, reward, terminated, truncated, info = env.step(action)
        state, outcome = stepped(bank, state, jnp.array([action]), config=CONFIG)
        assert reward == float(outcome.reward[0])
        assert terminated == bool(outcome.terminated[0])
        assert truncated == bool(outcome.truncated)
        assert info["step"] == int(state.step)


def test_an_index_and_its_vector_lead_to_the_same(file):
    by_index = DrivingEnv(file, CONFIG)
    by_vector = DrivingEnv(file, CONFIG, continuous=True)
    for env in (by_index, by_vector):
        env.reset(options={"scene": 0})
    seen = by_index.step(17)[0]
    same = by_vector.step(action_table(CONFIG.action)[17])[0]
    for name, value in seen.items():
        np.testing.assert_allclose(value, same[name], atol=1e-6)


def test_actions_beyond_the_limits_are_clipped(file):
    env = DrivingEnv(file, CONFIG, continuous=True)
    env.reset(options={"scene": 0})
    far = env.step(np.array([1e6, 0.0], np.float32))[4]
    env.reset(options={"scene": 0})
    most = env.step(np.array([CONFIG.action.acceleration, 0.0], np.float32))[4]
    assert far == most


def test_the_vector_starts_anew_in_the_step_after_the_last(file):
    envs = DrivingVectorEnv(file, 4, CONFIG)
    envs.reset(seed=0, options={"scene": 1})
    coast = np.full(4, 45)  # of 7 x 13, the middle: neither accelerates nor turns
    over = np.zeros(4, bool)
    for _ in range(scenes.STEPS):
        observation, reward, terminated, truncated, info = envs.step(coast)
        assert envs.observation_space.contains(observation)
        if over.any():
            break
        over = terminated | truncated
    assert over.all() and info["offroad"].sum() == 0
    assert (reward == 0).all() and not (terminated | truncated).any()
    assert (info["step"] == scenes.CURRENT).all()


def test_leaving_the_road_terminates(file):
    envs = DrivingVectorEnv(file, 4, CONFIG)
    envs.reset(options={"scene": 1})
    for _ in range(scenes.STEPS - scenes.CURRENT):
        _, reward, terminated, truncated, info = envs.step(np.full(4, 45))
        if terminated.any():
            break
    assert terminated.all() and info["offroad"].all() and (reward == -1.0).all()
    assert not truncated.any()


def test_the_same_seed_draws_the_same_scenes(file):
    envs = DrivingVectorEnv(file, 16, CONFIG)
    first = envs.reset(seed=5)[1]["scene"]
    again = envs.reset(seed=5)[1]["scene"]
    other = envs.reset(seed=6)[1]["scene"]
    assert (first == again).all() and (first != other).any()
    assert set(first) == {0, 1}


def test_delta_has_three_components(file):
    config = dataclasses.replace(CONFIG, action=ActionConfig(space=ActionSpace.DELTA))
    space = DrivingEnv(file, config, continuous=True).action_space
    np.testing.assert_allclose(space.low, [0.0, -0.2, -0.2])
    np.testing.assert_allclose(space.high, [3.0, 0.2, 0.2])


def test_mistakes_are_named(file):
    env = DrivingEnv(file, CONFIG)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    with pytest.raises(ValueError, match=r"scene 2: the bank .* has scenes 0 to 1"):
        env.reset(options={"scene": 2})
    env.reset()
    with pytest.raises(gymnasium.error.InvalidAction, match="must be 0 to 90"):
        env.step(91)
    with pytest.raises(BankError, match=r"steps of 0.1 s, the environment of 0.2 s"):
        DrivingEnv(file, EnvironmentConfig(dt=0.2))
    with pytest.raises(ValueError, match="num_envs=0"):
        DrivingVectorEnv(file, 0)
    with pytest.raises(ValueError, match="NEXT_STEP or DISABLED"):
        DrivingVectorEnv(file, 1, autoreset_mode=AutoresetMode.SAME_STEP)


def test_torchrl_steps_and_resets_a_batch(file):
    from torchrl.envs import GymWrapper, check_env_specs

    envs = DrivingVectorEnv(file, 4, CONFIG, autoreset_mode=AutoresetMode.DISABLED)
    wrapped = GymWrapper(envs)
    check_env_specs(wrapped)
    wrapped.set_seed(0)
    rollout = wrapped.rollout(40, break_when_any_done=False)
    assert rollout.batch_size == (4, 40)
    over = rollout["next", "done"][..., 0]
    # Two scenes of at most 15 steps: every environment starts anew within 40, and
    # goes on from a start, not from where it ended.
    assert (over.sum(1) >= 2).all()
    for row, column in over.nonzero().tolist():
        if column + 1 < 40:
            ended = rollout["next", "ego"][row, column]
            assert not (rollout["ego"][row, column + 1] == ended).all()


def test_it_compiles_once(file: BankFile):
    from sim import gymnasium_env

    envs = DrivingVectorEnv(file, 4, CONFIG)
    envs.reset()
    envs.step(np.zeros(4))
    before = gymnasium_env._step._cache_size()
    for action in (3, 5):
        envs.step(np.full(4, action))
        envs.reset(options={"scene": 1})
    assert gymnasium_env._step._cache_size() == before
