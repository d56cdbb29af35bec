"""A sweep that holds out each recorded scene in turn."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from actors.results import RATES, SceneResult
from launch import sweep
from launch.main import main
from launch.sweep_ledger import Point
from launch.sweep_results import Finished, results_of
from launch.sweep_scenes import banks_of
from sim.bank import open_bank
from tests.test_sweep import FAKE, ran

POINT = Point(algorithm="bc", space="delta", learning_rate=0.1)


def scene(name: str, failed: bool) -> SceneResult:
    counts = dict.fromkeys(
        ("overlap", "offroad", "kinematic_infeasibility", "wrong_way", "off_route"), 0
    )
    objects = {f"{rate}_objects": 0 for rate in RATES} | {"failure_objects": failed}
    others = {"progress": 1.0, "progression": 1.0, "log_displacement": 2.0}
    return SceneResult(
        id=name, objects=1, valid=10, failed=failed, **counts, **objects, **others
    )


def test_turns_are_one_result_of_all_scenes() -> None:
    """Three scenes of which one fails; a point that lacks a turn has no result."""
    turns = [replace(POINT, held_out=turn) for turn in range(3)]
    finished = [
        Finished(
            point=turn,
            trained={"failure_rate": float("nan")},
            others=None,
            scenes=[scene(turn.name, failed=turn.held_out == 1)],
            updates=1,
            minutes=1.0,
        )
        for turn in turns
    ]
    results = results_of(turns, finished)
    assert list(results) == [POINT]
    found = results[POINT]
    assert found["scenes"] == 3 and found["failure_rate"] == pytest.approx(1 / 3)
    assert found["intervals_95"]["failure_rate"] == pytest.approx(
        [0.0615, 0.7923], abs=1e-3
    )
    assert results_of([*turns, replace(turns[0], held_out=3)], finished) == {}


def test_rotation_takes_recorded_scenes_only(tmp_path, capsys) -> None:
    assert main(["sweep", "dqn", "--run", str(tmp_path / "s"), "--rotate"]) == 2
    error = capsys.readouterr().err
    assert "--rotate: procedural is not taken" in error and error.count("\n") == 1


@pytest.mark.slow
def test_every_scene_is_held_out_in_turn(
    tmp_path: Path, scenes_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three recorded scenes; the trainings are stood in for. Then the same again."""
    folder, fake = tmp_path / "sweep", tmp_path / "fake.py"
    fake.write_text(FAKE)
    monkeypatch.setattr(sweep, "LAUNCH", (sys.executable, str(fake)))
    words = [
        *("sweep", "dqn", "--run", str(folder), "--rotate"),
        *("--spaces", "delta-discrete", "--scenes", str(scenes_data / "gpudrive")),
        *("--", "--budget.minutes", "1"),
    ]
    assert main(words) == 0
    known = sorted(path.stem for path in (scenes_data / "gpudrive").glob("*.json"))
    held_out = []
    for turn in range(3):
        banks = banks_of(folder, turn)
        others, alone = (open_bank(bank).scenario_ids for bank in banks)
        assert sorted([*others, *alone]) == known and len(alone) == 1
        held_out += alone
        name, _, given = ran(folder)[turn]
        assert name == f"dqn-delta-discrete-without-{turn}"
        assert [str(bank) for bank in banks] == given[given.index("--scenes") + 1 :][:2]
        # No checkpoint is chosen by the scene that is held out.
        assert given[given.index("--evaluator.scenes") + 1] == "0"
    assert sorted(held_out) == known
    table = json.loads((folder / "table.json").read_text())
    agent = table["table"][-1]
    assert (agent["agent"], agent["scenes"], agent["failure_rate"]) == ("DQN", 3, 1.0)
    assert len(table["runs"]) == 3 and not table["failed"]
    assert "scenes, each held out in turn" in (folder / "table.md").read_text()
    assert main(words) == 0  # nothing is left to run
    assert len(ran(folder)) == 3
