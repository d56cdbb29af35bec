"""Checkpoints are whole or absent, and resuming changes nothing."""

import itertools
import json
import os

import numpy as np
import pytest

from actors.network import NetworkConfig
from learner import checkpoint
from learner.checkpoint import (
    CheckpointError,
    latest_checkpoint,
    load_checkpoint,
    save_checkpoint,
)
from learner.learner import Batch, Learner, LearnerConfig
from learner.network import to_vector
from sim.observation import Observation, ObservationSizes

SIZES = ObservationSizes(
    ego=4, neighbours=3, agent=5, rows=4, road=3, lights=1, light=2
)
ACTIONS = 4
NETWORK = NetworkConfig(width=16, heads=2, latents=2, mlp_width=32, mlp_layers=2)


def make_learner(network=NETWORK, **fields):
    config = LearnerConfig(**{"loss": "plain", "target_period": 3, **fields})
    return Learner(config=config, network=network, sizes=SIZES, actions=ACTIONS)


def make_observations(batch, rng):
    def features(*shape):
        return rng.standard_normal((batch, *shape)).astype(np.float32)

    def mask(count):
        return rng.random((batch, count)) < 0.7

    return Observation(
        features(SIZES.ego),
        features(SIZES.neighbours, SIZES.agent),
        mask(SIZES.neighbours),
        features(SIZES.rows, SIZES.road),
        mask(SIZES.rows),
        features(SIZES.lights, SIZES.light),
        mask(SIZES.lights),
    )


