"""What a person is told of a run, and what a benchmark makes of it."""

import dataclasses
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from launch.bench import measured
from launch.budget import BudgetConfig
from launch.config import quick
from launch.console import line_of, snapshot, time_left
from launch.doctor import CHECKS, Finding, examine
from launch.errors import LaunchError
from launch.status import actor_rates

NOW = 1000.0
ACTOR = {"steps": 500, "uptime_s": 10.0, "waited_s": 4.0, "failure_rate": 0.5}
LEARNER = {"updates": 30, "elapsed_s": 60.0, "updates_per_s": 10.0, "loss": 0.25}
STATS = {"inserts": 1000, "samples": 7900, "samples_per_insert": 7.9, "size": 900}


def roles(**actors: dict[str, float]) -> dict[str, tuple[float, dict[str, float]]]:
    """What each role said last, just now."""
    told = {f"actor-{name[1:]}": values for name, values in actors.items()}
    return {
        name: (NOW, values) for name, values in (told | {"learner": LEARNER}).items()
    }


def test_the_figures_of_a_run() -> None:
    other = ACTOR | {"failure_rate": 0.25, "waited_s": 2.0}
    figures = snapshot(quick(), roles(a0=ACTOR, a1=other), STATS, NOW)
    assert figures["actors"] == 2
    assert figures["failure_rate"] == pytest.approx(0.375)
    assert figures["actors_wait"] == pytest.approx(0.3)
    assert figures["steps"] == 1000 and figures["updates"] == 30
    line = line_of(figures)
    ratio = quick().replay.samples_per_insert
    assert f"7.900 (of {ratio:g})" in line and "37.5%" in line
    assert "\n" not in line


def test_a_role_that_fell_silent_does_not_count() -> None:
    told = roles(a0=ACTOR, a1=ACTOR | {"failure_rate": 1.0})
    told["actor-1"] = (NOW - 60.0, told["actor-1"][1])
    figures = snapshot(quick(), told, STATS, NOW)
    assert figures["actors"] == 1 and figures["failure_rate"] == 0.5


def test_nothing_is_known_at_first() -> None:
    figures = snapshot(quick(), {}, {}, NOW)
    assert figures["steps"] == 0
    assert "loss -" in line_of(figures)


@pytest.mark.parametrize(
    ("minutes", "updates", "expected"),
    [
        (2.0, 10**6, 60.0),  # two minutes, of which one is over
        (0.0, 130, 10.0),  # 100 updates at 10 a second
        (2.0, 130, 10.0),
        (0.5, 10**6, 0.0),  # overdue
    ],
)
def test_time_left(minutes: float, updates: int, expected: float) -> None:
    budget = BudgetConfig(updates=updates, minutes=minutes)
    config = dataclasses.replace(quick(), budget=budget)
    assert time_left(config, LEARNER) == pytest.approx(expected)


def test_time_left_is_unknown_before_the_first_update() -> None:
    config = dataclasses.replace(quick(), budget=BudgetConfig(updates=5))
    assert time_left(config, {}) is None


def test_rates_are_of_actors_that_have_any() -> None:
    told = {"actor-0": (NOW, {"return": 1.0}), "actor-1": (NOW, {"steps": 5})}
    assert actor_rates(told | {"learner": (NOW, {"return": 9.0})}) == {"return": 1.0}


def look(seconds: float) -> dict[str, object]:
    """A run at a steady pace: 100 steps/s of each actor, 12 updates/s."""
    actor = {
        "steps": 100 * seconds,
        "uptime_s": seconds,
        "acted_s": 0.5 * seconds,
        "waited_s": 0.25 * seconds,
    }
    learner = {
        "updates": 12 * seconds,
        "updating_s": seconds,
        "waited_s": 0.02 * seconds,
        "rendered_s": 0.08 * seconds,
        "updated_s": 0.8 * seconds,
    }
    return {
        "looked_s": seconds,
        "steps": 200 * seconds,
        "samples": 1600 * seconds,
        "samples_per_insert": 8.0,
        "configured_samples_per_insert": 8.0,
        "cpu": {"learner": 1.0},
        "roles": {"learner": learner, "actor-0": actor, "actor-1": actor},
    }


def test_a_benchmark_is_the_difference_of_two_looks() -> None:
    result = measured(look(10.0), look(40.0))
    assert result["environment_steps_per_s"] == pytest.approx(200.0)
    assert result["transitions_per_s"] == pytest.approx(200.0)
    assert result["updates_per_s"] == pytest.approx(12.0)
    assert result["learner_waits"] == pytest.approx(0.02)
    assert result["processes"]["actor-0"] == pytest.approx(
        {"waited": 0.25, "acted": 0.5, "other": 0.25}
    )
    assert result["processes"]["learner"]["other"] == pytest.approx(0.1)


def test_a_benchmark_of_no_time_is_refused() -> None:
    with pytest.raises(LaunchError, match="--seconds"):
        measured(look(10.0), look(10.0))


def test_the_doctor_finds_this_machine_fit() -> None:
    """What the tests need, the doctor must find; a Zenoh round trip among it."""
    cheap = [one for one in CHECKS if one[0] not in {"jax", "torch", "devices"}]
    findings = [examine(name, check) for name, check in cheap]
    assert [finding.check for finding in findings] == [name for name, _ in cheap]
    assert not [finding for finding in findings if finding.verdict == "error"]
    assert all(finding.advice for finding in findings if finding.verdict != "ok")


def test_a_check_that_breaks_is_a_finding() -> None:
    def broken() -> Finding:
        raise RuntimeError("no loopback")

    finding = examine("network", broken)
    assert finding.verdict == "error" and "no loopback" in finding.found


BUSY = """
import sys, threading, time
from launch.signals import Asked
asked = Asked()
asked.listen(grace_s={grace})
print("ready", flush=True)
{body}
sys.exit(asked.exit_code)
"""


LONG_CALLS = """
import ctypes
while True:  # a signal interrupts one of them
    ctypes.CDLL(None).sleep(25)
"""


def run_busy(grace: float, body: str) -> tuple[int, float]:
    """Exit code and time to end, of a process that is asked to end."""
    process = subprocess.Popen(
        [sys.executable, "-c", BUSY.format(grace=grace, body=body)],
        stdout=subprocess.PIPE,
        cwd=Path(__file__).parent.parent,
    )
    assert process.stdout is not None
    process.stdout.readline()
    began = time.monotonic()
    process.send_signal(signal.SIGTERM)
    code = process.wait(timeout=30)
    process.stdout.close()
    return code, time.monotonic() - began


def test_a_loop_that_looks_ends_at_once() -> None:
    code, took = run_busy(600.0, "asked.stop.wait()")
    assert code == 128 + signal.SIGTERM
    assert took < 10


def test_a_long_call_is_cut_short() -> None:
    """The main thread is in C and never looks: `stop` alone would wait for ever."""
    code, _ = run_busy(0.2, LONG_CALLS)
    assert code == 128 + signal.SIGTERM
