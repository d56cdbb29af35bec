"""The soak's verdict, on runs that leak, drift or lose rows; and a real soak."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from launch.bench_replay_figures import figures
from launch.bench_replay_print import tables
from launch.bench_soak_roles import CONFIG, rows_of
from launch.bench_soak_run import Rows
from launch.bench_soak_verdict import (
    MOST_BYTES,
    disk_faults,
    found_bytes_per_query,
    memory_of,
    ratio_faults,
    slope_of,
)
from launch.main import main

S, MIN_SIZE = CONFIG.samples_per_insert, CONFIG.min_size
TOLERANCE = CONFIG.limiter().tolerance


def looks(
    leak: float = 0.0, *, seconds: float = 600.0, noise: float = 0.2e6, files: float = 0
) -> list[dict[str, Any]]:
    """Of a service that starts anew at half the time; `leak` in bytes a second."""
    random = np.random.default_rng(0)
    found = []
    for at in np.arange(2.0, seconds, 2.0):

        def seen(age: float, at: float = at) -> dict[str, float]:
            # Memory comes and goes with the connections, and a new life starts small.
            own = 40e6 * min(1.0, age / 10) + leak * age + noise * (at % 14) / 14
            own += random.normal(0, noise / 4)
            return {"age_s": age, "own": own, "files": 37 + files * age, "threads": 11}

        half = seconds / 2
        life, began = (1, 0.0) if at < half else (2, half)
        found.append(
            {
                "seconds": at,
                "inserts": int(at * 10_000),
                "samples": int(at * 80_000),
                "disk_bytes": 1 << 24,
                "processes": {
                    f"service, life {life}": seen(at - began),
                    "writer 0, life 1": seen(at),
                    "reader 0, life 1": seen(at),
                    "reader 1, life 1": seen(at),
                },
            }
        )
    return found


def test_memory_that_comes_and_goes_is_flat() -> None:
    told, faults = memory_of(looks())
    assert not faults
    assert set(told) == {"service", "writer 0", "reader 0", "reader 1"}
    assert told["service"]["seconds"] < 230  # its last life, without its warm-up


def test_a_leak_of_one_small_object_per_query_is_a_fault() -> None:
    """1,600 queries a second of these looks; the least object takes 16 bytes."""
    found = found_bytes_per_query(looks())
    assert found is not None and found < 8
    leak = 16 * (10_000 / 32 + 80_000 / 64)
    _, faults = memory_of(looks(leak))
    assert len(faults) == 4 and all("grows, " in fault for fault in faults)


def test_what_is_too_short_or_too_noisy_is_not_called_flat() -> None:
    _, brief = memory_of(looks(seconds=40.0))
    _, noisy = memory_of(looks(noise=40e6))
    assert all("seen too briefly" in fault for fault in brief)
    assert len(brief) == 4
    assert any("not shown to be flat" in fault for fault in noisy)


def test_the_slopes_error_is_what_it_says() -> None:
    """Over many runs of noise that lasts from look to look 95% lie within."""
    random, ages = np.random.default_rng(1), np.arange(0.0, 300.0, 2.0)
    within = 0
    for _ in range(400):
        noise = random.normal(0, 1, len(ages) + 4)
        lasting = np.convolve(noise, np.ones(5) / 5, "valid")
        slope = slope_of(ages, 0.01 * ages + lasting)
        assert slope is not None
        within += abs(slope.per_s - 0.01) <= slope.error
    assert 0.92 < within / 400 < 0.98


def test_more_and_more_handles_and_disk_are_faults() -> None:
    _, faults = memory_of(looks(files=0.1))
    assert any("more and more files" in fault for fault in faults)
    seen = looks()
    assert not disk_faults(seen)
    seen[-1]["disk_bytes"] += MOST_BYTES
    assert disk_faults(seen) == ["disk: grew by 4.0 MiB"]


def test_a_ratio_that_drifts_or_is_off_is_a_fault() -> None:
    inserts = np.arange(MIN_SIZE, 60_000, 1_000)
    exact = (S * (inserts - MIN_SIZE)).astype(int)

    def faults(samples: np.ndarray) -> list[str]:
        return ratio_faults(list(zip(inserts.tolist(), samples.tolist(), strict=True)))

    assert not faults(exact)
    drifting = exact + (inserts * 0.02).astype(int)
    assert [f.split(",")[0] for f in faults(drifting)] == [
        f"ratio: {0.02 * inserts[-1] / TOLERANCE:.2f} tolerances are owed at one time"
    ]
    off = exact + np.where(inserts > 30_000, 1_200, 0)
    assert "ratio: off by 1.50% over 10000 inserts" in faults(off)
    assert ratio_faults([(2_000, 8_000)]) == [
        "ratio: not shown, no 10000 inserts were seen"
    ]


def test_rows_that_are_lost_doubled_or_damaged_are_counted() -> None:
    def seen(numbers: list[int], ids: list[int]) -> Rows:
        rows = Rows()
        written = rows_of(0, 1, 0)
        rows.take(np.array(ids, np.uint64), written[numbers])
        return rows

    whole = seen([0, 1, 2], [0, 1, 2])
    assert (whole.misplaced, whole.damaged, whole.unseen) == (0, 0, 0)
    assert seen([0, 2, 3], [0, 1, 2]).misplaced
    assert seen([0, 1, 1], [0, 1, 2]).misplaced
    assert seen([0, 1, 2], [0, 2, 3]).misplaced
    assert seen([5, 6, 7], [5, 6, 7]).unseen == 5
    rows, written = Rows(), rows_of(0, 1, 0)
    written["words"][3, 0] ^= np.uint64(1)
    rows.take(np.arange(len(written), dtype=np.uint64), written)
    assert rows.damaged == 1


@pytest.mark.slow
def test_a_brief_soak_with_kills_keeps_every_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Too brief for its memory to be judged, which is said and counts as a fault."""
    file = tmp_path / "soak.json"
    words = ["--sections", "soak", "--soak-seconds", "26", "--json", str(file)]
    assert main(["bench", "replay", *words]) == 1
    report = json.loads(file.read_text())
    *seen, verdict = report["sections"]["soak"]
    assert len(seen) > 5 and sum(verdict["kills"].values()) >= 1
    assert {fault.split(":")[0] for fault in verdict["faults"]} == {"memory"}
    assert verdict["inserts"] > 20_000 and verdict["marks"] > 50
    assert min(verdict["answers"].values()) > 100 and len(verdict["answers"]) == 2
    assert verdict["worst_ratio_error"] < 0.01
    assert "did not hold" in capsys.readouterr().out
    assert list(tables("soak", report["sections"]["soak"]))
    assert figures(report)["replay_soak.png"].startswith(b"\x89PNG")
