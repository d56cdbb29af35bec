"""The benchmark's contestants compute what ours computes, and its figures add up."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import torch

from actors.network import NetworkConfig
from launch import bench_learner
from launch.bench_learner import measured, our_turns, peer_turns
from launch.bench_learner_peers import lasted, mixture_density, plain_network
from launch.config import quick
from launch.main import main
from learner.mixture import mixture_log_prob, split_mixture
from tests.networks import make_network, make_observations, run_torch

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


@pytest.mark.parametrize("algorithm", ["dqn", "bc"])
def test_the_plain_loops_start_from_our_loss(algorithm):
    ours = our_turns(TINY, algorithm, 1)["float32"]()
    for turn in peer_turns(TINY, algorithm).values():
        if algorithm == "bc":
            assert turn() == pytest.approx(ours.loss, rel=1e-4)
        else:
            squared, _ = turn()
            np.testing.assert_allclose(ours.priorities, squared[:, 0] ** 0.5, atol=1e-3)


@pytest.mark.parametrize(
    "fields", [{}, {"latents": 9}, {"fusion": "late", "token_layers": 1}]
)
def test_the_plain_network_is_ours(fields):
    network = make_network(NetworkConfig(width=16, heads=2, self_layers=1, **fields))
    observations = make_observations(5, share=0.3)
    expected = run_torch(plain_network(network), observations)
    np.testing.assert_allclose(run_torch(network, observations), expected, atol=1e-5)


def test_rates_ratios_and_shares():
    costs = {"float32": 0.2, "float32 network": 0.15, "plain": 0.4, "plain loop": 0.3}
    costs |= {"bfloat16": 0.1, "bfloat16 network": 0.1}
    runs = {name: lambda times, cost=cost: cost for name, cost in costs.items()}
    row = measured(runs, repetitions=3)
    assert row["plain"]["updates_per_s"] == pytest.approx(2.5)
    assert row["float32"]["over plain"] == pytest.approx(2.0)
    assert row["float32"]["over plain loop"] == pytest.approx(1.5)
    assert row["float32"]["other_share"] == pytest.approx(0.25)
    assert row["bfloat16"]["over plain, each"] == pytest.approx([4.0] * 3)
    assert row["calls"]["bfloat16"] == 3


def test_a_turn_lasts_what_the_clock_says():
    now = itertools.count(step=0.5)
    assert lasted(lambda: next(now), lambda: next(now))(3) == pytest.approx(2.0 / 3)


@pytest.mark.slow
def test_the_command_writes_what_it_prints(tmp_path, monkeypatch):
    monkeypatch.setattr(bench_learner, "CLONING_PRESETS", {"quick": lambda: TINY})
    monkeypatch.setattr(bench_learner, "SAMPLE_S", 1e-3)
    file = tmp_path / "learner.json"
    words = ["bench", "learner", "--presets", "quick", "--threads", "1"]
    words += ["--repetitions", "1", "--json", str(file), "--plot", str(tmp_path)]
    assert main(words) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["algorithm"] for row in rows] == ["dqn", "bc"]
    assert all(row["float32"]["over plain"] > 0 for row in rows)
    assert (tmp_path / "learner.png").stat().st_size > 1000


def test_no_repetition_is_refused(capsys):
    assert main(["bench", "learner", "--repetitions", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