def make_batches(count, batch=16):
    rng = np.random.default_rng(0)
    return [
        Batch(
            observation_tm1=make_observations(batch, rng),
            a_tm1=rng.integers(0, ACTIONS, batch).astype(np.int32),
            r_t=rng.standard_normal(batch).astype(np.float32),
            discount_t=np.ones(batch, np.float32),
            observation_t=make_observations(batch, rng),
            probabilities=rng.random(batch) + 0.01,
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("loss", ["plain", "torchrl"])
def test_resuming_gives_the_same_bits(tmp_path, loss):
    batches = make_batches(11)
    through = make_learner(loss=loss)
    expected = [through.update(batch) for batch in batches]
    before = make_learner(loss=loss)
    for batch in batches[:4]:
        before.update(batch)
    save_checkpoint(tmp_path, learner=before, extra={})
    after = make_learner(loss=loss, seed=7)
    meta = load_checkpoint(tmp_path, learner=after)
    assert meta["updates"] == after.updates == 4
    for batch, result in zip(batches[4:], expected[4:], strict=True):
        resumed = after.update(batch)
        assert resumed.loss == result.loss
        np.testing.assert_array_equal(resumed.priorities, result.priorities)
    np.testing.assert_array_equal(after.vector(), through.vector())
    np.testing.assert_array_equal(to_vector(after.target), to_vector(through.target))


def test_settings_of_the_resumed_run_hold(tmp_path):
    save_checkpoint(tmp_path, learner=make_learner(learning_rate=1.0), extra={})
    resumed = make_learner(learning_rate=0.5)
    load_checkpoint(tmp_path, learner=resumed)
    assert resumed.optimiser.param_groups[0]["lr"] == 0.5


def test_policy_is_readable_without_torch(tmp_path):
    learner, extra = make_learner(), {"environment": {"dt": 0.1}}
    path = save_checkpoint(tmp_path, learner=learner, extra=extra)
    with np.load(path / "policy.npz", allow_pickle=False) as policy:
        assert policy["vector"].dtype == np.float32
        np.testing.assert_array_equal(policy["vector"], learner.vector())
        assert NetworkConfig(**json.loads(str(policy["network"]))) == NETWORK
        assert ObservationSizes(**json.loads(str(policy["sizes"]))) == SIZES
        assert int(policy["actions"]) == ACTIONS
        assert json.loads(str(policy["extra"])) == extra
        meta = json.loads((path / "meta.json").read_text())
        assert str(policy["layout_hash"]) == meta["layout_hash"]


def test_latest_points_at_the_newest_and_old_ones_go(tmp_path):
    assert latest_checkpoint(tmp_path) is None
    learner = make_learner()
    for batch in make_batches(4):
        learner.update(batch)
        path = save_checkpoint(tmp_path, learner=learner, extra={}, keep=2)
        assert latest_checkpoint(tmp_path) == path
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "000000003",
        "000000004",
        "latest",
    ]


def test_saving_at_the_same_count_replaces(tmp_path):
    save_checkpoint(tmp_path, learner=make_learner(), extra={"run": 1})
    path = save_checkpoint(tmp_path, learner=make_learner(), extra={"run": 2})
    assert load_checkpoint(path, learner=make_learner())["extra"] == {"run": 2}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000000000", "latest"]


@pytest.mark.parametrize("name", ["policy.npz", "learner.pt", "meta.json", "latest"])
def test_a_save_cut_short_leaves_the_older_in_force(tmp_path, monkeypatch, name):
    learner = make_learner()
    older = save_checkpoint(tmp_path, learner=learner, extra={})
    learner.update(make_batches(1)[0])
    write = checkpoint._write_file

    def cut(path, data):
        if path.name.endswith(name):
            path.write_bytes(data[: len(data) // 2])
            raise KeyboardInterrupt
        write(path, data)

    monkeypatch.setattr(checkpoint, "_write_file", cut)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, learner=learner, extra={})
    assert latest_checkpoint(tmp_path) == older
    assert load_checkpoint(tmp_path, learner=make_learner())["updates"] == 0
    monkeypatch.undo()
    newer = save_checkpoint(tmp_path, learner=learner, extra={})
    assert latest_checkpoint(tmp_path) == newer
    assert not list(tmp_path.glob(".partial*"))


def test_a_replacement_cut_between_its_renames_is_undone(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, learner=make_learner(), extra={"run": 1})
    rename = checkpoint.os.rename

    def cut(source, destination):
        if destination.name == "000000000":
            raise KeyboardInterrupt
        rename(source, destination)

    monkeypatch.setattr(checkpoint.os, "rename", cut)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(tmp_path, learner=make_learner(), extra={"run": 2})
    monkeypatch.undo()
    path = latest_checkpoint(tmp_path)
    assert load_checkpoint(path, learner=make_learner())["extra"] == {"run": 1}


def one_line(error):
    assert "\n" not in str(error.value)


def test_another_network_is_refused_by_name(tmp_path):
    save_checkpoint(tmp_path, learner=make_learner(), extra={})
    wider = NetworkConfig(width=32, heads=2, latents=2, mlp_width=32, mlp_layers=2)
    with pytest.raises(CheckpointError, match="width 16 there, 32 here") as error:
        load_checkpoint(tmp_path, learner=make_learner(wider))
    one_line(error)


def test_a_truncated_file_is_refused(tmp_path):
    path = save_checkpoint(tmp_path, learner=make_learner(), extra={})
    os.truncate(path / "learner.pt", 1000)
    with pytest.raises(
        CheckpointError, match=r"learner.pt: 1000 of \d+ bytes"
    ) as error:
        load_checkpoint(tmp_path, learner=make_learner())
    one_line(error)


def test_a_changed_file_is_refused(tmp_path):
    path = save_checkpoint(tmp_path, learner=make_learner(), extra={})
    data = bytearray((path / "learner.pt").read_bytes())
    data[len(data) // 2] ^= 1
    (path / "learner.pt").write_bytes(data)
    with pytest.raises(CheckpointError, match="SHA-256"):
        load_checkpoint(tmp_path, learner=make_learner())


@pytest.mark.parametrize(
    ("name", "match"), [("learner.pt", "learner.pt"), ("meta.json", "no checkpoint")]
)
def test_a_missing_file_is_refused(tmp_path, name, match):
    path = save_checkpoint(tmp_path, learner=make_learner(), extra={})
    (path / name).unlink()
    with pytest.raises(CheckpointError, match=match) as error:
        load_checkpoint(tmp_path, learner=make_learner())
    one_line(error)


def test_no_checkpoint_and_other_formats_are_refused(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint here"):
        load_checkpoint(tmp_path / "nothing", learner=make_learner())
    path = save_checkpoint(tmp_path, learner=make_learner(), extra={})
    (path / "meta.json").write_text('{"format": 99}')
    with pytest.raises(CheckpointError, match="format 99, this version reads 1"):
        load_checkpoint(path, learner=make_learner())
    (path / "meta.json").write_text("{")
    with pytest.raises(CheckpointError, match="cannot be read as JSON"):
        load_checkpoint(path, learner=make_learner())
    (tmp_path / "latest").write_text("../elsewhere")
    with pytest.raises(CheckpointError, match="names no checkpoint here"):
        latest_checkpoint(tmp_path)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(CheckpointError, match="cannot write the checkpoint") as error:
        save_checkpoint(tmp_path / "file", learner=make_learner(), extra={})
    one_line(error)


def test_saving_does_not_disturb_training(tmp_path):
    batches = make_batches(4)
    plain, saved = make_learner(), make_learner()
    for batch in itertools.islice(batches, 4):
        saved.update(batch)
        save_checkpoint(tmp_path, learner=saved, extra={})
        plain.update(batch)
    np.testing.assert_array_equal(plain.vector(), saved.vector())
