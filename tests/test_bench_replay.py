"""`bench replay`: its arithmetic, its options, and a run with real processes."""

import json
import os
import re
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from launch.bench_replay_figures import figures
from launch.bench_replay_memory import message_bytes
from launch.bench_replay_print import tables
from launch.bench_replay_runs import figures as between
from launch.bench_replay_sections import medians, ratios
from launch.main import main


def row(
    name: str, rate: float, repetition: int, *, shared: bool = False, batches: int = 4
) -> dict:
    return {
        "contestant": name,
        "shared_memory": shared,
        "batches_per_reply": batches,
        "repetition": repetition,
        "samples_per_s": rate,
        "inserts_per_s": rate / 8,
        "samples_per_insert": 8.0,
        "cpu_us_per_sample": 30.0,
        "cpu_us_per_sample_by": {"service": 15.0, "writers": 5.0, "reader": 10.0},
    }


ROWS = [
    row("slipstream", 40.0, 0, batches=1),
    row("slipstream", 60.0, 0),
    row("slipstream", 90.0, 0, shared=True),
    row("reverb", 10.0, 0),
    row("slipstream", 50.0, 1),
    row("slipstream", 80.0, 1, shared=True),
    row("reverb", 20.0, 1),
]


def test_ratios_are_within_a_repetition() -> None:
    assert ratios(ROWS, False, "reverb") == [6.0, 2.5]
    assert ratios(ROWS, True, "reverb") == [9.0, 4.0]
    assert ratios(ROWS, True, "torchrl") == []
    both = [*ROWS, row("torchrl", 30.0, 0, shared=True)]
    assert ratios(both, True, "torchrl") == []
    assert ratios(both, True, "torchrl", True) == [3.0]


def test_medians_are_per_contestant_and_link() -> None:
    found = medians(ROWS)
    assert [r["samples_per_s"] for r in found] == [40.0, 55.0, 85.0, 15.0]
    assert [r["repetitions"] for r in found] == [1, 2, 2, 2]


def test_figures_are_what_happened_between_two_looks() -> None:
    def told(at: float, rows: float, queries: float, cpu: float) -> dict:
        return {
            "at": at,
            "rows": rows,
            "queries": queries,
            "cpu_s": cpu,
            "resident_bytes": 1,
        }

    first = {
        "service-0": told(1.0, 0, 0, 2.0),
        "service-1": told(1.0, 0, 0, 2.0),
        "writers": told(1.0, 100, 10, 1.0),
        "reader": told(1.0, 500, 5, 3.0),
    }
    last = {
        "service-0": told(3.0, 0, 0, 3.0),
        "service-1": told(3.0, 0, 0, 2.5),
        "writers": told(3.0, 300, 14, 1.1),
        "reader": told(3.0, 2100, 30, 3.4),
    }
    found = between(first, last)
    assert found["samples_per_s"] == 800.0
    assert found["inserts_per_s"] == 100.0
    assert found["samples_per_insert"] == 8.0
    assert found["cores"] == pytest.approx(
        {"service": 0.75, "writers": 0.05, "reader": 0.2}
    )
    assert found["cpu_us_per_sample"] == pytest.approx(1e6 / 800)


def test_a_transition_is_small_in_every_message() -> None:
    told = message_bytes()
    assert told["row_bytes"] == 128
    assert max(told["insert"], told["sample_reply"]) <= 600


def test_the_bars_are_drawn() -> None:
    drawn = figures({"sections": {"throughput": ROWS}})
    assert drawn["replay_throughput.png"].startswith(b"\x89PNG")
    assert [table.row_count for table in tables("throughput", ROWS)] == [4, 2]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--against", "reverb"], "write reverb=PYTHON"),
        (["--against", "reverb=/nowhere/python"], "is no program"),
        (["--sections", "speed"], "speed"),
        (["--repetitions", "0"], "at least 1"),
        (["--batches-per-reply", "0"], "at least 1"),
        (["--json", f"{__file__}/f.json"], "is not a folder"),
        (["--json", "/proc/f.json"], "/proc cannot be written"),
        (["--plot", "/proc/plots"], "/proc cannot be written"),
    ],
)
def test_mistakes_are_one_line_before_anything_is_measured(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "replay", *words]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    assert re.search(line, said), said


