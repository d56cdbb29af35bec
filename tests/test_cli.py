"""The command line: what it does, and the one line for each bad input."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from launch.config import RunFile, quick
from launch.main import main, usage
from sim.bank import VERSION
from sim.conversion import Conversion, _submitted
from sim.scene import SceneError

TINY = ("--scenes.train", "2", "--scenes.held-out", "2")


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line with which a command refuses; nothing else is printed."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 2
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    lines = [line for line in captured.err.split("\n") if line]
    assert len(lines) == 1, lines
    assert captured.out == ""
    return lines[0]


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two procedural scenes."""
    path = tmp_path_factory.mktemp("bank") / "two.bank"
    words = ["scenes", "procedural", "--count", "2", "--out", str(path)]
    assert main(words) == 0
    return path


def test_what_it_offers_needs_no_heavy_import() -> None:
    code = (
        "import sys; from launch.main import main; main(['--help']);"
        "assert not {'jax', 'torch', 'zenoh'} & set(sys.modules)"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "train dqn" in ran.stdout


def test_a_person_without_a_command_gets_the_list(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([]) == 2
    assert capsys.readouterr().out == usage() + "\n"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["fly"], "no such command"),
        (["train"], "expected dqn"),
        (["train", "ppo"], "expected dqn or bc and not ppo"),
        (["scenes", "eat"], "convert or info or procedural"),
        (["train", "dqn", "--preset", "slow"], "choose one of quick, laptop, paper"),
        (["train", "dqn", "--spped", "1"], "--spped"),
        (["train", "dqn", "--actors", "many"], "many"),
        (["train", "dqn", "--learner.precision", "half"], "dqn: invalid choice 'half'"),
        (["train", "dqn", "--actors", "0"], "actors=0 must be at least 1"),
        (["train", "dqn", "--network.width", "33"], "must divide width=33"),
        (["train", "dqn", "--envs", "512"], "would deadlock"),
        (["train", "dqn", "--resume", "--run", "nowhere"], "no run to resume"),
        (["train", "dqn", "--run", "new", "--scenes", "nowhere"], "no such file"),
        (["evaluate", "--agent", "ghost"], "unknown; one of log, expert"),
        (["evaluate"], "--agent"),
        (["evaluate", "--agent", "log", "log"], "each once"),
        (["evaluate", "--agent", "log", "idm", "--record", "a.rrd"], "one --agent"),
        (["evaluate", "--agent", "log", "--objects", "all", "--record", "a"], "at sdc"),
        (["sweep", "ppo"], "expected bc or dqn or all and not ppo"),
        (
            ["evaluate", "--agent", "log", "--objects", "some"],
            "choose sdc, all, tracks",
        ),
        (["evaluate", "--agent", "log", "--others", "ghost"], "ghost"),
        (["evaluate", "--agent", "expert", "--scenes", "nowhere"], "no such file"),
        (["scenes", "procedural", "--count", "0", "--out", "x"], "must be at least 1"),
        (["scenes", "info", "nowhere"], "no such file"),
        (["view", "nowhere"], "no such file or folder"),
        (["replay", "--run-id", "r"], "--listen"),
        (["actor", "--run-id", "r"], "--connect"),
        (["actor", "--run-id", "r", "--connect", "here"], "PROTOCOL/HOST:PORT"),
        (["actor", "--run-id", "a/b", "--connect", "tcp/127.0.0.1:1"], "run id"),
        (["learner", "--run-id", "r", "--connect", "tcp/10.0.0.1:1"], "--insecure"),
    ],
)
def test_a_mistake_gets_one_line(
    words: list[str],
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert expected in refusal(capsys, *words)


def test_a_run_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = RunFile(
        run_id="r", config=quick(), train_hash="", held_out_hash="", scenes=()
    )
    run.write(tmp_path)
    line = refusal(capsys, "train", "dqn", "--run", tmp_path)
    assert "this run exists" in line and "--resume" in line


def test_a_folder_of_other_things_is_not_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    assert "not empty" in refusal(capsys, "train", "dqn", "--run", tmp_path)


def test_a_run_that_could_not_begin_leaves_its_folder_free(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    wrong = ("train", "dqn", "--run", run, "--scenes", tmp_path / "wrong")
    assert "no such file" in refusal(capsys, *wrong)
    assert not run.exists()
    (run / "scenes").mkdir(parents=True)  # as a kill leaves it, half-way
    (run / "scenes" / "train.bank").write_bytes(b"half")
    assert "no such file" in refusal(capsys, *wrong)


def test_no_permission(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Below a file nobody can write, whoever runs the tests."""
    file = tmp_path / "file"
    file.write_text("")
    line = refusal(capsys, "train", "dqn", "--run", file / "run")
    assert str(file) in line
    line = refusal(
        capsys, "scenes", "procedural", "--count", 1, "--out", file / "a.bank"
    )
    assert str(file) in line


def test_a_bank_of_another_version(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old = tmp_path / "old.bank"
    ours, theirs = (f'"version":{number}'.encode() for number in (VERSION, 9))
    old.write_bytes(bank.read_bytes().replace(ours, theirs, 1))
    line = refusal(capsys, "evaluate", "--agent", "expert", "--scenes", old)
    assert "has version 9" in line


def test_a_truncated_bank(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.bank"
    short.write_bytes(bank.read_bytes()[:-5])
    assert "truncated" in refusal(capsys, "scenes", "info", short)


def test_a_truncated_recording_names_the_byte(
    scenes_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = scenes_data / "womd" / "motion_data_one_scenario.tfrecord"
    short = tmp_path / "short.tfrecord"
    short.write_bytes(whole.read_bytes()[:1000])
    line = refusal(capsys, "scenes", "convert", short, "--out", tmp_path / "a.bank")
    assert "byte" in line and str(short) in line
    assert not (tmp_path / "a.bank").exists()


def test_a_port_in_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = RunFile(
        run_id="r", config=quick(), train_hash="", held_out_hash="", scenes=()
    )
    run.write(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        words = ["replay", "--run-id", "r", "--run", str(tmp_path)]
        # In a process: a role takes over the signals of the one that it is in.
        ended = subprocess.run(
            [sys.executable, "-m", "launch", *words, "--listen", endpoint],
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1 and "port in use" in ended.stderr


def test_a_checkpoint_of_another_network(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Weights whose layout is not the one that their file promises."""
    from launch.learning import make_learner
    from launch.progress import checkpoint_extra
    from learner.checkpoint import save_checkpoint

    config = quick()
    path = save_checkpoint(
        tmp_path, learner=make_learner(config), extra=checkpoint_extra(config, 0.0, {})
    )
    words = ("evaluate", "--agent", tmp_path, "--scenes", bank, "--json", "-")
    assert main([str(word) for word in words]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [scene["id"] for scene in result["scenes"]]
    file = path / "policy.npz"
    with np.load(file) as arrays:
        parts = dict(arrays)
    network = json.loads(str(parts["network"])) | {"width": 16}
    np.savez(file, **parts | {"network": np.array(json.dumps(network))})
    line = refusal(capsys, "evaluate", "--agent", tmp_path, "--scenes", bank)
    assert "another network" in line


def test_evaluation_counts_every_scene(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = {}
    for objects in ("sdc", "all"):
        out = tmp_path / f"{objects}.json"
        words = ("evaluate", "--agent", "log", "--objects", objects, "--scenes", bank)
        assert main([str(word) for word in (*words, "--json", out)]) == 0
        assert "failures" in capsys.readouterr().out
        result = json.loads(out.read_text())
        assert result["agent"] == "log" and len(result["scenes"]) == 2
        assert result["intervals_95"]["overlap_rate"][0] == 0.0
        assert ("object_failure_rate" in result) == (objects == "all")
        rows[objects] = result["scenes"]
    for ours, every in zip(rows["sdc"], rows["all"], strict=True):
        assert ours["id"] == every["id"] and ours["objects"] == 1
        # The generator's cars collide with nothing and stay on the road.
        assert ours["overlap"] == ours["offroad"] == every["overlap"] == 0
        assert every["valid"] > ours["valid"] and every["objects"] > 1
        assert ours["wrong_way"] == ours["off_route"] == 0
        assert ours["progression"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_several_agents_share_a_table(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "--agent", "log", "constant-speed", "--scenes", str(bank)]
    json_file, markdown = tmp_path / "f.json", tmp_path / "f.md"
    files = ["--json", str(json_file), "--markdown", str(markdown)]
    assert main([*words, *files, "--objects", "1,0"]) == 0
    table = capsys.readouterr().out
    assert "2 scenes, rates of 4 objects" in table
    content = json.loads(json_file.read_text())
    assert [one["agent"] for one in content["agents"]] == ["log", "constant-speed"]
    assert [scene["objects"] for scene in content["scenes"]["log"]] == [2, 2]
    lines = [line for line in markdown.read_text().splitlines() if line[:1] == "|"]
    for name in ("off-road", "overlap", "log ADE", "progression", "wrong-way"):
        assert name in table and name in lines[0]
    rows = [line.split("|")[1].strip() for line in lines[2:]]
    assert rows == ["log", "constant-speed"]
    assert "0.0% [0.0, " in lines[2]
    line = refusal(capsys, *words, "--objects", "0,99")
    assert "99 is none" in line


def test_info_tells_a_bank(bank: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "info", str(bank), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert len(content["scenes"]) == 2
    assert len(content["hash"]) == 64


def test_ctrl_c_is_130(tmp_path: Path) -> None:
    """While scenes are made, long before there is a supervisor."""
    process = subprocess.Popen(
        [sys.executable, "-m", "launch", "train", "dqn", "--run", str(tmp_path / "r")],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell's background job has Ctrl-C ignored, and its children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not (tmp_path / "r" / "scenes").exists():
        assert process.poll() is None
        os.sched_yield()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == "interrupted\n"
    assert not (tmp_path / "r").exists()


def test_ctrl_c_waits_until_a_process_has_been_started(tmp_path: Path) -> None:
    """Another thread takes the signal; half started, a process would complain."""
    ended, started = threading.Event(), []

    class Starting(ProcessPoolExecutor):
        def submit(self, *_: object) -> object:
            os.kill(os.getpid(), signal.SIGINT)
            woken.recv(1)  # it has come
            started.append(True)
            return Future()

    thread = threading.Thread(target=ended.wait)
    thread.start()
    woken, waking = socket.socketpair()
    waking.setblocking(False)
    signal.set_wakeup_fd(waking.fileno())
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Starting(1) as pool, pytest.raises(KeyboardInterrupt):
            _submitted(pool, SceneError("none"), Conversion(folder=tmp_path))
        assert started and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGINT, before)
        ended.set()
        thread.join()
        woken.close()
        waking.close()
