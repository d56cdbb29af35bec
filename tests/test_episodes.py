"""Which objects a fresh episode controls, and whole steps with auto-reset."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import environment, episodes
from sim.bank import BankFile
from sim.environment import EnvironmentConfig, State
from sim.episodes import NearestToSdc, sdc_only
from sim.observation import ObservationConfig, observe_batch
from sim.procedural import generate_many
from sim.scene import ObjectType
from tests import scenes

CONFIG = EnvironmentConfig(
    observation=ObservationConfig(road_rows=8, neighbours=4), terminate=True
)
STEPS, NOW = scenes.STEPS, scenes.CURRENT

_observe_batch = jax.jit(observe_batch, static_argnums=2)
_reset = jax.jit(environment.reset, static_argnums=3)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    short = scenes.scene_of([scenes.driver()])  # 20 steps, one object
    every = [*generate_many(41, 1), short, short, short]
    return scenes.bank_of(every, tmp_path_factory.mktemp("episodes"))


@pytest.fixture(scope="module")
def queue(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """Four others at 30, 10, 20 and 5 m: the third stands, the last comes later.

    The nearest that is there is a cyclist.
    """
    others = [(30, 10.0), (10, 10.0), (20, 0.0), (5, 10.0)]
    drivers = [scenes.driver()]
    drivers += [scenes.driver(y=float(y), speed=speed) for y, speed in others]
    valid = np.ones((5, STEPS), bool)
    valid[4, : NOW + 1] = False
    scene = scenes.scene_of(drivers, valid=valid)
    kinds = scene.object_types.copy()
    kinds[2] = ObjectType.CYCLIST
    scene = dataclasses.replace(scene, object_types=kinds)
    return scenes.bank_of([scene], tmp_path_factory.mktemp("queue"))


def test_the_nearest_are_those_recorded_at_the_start(queue: BankFile) -> None:
    chosen = {
        NearestToSdc(3): [0, 2, 3],
        NearestToSdc(7): [0, 2, 3, 1, 5, 5, 5],
        NearestToSdc(3, moving=True): [0, 2, 1],
        NearestToSdc(3, vehicles=True): [0, 3, 1],
        NearestToSdc(3, moving=True, vehicles=True): [0, 1, 5],
        sdc_only: [0],
    }
    for choose, rows in chosen.items():
        assert choose(queue.bank, jnp.int32(0)).tolist() == rows


def test_starts_are_the_scenes_resets(made: BankFile) -> None:
    begin = jax.device_get(episodes.starts(made.bank, NearestToSdc(4), CONFIG))
    for scene in range(made.scenes):
        one = _reset(made.bank, jnp.int32(scene), begin.controlled[scene], CONFIG)
        for name, value in one._asdict().items():
            np.testing.assert_allclose(getattr(begin, name)[scene], value, atol=1e-5)
    # The last scene has one object.
    none = made.arrays["log"].shape[2]
    assert begin.controlled[-1].tolist() == [0, none, none, none]


def test_restarts_draw_every_scene(made: BankFile) -> None:
    begin = episodes.starts(made.bank, sdc_only, CONFIG)
    state = episodes.draw(jax.random.key(1), begin, 100)
    assert set(np.asarray(state.scene).tolist()) == set(range(made.scenes))


def idle_rollout(
    file: BankFile, choose: episodes.Choice, environments: int, steps: int
) -> list[tuple[State, tuple]]:
    """States before idle steps, and what the steps led to."""
    begin = episodes.starts(file.bank, choose, CONFIG)
    state = episodes.draw(jax.random.key(0), begin, environments)
    idle = CONFIG.action.count // 2
    action = jnp.full(state.controlled.shape, idle, jnp.int32)
    results = []
    for number in range(steps):
        key = jax.random.key(number)
        after = episodes.step(key, file.bank, begin, state, action, CONFIG)
        results.append((jax.device_get(state), jax.device_get(after)))
        state = after[0]
    return results


@pytest.mark.parametrize("slots", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_a_whole_step_is_its_parts(made: BankFile, slots: int) -> None:
    """Step, then restart what is over and nothing else, then observe."""
    begin = jax.device_get(episodes.starts(made.bank, NearestToSdc(slots), CONFIG))
    ends = 0
    stepped = jax.jit(jax.vmap(environment.step, (None, 0, 0, None)), static_argnums=3)
    for before, (after, outcome, seen) in idle_rollout(
        made, NearestToSdc(slots), 5, 18
    ):
        action = np.full(before.controlled.shape, CONFIG.action.count // 2, np.int32)
        moved, expected = jax.device_get(stepped(made.bank, before, action, CONFIG))
        for name, value in expected._asdict().items():
            np.testing.assert_allclose(getattr(outcome, name), value, atol=1e-4)
        for row in range(5):
            failed = outcome.terminated[row] | ~outcome.valid[row]
            over = bool(outcome.truncated[row] or failed.all())
            ends += over
            here = jax.tree.map(lambda value, row=row: value[row], after)
            there = jax.tree.map(lambda value, row=row: value[row], moved)
            if over:
                there = jax.tree.map(lambda value, at=here.scene: value[at], begin)
            for one, other in zip(here, there, strict=True):
                np.testing.assert_allclose(one, other, atol=1e-4)
        look = jax.device_get(_observe_batch(made.bank, after.view, CONFIG.observation))
        for one, other in zip(seen, look, strict=True):
            assert one.tobytes() == other.tobytes()
    assert ends > 2


def test_a_scene_whose_objects_fail_one_by_one_goes_on(made: BankFile) -> None:
    """It is over when all that count fail at once, or at the recording's end."""
    for _, (after, outcome, _) in idle_rollout(made, NearestToSdc(4), 5, 12):
        alive = (outcome.valid & ~outcome.terminated).any(1) & ~outcome.truncated
        assert (after.step[alive] > NOW).all()


def test_a_step_compiles_once(made: BankFile) -> None:
    begin = episodes.starts(made.bank, sdc_only, CONFIG)
    state = episodes.draw(jax.random.key(0), begin, 3)
    step, traces = scenes.counted(
        lambda *args: episodes.step(*args, EnvironmentConfig())
    )
    for number in range(3):
        action = jnp.full((3, 1), number, jnp.int32)
        state, _, _ = step(jax.random.key(number), made.bank, begin, state, action)
    assert len(traces) == 1


def test_an_environment_of_64_controlled_objects_is_small(made: BankFile) -> None:
    """At most 16 KB between two steps, the bank and the shared starts aside."""
    config = EnvironmentConfig()
    state = jax.eval_shape(
        lambda bank: episodes.starts(bank, NearestToSdc(64), config), made.bank
    )
    sizes = [value.size * value.dtype.itemsize for value in jax.tree.leaves(state)]
    assert sum(sizes) / made.scenes <= 16 * 1024
