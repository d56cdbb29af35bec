"""The evaluator: which checkpoint is best, how it is kept, what is compiled."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import jax
import msgspec
import numpy as np
import pytest

from actors.cloning import cloned, expert_rows, sdc_only
from actors.evaluation import Judge, evaluate
from actors.likelihood import HeldOutLikelihood
from actors.policy import find_policy, random_vector
from launch.budget import BudgetConfig, EvaluatorConfig, ReportConfig, ScenesConfig
from launch.config import (
    RunFile,
    decode_run,
    quick,
    quick_cloning,
    with_space,
)
from launch.console import held_out, line_of, snapshot
from launch.evaluator import CheckpointJudge, figures_told
from launch.evaluator_best import BestCheckpoint, Judgement
from launch.failures import failures_of, others_json
from launch.learning import make_learner
from launch.train import TrainConfig, prepare
from learner.checkpoint import save_checkpoint
from learner.curves import read_curves
from tests import scenes
from tests.test_results import SCENE

FIRST = Judgement(updates=100, scenes=8, failure_rate=0.5, log_displacement=3.0)


@pytest.mark.parametrize(
    ("changes", "better"),
    [
        ({"failure_rate": 0.4, "log_displacement": 9.0}, True),
        ({"failure_rate": 0.6, "log_displacement": 1.0}, False),
        ({"log_displacement": 2.9, "log_likelihood": -9.0}, True),
        ({"log_likelihood": 1.0}, True),
        ({"log_likelihood": -1.0}, False),
        ({}, False),  # of two equals the older one stays
    ],
)
def test_failures_count_first_then_displacement_then_likelihood(changes, better):
    assert dataclasses.replace(FIRST, **changes).better_than(FIRST) is better
    assert FIRST.better_than(None)


def checkpoint(run: Path, updates: int) -> Path:
    """Files as a learner leaves them."""
    folder = run / "checkpoints" / f"{updates:09d}"
    folder.mkdir(parents=True)
    for name in ("policy.npz", "learner.pt", "meta.json"):
        (folder / name).write_text(f"{name} of {updates}")
    return folder


def test_the_best_is_kept_when_the_learner_removes_it(tmp_path: Path) -> None:
    best = BestCheckpoint(tmp_path)
    assert best.judgement is None
    source = checkpoint(tmp_path, 100)
    aside = best.take_aside(source)
    assert aside is not None
    assert best.offer(aside, FIRST)
    kept = find_policy(tmp_path)
    assert kept == tmp_path / "best" / "000000100" / "policy.npz"
    # Linked and not copied: it takes no room while the learner has it too.
    assert os.stat(kept).st_ino == os.stat(source / "policy.npz").st_ino
    shutil.rmtree(source)
    assert kept.read_text() == "policy.npz of 100"
    # A worse one leaves no trace, a better one takes its place, also after a restart.
    for updates, rate, expected in ((200, 0.6, 100), (300, 0.1, 300)):
        best = BestCheckpoint(tmp_path)
        aside = best.take_aside(checkpoint(tmp_path, updates))
        assert aside is not None
        judged = dataclasses.replace(FIRST, updates=updates, failure_rate=rate)
        assert best.offer(aside, judged) == (expected == updates)
        assert find_policy(tmp_path).read_text() == f"policy.npz of {expected}"
    names = sorted(path.name for path in (tmp_path / "best").iterdir())
    assert names == ["000000300", "latest"]
    found = json.loads((tmp_path / "best" / "000000300" / "judged.json").read_text())
    assert found["failure_rate"] == 0.1


def test_a_checkpoint_that_is_being_removed_is_passed_over(tmp_path: Path) -> None:
    best = BestCheckpoint(tmp_path)
    assert best.take_aside(tmp_path / "checkpoints" / "000000100") is None


def test_a_kill_before_latest_is_written_leaves_the_older_best(tmp_path: Path) -> None:
    best = BestCheckpoint(tmp_path)
    aside = best.take_aside(checkpoint(tmp_path, 100))
    assert aside is not None and best.offer(aside, FIRST)
    aside = best.take_aside(checkpoint(tmp_path, 200))
    assert aside is not None
    os.rename(aside, tmp_path / "best" / "000000200")  # and killed here
    again = BestCheckpoint(tmp_path)
    assert again.judgement == FIRST
    assert find_policy(tmp_path).read_text() == "policy.npz of 100"
    aside = again.take_aside(checkpoint(tmp_path, 300))
    assert aside is not None
    better = dataclasses.replace(FIRST, updates=300, failure_rate=0.0)
    assert again.offer(aside, better)
    assert not (tmp_path / "best" / "000000200").exists()


def test_the_console_shows_the_last_and_the_best() -> None:
    last = dataclasses.replace(FIRST, updates=2000, failure_rate=0.75)
    told = figures_told(last, FIRST)
    figures = snapshot(quick(), {"evaluator": (0.0, told)}, {}, 1000.0)
    assert held_out(figures) == (
        "failures 75.0% log ADE 3.00 m at 2,000 (best 50.0% at 100)"
    )
    assert held_out(figures) in line_of(figures)
    assert held_out(snapshot(quick(), {}, {}, 0.0)) == "-"
    likely = dataclasses.replace(FIRST, log_likelihood=1.5)
    assert "log p 1.500" in held_out(figures_told(likely, None))


@pytest.mark.parametrize("name", ["scenes", "seconds", "updates"])
def test_negative_settings_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}=-1 must not be negative"):
        EvaluatorConfig(**{name: -1})


def evaluation(*failed: bool):
    """As many scenes; a failed one has overlaps at two steps."""
    from actors.evaluation import Evaluation

    every = [
        dataclasses.replace(
            SCENE,
            id=f"scene-{index}",
            failed=fails,
            overlap=2 * fails,
            overlap_objects=int(fails),
            failure_objects=int(fails),
        )
        for index, fails in enumerate(failed)
    ]
    return Evaluation(agent="trained", scenes=every, trace=None)


def test_failed_scenes_are_listed() -> None:
    text = failures_of([evaluation(True, False, True)])
    assert "## Failures of trained: 2 scenes" in text
    assert "- scene-2: overlap at 2 steps" in text and "scene-1" not in text


def test_scenes_that_the_best_was_not_chosen_by_are_apart() -> None:
    found = others_json(evaluation(False, False, True, False), 2)
    assert found["chosen_by_scenes"] == 2
    assert found["on_others"]["scenes"] == 2
    assert found["on_others"]["failure_rate"] == 0.5
    assert others_json(evaluation(False), 64) == {
        "chosen_by_scenes": 1,
        "on_others": None,
    }


TINY = dict(width=16, latents=2, mlp_width=16, mlp_layers=1)


@pytest.mark.slow
def test_all_parameters_share_one_program(tmp_path: Path) -> None:
    """And drive as the same agent does with its parameters compiled in."""
    file = scenes.bank_of(
        [scenes.scene_of([scenes.driver(yaw=0.1 * i)], name=f"{i}") for i in range(3)],
        tmp_path,
    )
    network = dataclasses.replace(quick().network, **TINY)
    config = quick().environment

    def family(vector):
        return cloned(vector, network, config, components=0)

    judge = Judge(file, family, config=config)
    keys = jax.random.split(jax.random.key(0), 3)
    vectors = [random_vector(key, network, config) for key in keys]
    found = [judge.evaluate(v, name="a", key=keys[0]) for v in vectors]
    assert judge.compilations == 1
    assert len({result.scenes[0].log_displacement for result in found}) == 3
    alone = evaluate(file, family(vectors[1]), name="a", key=keys[0], config=config)
    for one, other in zip(found[1].scenes, alone.scenes, strict=True):
        assert one.log_displacement == pytest.approx(other.log_displacement, rel=1e-4)
    # A part of the scenes is another shape, and the first ones.
    part = judge.evaluate(vectors[1], name="a", key=keys[0], most=2)
    assert [scene.id for scene in part.scenes] == ["0", "1"]
    assert judge.compilations == 2


@pytest.mark.slow
@pytest.mark.parametrize("space", ["delta", "bicycle-discrete"])
def test_the_likelihood_is_the_learners(tmp_path: Path, space: str) -> None:
    """The twin in JAX against the network in torch."""
    from launch.cloning import make_cloner, make_render_before
    from learner.cloning import cloning_batch

    file = scenes.bank_of(
        [scenes.scene_of([scenes.driver(speed=5.0 + i)]) for i in range(2)], tmp_path
    )
    config = with_space(quick_cloning(), space)
    config = dataclasses.replace(
        config, network=dataclasses.replace(config.network, **TINY)
    )
    learner = make_cloner(config)
    rows = expert_rows(file.bank, sdc_only(file.bank), config.environment)
    look = make_render_before(file, config)
    expected = learner.log_likelihood(cloning_batch(rows, look(rows))).mean()
    found = HeldOutLikelihood(
        file,
        config=config.environment,
        network=config.network,
        components=learner.mixture,
        seed=0,
    )
    assert found.mean(learner.policy_vector()) == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
def test_checkpoints_are_judged_once_and_after_a_restart(tmp_path: Path) -> None:
    config = dataclasses.replace(
        quick(),
        network=dataclasses.replace(quick().network, **TINY),
        scenes=ScenesConfig(train=1, held_out=3),
        budget=BudgetConfig(updates=5),
        report=ReportConfig(tensorboard=False),
        evaluator=EvaluatorConfig(scenes=2),
    )
    folder, run = prepare(TrainConfig(run=tmp_path / "run", config=config))
    judge = CheckpointJudge(folder, run)
    assert judge.look() is None  # there is no checkpoint
    learner = make_learner(config)
    for updates in (10, 20):
        learner.updates = updates
        save_checkpoint(
            folder / "checkpoints", learner=learner, extra={"config": {}}, keep=1
        )
        judged = judge.look()
        assert judged is not None
        assert (judged.updates, judged.scenes) == (updates, 2)
        assert judge.look() is None
    assert judge.judge.compilations == 1
    judge.close()
    again = CheckpointJudge(folder, run)
    assert again.look() is None
    assert again.best.judgement is not None
    assert again.best.judgement.updates == 10  # the same weights: the older one stays
    learner.updates = 25
    save_checkpoint(folder / "checkpoints", learner=learner, extra={}, keep=1)
    assert again.look(least_updates=10) is None
    assert again.look(least_updates=5) is not None
    again.close()
    curve = read_curves(folder / "evaluation.csv")
    assert curve["updates"].tolist() == [10, 20, 25]
    assert curve["is_best"].tolist() == [1, 0, 0]
    assert np.isnan(curve["log_likelihood"]).all()


def test_an_older_run_is_a_dqn_run() -> None:
    """Fields that its file lacks have their defaults."""
    run = RunFile(
        run_id="a", config=quick(), train_hash="", held_out_hash="", scenes=()
    )
    content = json.loads(msgspec.json.encode(run))
    del content["algorithm"], content["objects"], content["config"]["evaluator"]
    read = decode_run(json.dumps(content).encode(), where="x")
    assert read == run
    assert (read.algorithm, read.mixture) == ("dqn", 0)
