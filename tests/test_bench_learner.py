"""The benchmark's contestants compute what ours computes, and its figures add up."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import torch

from actors.network import NetworkConfig
from launch import bench_learner
from launch.bench_learner import bc_turns, dqn_turns, measured
from launch.bench_learner_peers import mixture_density
from launch.config import quick
from launch.main import main
from learner.mixture import mixture_log_prob, split_mixture

TINY = dataclasses.replace(
    quick(), network=NetworkConfig(width=16, heads=2, latents=2, mlp_layers=1)
)


def test_the_plain_mixture_is_ours():
    generator = torch.Generator().manual_seed(0)
    outputs = torch.randn(64, 10 * 5, generator=generator)
    action = torch.rand(64, 2, generator=generator) * 1.8 - 0.9
    ours = mixture_log_prob(split_mixture(outputs, 2), action)
    theirs = mixture_density(outputs, 10, 2).log_prob(action)
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-3)


def test_the_plain_loops_start_from_our_loss():
    turns = bc_turns(TINY, 1)
    assert turns["peer"]() == pytest.approx(turns["float32"]().loss, rel=1e-4)
    turns = dqn_turns(TINY, 1)
    ours, (squared, _) = turns["float32"](), turns["peer"]()
    np.testing.assert_allclose(ours.priorities, squared[:, 0] ** 0.5, atol=1e-3)


def test_rates_ratios_and_shares():
    ticks = itertools.count()
    now = [0.0]

    def takes(seconds):
        def turn():
            next(ticks)
            now[0] += seconds

        return turn

    costs = {"float32": 0.2, "float32 network": 0.15, "peer": 0.4}
    costs |= {"bfloat16": 0.1, "bfloat16 network": 0.1}
    turns = {name: takes(cost) for name, cost in costs.items()}
    row = measured(turns, repetitions=3, clock=lambda: now[0])
    assert row["peer_updates_per_s"] == pytest.approx(2.5)
    assert row["float32"]["ratio"] == pytest.approx(2.0)
    assert row["float32"]["other_share"] == pytest.approx(0.25)
    assert row["bfloat16"]["ratios"] == pytest.approx([4.0] * 3)


def test_the_command_writes_what_it_prints(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_learner, "CLONING_PRESETS", {"quick": lambda: TINY})
    monkeypatch.setattr(bench_learner, "SAMPLE_S", 1e-3)
    file = tmp_path / "learner.json"
    words = ["bench", "learner", "--presets", "quick", "--threads", "1"]
    words += ["--repetitions", "1", "--json", str(file), "--plot", str(tmp_path)]
    assert main(words) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["algorithm"] for row in rows] == ["dqn", "bc"]
    assert all(row["float32"]["ratio"] > 0 for row in rows)
    assert (tmp_path / "learner.png").stat().st_size > 1000


def test_no_repetition_is_refused(capsys):
    assert main(["bench", "learner", "--repetitions", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
