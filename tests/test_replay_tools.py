"""`slipstream replay stats` and `export`, against a service with known rows."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from actors.rows import columns_of, render, row_spec
from launch.config import RunFile, quick
from launch.export import flat
from launch.join import SCENES, TRAIN
from launch.main import find, main
from launch.train import TrainConfig, prepare
from replay.client import Sampler, Writer
from replay.keys import RunKeys
from replay.local import ReplayConfig
from sim.bank import BankFile, open_bank
from tests.replay_parts import Service, service

ROWS = 1500  # more than a page of the export
CONFIG = ReplayConfig(
    capacity=2000, min_size=100, samples_per_insert=1.0, tolerance=30.0
)


@dataclasses.dataclass
class Run:
    """A run's folder, its rows and the service that holds them."""

    folder: Path
    file: RunFile
    bank: BankFile
    rows: np.ndarray
    service: Service


def rows_from(bank: BankFile, history: int) -> np.ndarray:
    """The recording vehicles driving as they were recorded."""
    rows = np.zeros(ROWS, row_spec(history).dtype)
    log, valid = bank.arrays["log"], bank.arrays["log_valid"]
    rows["serial"] = np.arange(ROWS)
    rows["scene"] = rows["serial"] % bank.scenes
    begin = bank.arrays["current_step"][rows["scene"]]
    last = bank.arrays["steps"][rows["scene"]] - 1
    rows["step"] = begin + 1 + rows["serial"] // 2 % (last - begin)
    rows["controlled"] = bank.arrays["sdc"][rows["scene"]]
    for number, row in enumerate(rows):
        steps = row["step"] - np.arange(history + 1)[::-1]
        seen = log[row["scene"], steps, row["controlled"]]
        row["states"] = seen[:, [0, 1, 3, 4, 5]]
        row["valid"] = valid[row["scene"], steps, row["controlled"]]
        row["discount"] = number % 7 > 0
    rows["reward"] = np.arange(ROWS) / 8
    rows["action"] = np.arange(ROWS) % 5
    return rows


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("tools") / "run"
    config = quick()
    scenes = dataclasses.replace(config.scenes, train=2, held_out=1)
    config = dataclasses.replace(config, scenes=scenes)
    _, file = prepare(TrainConfig(run=folder, config=config))
    bank = open_bank(folder / SCENES / TRAIN)
    history = config.environment.observation.history
    rows, keys = rows_from(bank, history), RunKeys(file.run_id)
    with service(CONFIG, spec=row_spec(history), keys=keys) as started:
        writer = Writer(
            session=started.client,
            keys=keys,
            spec=row_spec(history),
            writer=3,
            epoch=1,
            batch_rows=50,
        )
        writer.append(rows)
        assert writer.close(30.0)
        endpoint = {"run_id": file.run_id, "connect": [started.endpoint]}
        (folder / "endpoint.json").write_text(json.dumps(endpoint))
        yield Run(folder, file, bank, rows, started)


def test_stats_say_all_there_is(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    spec = row_spec(run.file.config.environment.observation.history)
    sampler = Sampler(
        session=run.service.client,
        keys=RunKeys(run.file.run_id),
        spec=spec,
        batch_size=50,
        in_flight=1,
    )
    sample = sampler.sample(20.0)
    sampler.update_priorities(sample.ids, np.full(50, 4.0))
    sampler.sample(20.0)
    sampler.sample(20.0)
    assert main(["replay", "stats", "--run", str(run.folder), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["inserts"], told["size"], told["capacity"]) == (ROWS, ROWS, 2000)
    assert told["samples"] >= 150
    assert told["debt"] == pytest.approx(ROWS - 100 - told["samples"])
    assert told["ages"]["p0"] == 0.0 and told["ages"]["p100"] == ROWS - 1
    assert told["priorities"]["p5"] == pytest.approx(1.0)
    assert told["priorities"]["p100"] == pytest.approx(4.0)
    assert told["row_bytes"] == spec.row_bytes
    assert told["memory_per_row_bytes"] == pytest.approx(spec.row_bytes + 4.6, abs=0.5)
    assert told["resident_bytes"] > 1e6 and told["uptime_s"] > 0
    (writer,) = told["writers"]
    assert (writer["writer"], writer["rows"], writer["pending"]) == (3, ROWS, 0)
    assert 0 <= writer["lag_s"] <= told["uptime_s"]


def test_stats_as_a_table_and_a_file(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "stats.json"
    words = ["--run-id", run.file.run_id, "--connect", run.service.endpoint]
    assert main(["replay", "stats", *words, "--json", str(out)]) == 0
    assert "1,500 of 2,000 rows" in capsys.readouterr().out
    assert json.loads(out.read_text())["inserts"] == ROWS


@pytest.mark.slow
def test_an_export_is_what_was_stored_with_its_observations(
    run: Run, tmp_path: Path
) -> None:
    out = tmp_path / "replay.hdf5"
    words = ["--run", str(run.folder), "--out", str(out)]
    assert main(["replay", "export", *words]) == 0
    config = run.file.config.environment.observation
    before, after = render(run.bank.bank, columns_of(run.rows), config)
    with h5py.File(out) as file:
        np.testing.assert_array_equal(file["observations"], flat(before))
        np.testing.assert_array_equal(file["next_observations"], flat(after))
        np.testing.assert_array_equal(file["actions"], run.rows["action"])
        np.testing.assert_array_equal(file["rewards"], run.rows["reward"])
        np.testing.assert_array_equal(file["terminals"], np.arange(ROWS) % 7 == 0)
        last = run.bank.arrays["steps"][run.rows["scene"]] - 1 == run.rows["step"]
        assert last.any()
        np.testing.assert_array_equal(
            file["timeouts"], last & (np.arange(ROWS) % 7 > 0)
        )
        np.testing.assert_array_equal(file["infos/id"], np.arange(ROWS))
        for name in run.rows.dtype.names or ():
            np.testing.assert_array_equal(file[f"infos/{name}"], run.rows[name])
        assert (file.attrs["format"], file.attrs["rows"]) == ("D4RL", ROWS)
        assert file.attrs["bank_sha256"] == run.bank.content_hash
        assert json.loads(file.attrs["config"])["actors"] == run.file.config.actors
        # The layout finds the parts again.
        for name, column, shape in json.loads(file.attrs["observation"]):
            part = file["observations"][:, column : column + int(np.prod(shape))]
            expected = np.asarray(getattr(before, name), np.float32)
            np.testing.assert_array_equal(part.reshape(-1, *shape), expected)


def test_an_export_without_observations_is_small(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "rows.hdf5"
    words = ["--run", str(run.folder), "--out", str(out), "--no-observations"]
    assert main(["replay", "export", *words]) == 0
    with h5py.File(out) as file:
        assert "observations" not in file
        assert len(file["rewards"]) == ROWS


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["stats"], "name the run: --run FOLDER"),
        (["stats", "--run", "nowhere"], "no run in progress here"),
        (["export", "--out", "x"], "name the run"),
        (["export"], "--out"),
    ],
)
def test_mistakes_are_one_line(
    words: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", *words]) == 2
    error = capsys.readouterr().err
    assert why in error and len(error.splitlines()) == 1


def test_the_role_is_still_a_command() -> None:
    assert find(["replay", "--run-id", "x"]) == ("replay", ["--run-id", "x"])
    assert find(["replay", "stats", "--watch"]) == ("replay stats", ["--watch"])
