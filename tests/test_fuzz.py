"""Broken files of every format: a clear error or a sound scene, never anything else."""

import numpy as np
import pytest

from sim.womd_example import parse_example
from tests import fuzz_cases, fuzz_damage, records
from tests.fuzz_loaders import Runner, Tally, Task, fuzz


def _check(tallies: dict[str, Tally]) -> None:
    """No violation, and both outcomes occur in every format."""
    assert [line for tally in tallies.values() for line in tally.violations] == []
    for name, tally in tallies.items():
        assert tally.errors and tally.scenes, name


def test_broken_files_end_in_an_error_or_a_scene() -> None:
    _check(fuzz(list(fuzz_cases.MAKERS), cases=25, seed=0, step=False))


@pytest.mark.slow
def test_many_broken_files_and_an_environment_on_what_remains() -> None:
    tallies = fuzz(list(fuzz_cases.MAKERS), cases=120, seed=1)
    _check(tallies)
    assert all(tallies[name].stepped for name in tallies if name != "bank")


@pytest.mark.slow
def test_large_files_convert() -> None:
    """1,000 objects and a million road points."""
    names = ("large scenario", "large argoverse2")
    for name, tally in fuzz([], cases=0, seed=0, stress=names, step=False).items():
        assert tally.violations == [], name
        assert tally.scenes == 1


def test_a_process_that_dies_or_hangs_is_a_violation() -> None:
    """The watch itself: a format that is not there, and a limit that has passed."""
    runner = Runner()
    try:
        verdict = runner.run(Task("none", 0, 0, ""), 60.0)
        assert "'none' is not in list" in verdict.violations[0]
        verdict = runner.run(Task("scenario", 0, 0, ""), 0.0)
        assert verdict.violations == ["no end after 0 s"]
    finally:
        runner.close()


def test_the_same_seed_breaks_the_same_way() -> None:
    data = bytes(range(256))
    first, second = (
        [
            fuzz_damage.broken_bytes(np.random.default_rng([s, 3]), data)
            for s in range(9)
        ]
        for _ in range(2)
    )
    assert first == second
    assert len(set(first)) > 5


def test_reordered_fields_say_the_same() -> None:
    payload = records.encode_example(records.example())
    inner = payload[3:]  # behind the tag and the length of the one field around it
    assert len(inner) == payload[1] % 128 + 128 * payload[2]
    moved = fuzz_damage.reordered_fields(np.random.default_rng(0), inner)
    assert moved != inner
    first, same = (parse_example(payload[:3] + i, source="a") for i in (inner, moved))
    np.testing.assert_array_equal(first.position, same.position)
    assert len(first.roads) == len(same.roads)
