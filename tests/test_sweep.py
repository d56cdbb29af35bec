"""The sweep: its grid, its ledger, a kill in the middle; trainings are stood in for."""

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest

from launch.main import main
from launch.sweep import SweepConfig, command_of, points_of
from launch.sweep_ledger import Ledger, Point, lock
from launch.sweep_results import read_evaluation
from launch.sweep_table import best_of, read_curve, rows_of

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 60.0

# A training of a tenth of a second: it writes down that it ran, what it was given and
# whether it went on; a file `hang` makes it wait to be killed, `fail` makes it fail.
FAKE = """
import json, os, sys, time
from pathlib import Path
words = sys.argv[1:]
def value(name):
    return words[words.index(name) + 1]
def agent(name, failures):
    figures = ("failure_rate overlap_rate offroad_rate kinematic_infeasibility "
               "wrong_way_rate off_route_rate log_displacement progression").split()
    return {"agent": name, "scenes": 8, **{f: failures for f in figures},
            "intervals_95": {"failure_rate": [0.0, 1.0]}}
if words[0] == "evaluate":
    agents = [agent(name, 0.75) for name in words[words.index("--agent") + 1:]]
    Path(value("--json")).write_text(json.dumps({"agents": agents}))
    sys.exit()
run = Path(value("--run"))
root = run.parent.parent
with (root / "ran").open("a") as ran:
    ran.write(json.dumps([run.name, "--resume" in words, words]) + "\\n")
run.mkdir(parents=True, exist_ok=True)
(run / "config.json").write_text("{}")
if (root / "mistake").exists():
    print("no such thing")
    sys.exit(2)
if (root / "fail").exists() and (root / "fail").read_text() == run.name:
    print("out of luck")
    sys.exit(1)
if (root / "hang").exists() and (root / "hang").read_text() == run.name:
    (root / "hanging").write_text(str(os.getpid()))
    time.sleep(600)
failures = 0.5 if "delta" in run.name else 0.25
(run / "evaluation.csv").write_text("updates,failure_rate,log_likelihood\\n10,0.5,\\n")
(run / "curves.csv").write_text("updates,loss,seconds\\n10,1.0,90.0\\n")
counts = ("objects valid overlap offroad kinematic_infeasibility wrong_way off_route "
          "failure_objects overlap_objects offroad_objects wrong_way_objects "
          "off_route_objects").split()
scene = {"id": run.name, **dict.fromkeys(counts, 1), "failed": True, "progress": 1.0,
         "log_displacement": 1.0, "progression": 1.0}
scores = json.dumps({"agents": [agent("trained", failures)],
                     "scenes": {"trained": [scene]},
                     "on_others": agent("trained", 0.125)})
(run / "evaluation.json").write_text(scores)
"""
DRIVER = """
import sys
from pathlib import Path
from launch.sweep import SweepConfig, points_of, run_sweep
from launch.sweep_ledger import lock
folder, fake, jobs = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
options = SweepConfig(run=folder, learning_rates=(1e-4, 3e-4), jobs=jobs)
with lock(folder):
    sys.exit(run_sweep(folder=folder, points=points_of("all", options), options=options,
                       passed_on=("--budget.minutes", "1"),
                       launch=(sys.executable, fake), command="slipstream sweep"))
"""