def test_a_python_without_reverb_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho \"No module named 'reverb'\" >&2\nexit 1\n")
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    assert main(["bench", "replay", "--against", f"reverb={python}"]) == 2
    said = capsys.readouterr().err.strip()
    assert "No module named 'reverb'" in said and "\n" not in said


def measured(sections: str, tmp_path: Path) -> list[dict]:
    """What a brief run of one section found."""
    file = tmp_path / "f.json"
    words = ["--quick", "--sections", sections, "--json", str(file)]
    assert main(["bench", "replay", *words]) == 0
    assert os.listdir(tmp_path) == ["f.json"]
    found: list[dict] = json.loads(file.read_text())["sections"][sections]
    return found


@pytest.mark.slow
def test_ours_and_torchrl_with_real_processes(tmp_path: Path) -> None:
    found = measured("throughput", tmp_path)
    turns = [
        (r["contestant"], r["shared_memory"], r["batches_per_reply"]) for r in found
    ]
    assert turns == [
        ("slipstream", False, 16),
        ("slipstream", True, 16),
        ("torchrl", False, 16),
        ("torchrl", True, 16),
        ("slipstream", False, 1),
        ("slipstream", True, 1),
    ]
    for turn in found:
        assert turn["samples_per_s"] > 0
        assert 4.0 < turn["samples_per_insert"] < 16.0  # of a short window
        assert min(turn["cores"].values()) >= 0.0


@pytest.mark.slow
def test_state_rows_are_sampled_and_rendered(tmp_path: Path) -> None:
    found = measured("rows", tmp_path)
    assert [r["what"] for r in found] == [
        "sampled",
        "sampled",
        "sampled and rendered",
        "rendered",
    ]
    assert found[2]["observations_per_s"] == 2 * found[2]["samples_per_s"] > 0
    assert found[3]["observations_per_s"] > 0


@pytest.mark.slow
def test_memory_is_what_the_process_grew_by(tmp_path: Path) -> None:
    *processes, messages = measured("memory", tmp_path)
    eight = [r for r in processes if r["row_bytes"] == 8192]
    assert [(r["contestant"], r["durable"]) for r in eight] == [
        ("slipstream", False),
        ("slipstream", True),
        ("torchrl", False),
    ]
    for row in eight[:2]:
        # Of few rows: what is on its way on a loaded machine was 10 MB.
        more = row["rows"] * (row["bytes_per_row"] - 8192)
        assert row["rows"] == 1 << 13 and -(8 << 20) < more < 24 << 20
    assert messages["row_bytes"] == 128


@pytest.mark.slow
def test_scale_ends_in_a_model(tmp_path: Path) -> None:
    found = measured("scale", tmp_path)
    crews = [(r["shards"], r["writers"]) for r in found if r["what"] == "scale"]
    assert crews == [(1, 1), (1, 4), (2, 2), (2, 4)]
    assert found[-1]["what"] == "model" and found[-1]["shards"] >= 1
    assert found[-1]["cores"]["service"] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_bench_leaves_nothing(
    number: signal.Signals, tmp_path: Path
) -> None:
    words = ["--sections", "throughput", "--json", str(tmp_path / "f.json")]
    bench = subprocess.Popen(
        [sys.executable, "-m", "launch", "bench", "replay", *words],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stderr=subprocess.DEVNULL,
    )
    try:
        deadline = time.monotonic() + 60
        while len(children := psutil.Process(bench.pid).children()) < 3:
            assert bench.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        assert list(tmp_path.glob("slipstream-bench-*"))
        bench.send_signal(number)
        assert bench.wait(30) == 130
    finally:
        bench.kill()
    # One that was still starting finds out that its bench is gone once it listens.
    assert not psutil.wait_procs(children, timeout=30)[1]
    assert not os.listdir(tmp_path)
