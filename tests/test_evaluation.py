"""Evaluation: the counts of recorded scenes, and what counts in them."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from actors.controlled import all_of
from actors.evaluation import Evaluation, evaluate
from sim import agents
from sim.bank import BankFile
from sim.environment import EnvironmentConfig
from sim.scene import Scene
from tests import oracle, scenes

CONFIG = EnvironmentConfig()
KEY = 0


def playback(file: BankFile) -> Evaluation:
    """The log itself, all objects, from the first step."""
    return evaluate(
        file,
        agents.log_playback(),
        name="log",
        key=jax.random.key(KEY),
        config=CONFIG,
        controlled=all_of(file),
        from_first_step=True,
        keep_trace=True,
    )


@pytest.mark.parametrize(
    ("scenario", "objects", "valid", "counts", "kinematic"),
    [
        ("ef3a8f65142f41ac", 62, 3751, (2533, 75), {79}),
        # One step's acceleration is 10.4 to within rounding.
        ("db4edc9bd0c9d18c", 81, 4802, (2552, 98), {265, 266}),
    ],
)
def test_counts_of_the_real_scenes(
    real_playback, scenario, objects, valid, counts, kinematic
) -> None:
    (result,) = [scene for scene in real_playback.scenes if scene.id == scenario]
    assert (result.objects, result.valid) == (objects, valid)
    assert (result.offroad, result.overlap) == counts
    assert result.kinematic_infeasibility in kinematic
    assert result.log_displacement == 0.0
    assert result.failed


@pytest.fixture(scope="module")
def real_playback(real: tuple[tuple[Scene, ...], BankFile]) -> Evaluation:
    return playback(real[1])


def test_every_real_scene_is_judged(real, real_playback: Evaluation) -> None:
    recorded, _ = real
    assert [result.id for result in real_playback.scenes] == [
        scene.scenario_id for scene in recorded
    ]
    for result, scene in zip(real_playback.scenes, recorded, strict=True):
        assert result.objects == int(scene.valid.any(1).sum())
        assert result.valid == int(scene.valid.sum())
        assert result.overlap == int(oracle.overlap(scene).sum())
        assert abs(result.kinematic_infeasibility - oracle.kinematic(scene).sum()) <= 1


def mixed() -> list[Scene]:
    """Nine scenes, one more than a chunk holds, of different lengths and sizes."""
    rng = np.random.default_rng(0)
    result = []
    for number in range(9):
        steps = 8 + 3 * number
        drivers = [
            scenes.driver(
                x=float(rng.uniform(0, 40)),
                y=float(rng.uniform(-7, 7)),
                yaw=float(rng.uniform(-0.3, 0.3)),
                speed=float(rng.uniform(0, 20)),
                steps=steps,
            )
            for _ in range(2 + number % 4)
        ]
        valid = rng.uniform(size=(len(drivers), steps)) < 0.9
        valid[0] = True
        result.append(scenes.scene_of(drivers, valid=valid, name=f"mixed{number}"))
    return result


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    return scenes.bank_of(mixed(), tmp_path_factory.mktemp("mixed"))


def test_scenes_of_different_lengths_in_one_bank(several: BankFile) -> None:
    """Also the last chunk, which holds one scene."""
    found = playback(several)
    assert len(found.scenes) == 9
    for result, scene in zip(found.scenes, mixed(), strict=True):
        assert result.id == scene.scenario_id
        assert result.objects == int(scene.valid.any(1).sum())
        assert result.valid == int(scene.valid.sum())
        assert result.overlap == int(oracle.overlap(scene).sum())
        assert result.offroad == int(oracle.offroad(scene).sum())
        assert result.kinematic_infeasibility == int(oracle.kinematic(scene).sum())
        assert result.log_displacement == 0.0
        assert result.failed == bool(result.overlap or result.offroad)
    totals = [sum(getattr(r, n) for r in found.scenes) for n in ("overlap", "offroad")]
    assert min(totals) > 10
    # The trace: what happened, step by step.
    trace = found.trace
    assert trace is not None
    steps = max(scene.steps for scene in mixed())
    assert trace.counts.shape == (9, steps, 5)
    for index, scene in enumerate(mixed()):
        counts = trace.counts[index, : scene.steps, : scene.objects].T
        np.testing.assert_array_equal(counts, scene.valid)
        assert not trace.counts[index, scene.steps :].any()
        np.testing.assert_array_equal(
            trace.overlap[index, : scene.steps, : scene.objects].T,
            oracle.overlap(scene),
        )
        states = trace.states[index, : scene.steps, : scene.objects, :2]
        origin = np.array(several.origins[index][:2])
        np.testing.assert_allclose(
            (states + origin).transpose(1, 0, 2)[scene.valid],
            scene.position[scene.valid][:, :2],
            atol=1e-4,
        )
        assert (trace.step[index, : scene.steps] == np.arange(scene.steps)).all()


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """A clear road; a parked car in the way; a car that leaves the road."""
    parked = scenes.driver(x=14.0, speed=0.0)
    every = [
        scenes.scene_of([scenes.driver()], name="clear"),
        scenes.scene_of([scenes.driver(), parked], name="parked"),
        scenes.scene_of([scenes.driver(yaw=0.5)], name="leaving"),
    ]
    return scenes.bank_of(every, tmp_path_factory.mktemp("three"))


def test_agents_are_judged_from_their_first_decision(three: BankFile) -> None:
    """By hand: 15 steps from the current one, at 10 m/s and straight on."""
    found = evaluate(
        three,
        agents.constant_speed(CONFIG),
        name="constant speed",
        key=jax.random.key(KEY),
        config=CONFIG,
    )
    clear, parked, leaving = found.scenes
    assert (clear.objects, clear.valid) == (1, scenes.STEPS - 1 - scenes.CURRENT)
    assert not clear.failed
    assert clear.progress == pytest.approx(1.0, abs=1e-3)
    assert clear.log_displacement == pytest.approx(0.0, abs=1e-3)
    # Both are 4 m long: they touch from 10 m to 18 m, give or take a rounding.
    assert parked.overlap in (7, 8, 9)
    assert parked.offroad == 0
    assert parked.failed
    assert leaving.overlap == 0
    assert leaving.offroad > 0
    assert found.failure_rate == pytest.approx(2 / 3)
    assert found.rate("overlap") == found.rate("offroad") == pytest.approx(1 / 3)
    assert found.infeasible == 0.0
    assert found.progress == pytest.approx(1.0, abs=1e-2)
    assert found.trace is None


def test_a_scene_whose_log_stands_has_no_progress(tmp_path: Path) -> None:
    file = scenes.bank_of([scenes.scene_of([scenes.driver(speed=0.0)])], tmp_path)
    found = evaluate(
        file,
        agents.log_playback(),
        name="log",
        key=jax.random.key(KEY),
        config=CONFIG,
    )
    assert found.scenes[0].progress is None
    assert np.isnan(found.progress)
    assert dataclasses.asdict(found.scenes[0])["id"] == "hand"


@pytest.mark.slow
def test_an_evaluation_is_determined_by_its_key(three: BankFile) -> None:
    one, same = (
        evaluate(
            three,
            agents.random_actions(CONFIG),
            name="random",
            key=jax.random.key(1),
            config=CONFIG,
            keep_trace=True,
        )
        for _ in range(2)
    )
    assert one.scenes == same.scenes
    assert one.trace is not None
    assert same.trace is not None
    for name, value in one.trace._asdict().items():
        np.testing.assert_array_equal(value, getattr(same.trace, name))
    first, second = one.trace.action[0], one.trace.action[1]
    assert (first != second).mean() > 0.8  # every scene draws for itself