def started(folder: Path, jobs: int = 1) -> subprocess.Popen[str]:
    """A sweep of ten points in a process of its own."""
    folder.mkdir(exist_ok=True)
    fake = folder / "fake.py"
    fake.write_text(textwrap.dedent(FAKE))
    return subprocess.Popen(
        [sys.executable, "-c", DRIVER, folder, fake, str(jobs)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ran(folder: Path) -> list[tuple[str, bool, list[str]]]:
    """What the trainings wrote down, in their order."""
    path = folder / "ran"
    lines = path.read_text().splitlines() if path.exists() else []
    return [tuple(json.loads(line)) for line in lines]


def wait_for_file(path: Path, process: subprocess.Popen[str]) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while not (path.exists() and path.read_text()):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return path.read_text()


def gone(pid: int) -> bool:
    """Whether a process has ended, within a few seconds."""
    try:
        psutil.Process(pid).wait(10)
    except psutil.NoSuchProcess:
        return True
    except psutil.TimeoutExpired:
        return False
    return True


def test_the_grid_is_the_papers() -> None:
    points = points_of("bc", SweepConfig(run=Path("x")))
    assert len(points) == 12
    assert {point.learning_rate for point in points} == {3e-5, 1e-4, 3e-4}
    assert {p.space for p in points_of("dqn", SweepConfig(run=Path("x")))} == {
        *("bicycle-discrete", "delta-discrete")
    }
    every = points_of("all", SweepConfig(run=Path("x")))
    assert len({point.name for point in every}) == 14


@pytest.mark.slow
def test_a_killed_sweep_goes_on_where_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    folder.mkdir()
    (folder / "hang").write_text("bc-delta-0.0001")
    process = started(folder)
    pid = int(wait_for_file(folder / "hanging", process))
    process.kill()
    process.wait()
    assert gone(pid)  # a run does not outlive its sweep
    before = ran(folder)
    assert [name for name, _, _ in before][-1] == "bc-delta-0.0001"
    (folder / "hang").unlink()
    process = started(folder)
    told, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, told
    after = ran(folder)[len(before) :]
    # Those that had finished are not run again; the killed one goes on.
    names = [name for name, _, _ in before[:-1]] + [name for name, _, _ in after]
    assert len(names) == len(set(names)) == 10
    resumed = [name for name, went_on, _ in after if went_on]
    assert resumed == ["bc-delta-0.0001"]
    table = json.loads((folder / "table.json").read_text())
    assert len(table["runs"]) == 10 and not table["failed"]
    agents = [(row["agent"], row["space"]) for row in table["table"]]
    assert agents[:4] == [
        ("Expert", s) for s in dict.fromkeys(s for _, s in agents[7:11])
    ]
    assert [agent for agent, _ in agents[4:]] == [
        *("IDM", "Constant speed", "Random", "BC", "BC", "BC", "BC", "DQN", "DQN")
    ]
    told_in_file = (folder / "table.md").read_text()
    assert "| BC | Delta | 0.0001 |" in told_in_file
    assert "| bc-delta-0.0001 | 10 | 1.5 | 50.0% [0.0, 100.0] |" in told_in_file
    assert "| 8 | 12.5% [0.0, 100.0] |" in told_in_file  # that did not choose
    assert "Bicycle-Discrete" in told
    assert (folder / "curves.png").stat().st_size > 10_000


@pytest.mark.slow
def test_runs_fail_and_the_rest_goes_on(tmp_path: Path) -> None:
    """Two at a time; one fails for good. The next sweep tries it again."""
    folder = tmp_path / "sweep"
    folder.mkdir()
    (folder / "fail").write_text("dqn-delta-discrete")
    process = started(folder, jobs=2)
    told, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, told
    assert "exit code 1: out of luck" in told and "left out" in told
    names = [name for name, _, _ in ran(folder)]
    assert names.count("dqn-delta-discrete") == 2 and len(set(names)) == 10
    assert json.loads((folder / "table.json").read_text())["failed"] == [
        "dqn-delta-discrete"
    ]
    words = ran(folder)[0][2]
    assert words[-2:] == ["--budget.minutes", "1"]
    # Two threads by the preset; two learners on two cores have one each.
    threads = words[words.index("--cloning.torch-threads") + 1]
    assert threads == ("1" if len(os.sched_getaffinity(0)) < 4 else "2")
    (folder / "fail").unlink()
    process = started(folder)
    process.communicate(timeout=PATIENCE_S)
    assert [name for name, _, _ in ran(folder)[len(names) :]] == ["dqn-delta-discrete"]
    assert json.loads((folder / "table.json").read_text())["failed"] == []


@pytest.mark.slow
def test_a_person_ends_it(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    folder.mkdir()
    (folder / "hang").write_text("bc-bicycle-0.0001")
    process = started(folder)
    pid = int(wait_for_file(folder / "hanging", process))
    process.send_signal(signal.SIGINT)
    told, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130 and "the same command goes on" in told
    assert "Traceback" not in told
    assert gone(pid)


@pytest.mark.slow
def test_a_mistake_that_all_runs_share_ends_it(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    folder.mkdir()
    (folder / "mistake").touch()
    process = started(folder)
    told, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode != 0
    assert "bc-bicycle-0.0001: no such thing (log: " in told
    assert len(ran(folder)) == 1


POINTS = [
    Point(algorithm="bc", space="delta", learning_rate=rate) for rate in (0.1, 0.2)
]


def test_what_was_running_is_queued_again(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path, POINTS)
    assert ledger.take() == 0
    ledger.finish(0, 0.25)
    assert ledger.take() == 1 and ledger.take() is None  # and it is killed here
    again = Ledger(tmp_path, POINTS)
    assert again.complete == {0: 0.25}
    assert again.take() == 1 and again.take() is None
    again.fail(1, "out of luck", again=False)
    assert again.take() is None
    third = Ledger(tmp_path, POINTS)
    assert third.take() == 1
    third.finish(1, 0.5)
    assert Ledger(tmp_path, POINTS).take() is None


def test_one_sweep_at_a_time(tmp_path: Path) -> None:
    with lock(tmp_path):
        with pytest.raises(Exception, match="another sweep is at work"):
            with lock(tmp_path):
                pass
    with lock(tmp_path):
        pass


def test_the_best_is_by_failures_and_then_displacement() -> None:
    def summary(failures: float, displacement: float) -> dict[str, object]:
        return {"failure_rate": failures, "log_displacement": displacement}

    results = {POINTS[0]: summary(0.5, 1.0), POINTS[1]: summary(0.5, 0.9)}
    assert best_of(results) == [POINTS[1]]
    assert best_of({**results, POINTS[0]: summary(0.4, 9.0)}) == [POINTS[0]]
    assert rows_of({}, []) == []


def test_the_command_is_told_as_it_was_typed() -> None:
    options = SweepConfig(run=Path("a b"), scenes=("x", "y"), rotate=True, jobs=2)
    assert command_of("dqn", options, ["--actors", "1"]) == (
        "slipstream sweep dqn --run 'a b' --scenes x y --rotate --jobs 2 -- --actors 1"
    )


def test_a_damaged_evaluation_is_said_so(tmp_path: Path) -> None:
    assert read_evaluation(tmp_path) is None
    assert read_curve(tmp_path / "evaluation.csv") == {}
    (tmp_path / "evaluation.json").write_text("{")
    with pytest.raises(Exception, match="not a run's evaluation"):
        read_evaluation(tmp_path)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--preset", "slow"], "train bc has quick, laptop, paper"),
        (["--spaces", "steering"], "not in the grid"),
        (["--learning-rates", "0"], "above 0"),
        (["--learning-rates", "1e-4", "1e-4"], "each once"),
        (["--jobs", "0"], "at least 1"),
        (["--learning-rates", "fast"], "fast"),
    ],
)
def test_a_bad_grid_is_one_line(tmp_path, capsys, words, expected) -> None:
    assert main(["sweep", "bc", "--run", str(tmp_path / "s"), *words]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1
    assert not (tmp_path / "s").exists()


def test_the_folder_of_another_sweep_is_refused(tmp_path, capsys) -> None:
    folder = tmp_path / "s"
    folder.mkdir()
    (folder / "notes.txt").touch()
    assert main(["sweep", "dqn", "--run", str(folder)]) == 2
    assert "holds no sweep" in capsys.readouterr().err
    (folder / "sweep.json").write_text('{"grid": "bc"}')
    assert main(["sweep", "dqn", "--run", str(folder)]) == 2
    assert "holds another sweep (grid bc, now dqn)" in capsys.readouterr().err


def test_without_optuna_it_says_what_to_install(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    for name in ("launch.sweep", "launch.sweep_ledger", "launch.sweep_table"):
        monkeypatch.delitem(sys.modules, name)
    assert main(["sweep", "bc", "--run", "x"]) == 2
    error = capsys.readouterr().err
    assert "slipstream[sweep]" in error and error.count("\n") == 1


@pytest.mark.slow
def test_real_trainings(tmp_path: Path) -> None:
    """A grid of one point, as a user starts it."""
    folder = tmp_path / "sweep"
    words = (
        *("sweep", "bc", "--run", folder, "--spaces", "delta"),
        *("--learning-rates", "3e-3"),
        *("--train-scenes", "2", "--held-out-scenes", "2"),
        *("--", "--serial", "--network.width", "16", "--network.latents", "2"),
        *("--budget.updates", "20", "--cloning.batch-size", "16"),
    )
    command = [sys.executable, "-m", "launch", *map(str, words)]
    subprocess.run(command, cwd=ROOT, check=True)
    table = json.loads((folder / "table.json").read_text())
    assert [row["learning_rate"] for row in table["runs"]] == [3e-3]
    assert len(table["table"]) == 8  # seven of the benchmark's, and this one
    trial = folder / "trials" / "bc-delta-0.003"
    config = json.loads((trial / "config.json").read_text())["config"]
    assert config["cloning"]["learning_rate"] == 3e-3
    bank = trial / "scenes" / "heldout.bank"
    assert bank.samefile(folder / "scenes" / "heldout.bank")
    began = (trial / "config.json").stat().st_mtime
    subprocess.run(command, cwd=ROOT, check=True)  # nothing is left to run
    assert (trial / "config.json").stat().st_mtime == began
