"""The configuration of a run: presets, its file, and what is refused."""

import dataclasses
import json
from pathlib import Path

import pytest

from launch.config import (
    CONFIG,
    PRESETS,
    ExperimentConfig,
    RunFile,
    paper,
    read_run,
    with_environments,
    write_atomically,
)
from launch.errors import LaunchError
from replay.spec import ReplayError


def run_file(config: ExperimentConfig) -> RunFile:
    """A run of this configuration."""
    return RunFile(
        run_id="run-1",
        config=config,
        train_hash="a" * 64,
        held_out_hash="b" * 64,
        scenes=("procedural",),
    )


@pytest.mark.parametrize("preset", PRESETS)
def test_a_run_file_comes_back_as_it_was(preset: str, tmp_path: Path) -> None:
    run = run_file(PRESETS[preset]())
    run.write(tmp_path)
    assert read_run(tmp_path) == run
    assert [path.name for path in tmp_path.iterdir()] == [CONFIG]


def test_the_papers_constants() -> None:
    """Appendix A.2, and Acme's where it is silent."""
    config = paper()
    learner, replay = config.learner, config.replay
    assert (learner.learning_rate, learner.discount) == (5e-5, 0.99)
    assert (learner.batch_size, learner.target_period) == (64, 100)
    assert (learner.importance_exponent, learner.huber_threshold) == (0.2, 1.0)
    assert (replay.samples_per_insert, replay.tolerance) == (8.0, 0.1)
    assert (replay.capacity, replay.min_size) == (1_000_000, 1_000)
    assert replay.priority_exponent == 0.6
    assert (config.network.mlp_layers, config.network.mlp_width) == (4, 128)
    assert config.environment.progress == 0.0
    # 30 million steps at 8 samples per insert and 64 samples per update.
    assert config.budget.updates == 30_000_000 * 8 // 64


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (("config", "actors"), 0, "actors=0 must be at least 1"),
        (("config", "actors"), "two", "Expected `int`"),
        (("config", "speed"), 3, "unknown config.speed"),
        (("config", "learner", "sped"), 3, "unknown config.learner.sped"),
        (("format",), 99, "format 99"),
        (("config", "environment", "action", "space"), "sideways", "sideways"),
    ],
)
def test_a_strange_run_file_is_refused(
    path: tuple[str, ...], value: object, expected: str, tmp_path: Path
) -> None:
    run_file(paper()).write(tmp_path)
    content = json.loads((tmp_path / CONFIG).read_text())
    inner = content
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    (tmp_path / CONFIG).write_text(json.dumps(content))
    with pytest.raises(LaunchError, match=expected) as refused:
        read_run(tmp_path)
    assert str(tmp_path / CONFIG) in str(refused.value)


def test_a_truncated_run_file_is_refused(tmp_path: Path) -> None:
    run_file(paper()).write(tmp_path)
    data = (tmp_path / CONFIG).read_bytes()
    (tmp_path / CONFIG).write_bytes(data[: len(data) // 2])
    with pytest.raises(LaunchError, match="not a run's configuration"):
        read_run(tmp_path)


def test_batches_that_would_wait_for_ever_are_refused() -> None:
    """The limiter's condition, for the batches that this run sends."""
    with pytest.raises(ReplayError, match="deadlock"):
        with_environments(paper(), 512)
    assert with_environments(paper(), 4).actor.environments == 4


def test_fewer_environments_than_were_watched() -> None:
    config = paper()
    actor = dataclasses.replace(config.actor, watched=4)
    fewer = with_environments(dataclasses.replace(config, actor=actor), 2)
    assert fewer.actor.watched == 2


def test_a_reader_sees_the_old_file_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.json"
    write_atomically(path, b"old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]
