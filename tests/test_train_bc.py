"""`slipstream train bc`: presets, spaces, a run and its resumption."""

import dataclasses
import json

import numpy as np
import pytest

from actors.policy import find_policy, read_policy
from launch.config import (
    CLONING_PRESETS,
    BudgetConfig,
    ReportConfig,
    ScenesConfig,
    decode_run,
    paper_cloning,
    with_space,
)
from launch.main import main
from launch.train import TrainConfig, prepare
from launch.train_bc import COLUMNS, train_bc
from learner.curves import read_curves
from sim.dynamics import ActionSpace


def test_the_papers_constants():
    """Appendix A.2."""
    config = paper_cloning()
    cloning = config.cloning
    assert (cloning.mixture, cloning.learning_rate, cloning.batch_size) == (
        10,
        1e-4,
        256,
    )
    assert (config.network.mlp_layers, config.network.mlp_width) == (4, 128)
    assert cloning.max_gradient_norm == cloning.average_updates == 0


@pytest.mark.parametrize(
    ("space", "grid", "mixture"),
    [
        ("bicycle", ActionSpace.BICYCLE, 10),
        ("delta", ActionSpace.DELTA, 10),
        ("bicycle-discrete", ActionSpace.BICYCLE, 0),
        ("delta-discrete", ActionSpace.DELTA, 0),
    ],
)
def test_a_space_sets_the_grid_and_the_mixture(space, grid, mixture):
    for preset in CLONING_PRESETS.values():
        config = with_space(preset(), space)
        assert config.environment.action.space == grid
        assert config.cloning.mixture == mixture
        assert with_space(with_space(preset(), "delta-discrete"), space) == config


def test_an_unknown_preset_is_refused(capsys):
    assert main(["train", "bc", "--preset", "none"]) == 2
    assert "choose one of quick, laptop, paper" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_goes_on_where_it_ended(tmp_path):
    config = with_space(CLONING_PRESETS["quick"](), "delta")
    config = dataclasses.replace(
        config,
        network=dataclasses.replace(config.network, width=16, mlp_width=16),
        scenes=ScenesConfig(train=3, held_out=2),
        budget=BudgetConfig(updates=20),
        report=ReportConfig(tensorboard=False, curves_s=0.01),
    )
    options = TrainConfig(run=tmp_path / "run", config=config)
    folder, run = prepare(options)
    assert decode_run((folder / "config.json").read_bytes(), where="x") == run
    train_bc(folder, run, everyone=True)
    first = read_policy(folder)
    assert find_policy(folder).parent.parent == folder / "best"
    assert (first.mixture, first.actions) == (10, 70)
    longer = dataclasses.replace(config, budget=BudgetConfig(updates=60))
    _, run = prepare(dataclasses.replace(options, resume=True, config=longer))
    train_bc(folder, run, everyone=True)
    curves = read_curves(folder / "curves.csv")
    assert set(COLUMNS) <= set(curves)
    assert (np.diff(curves["updates"]) >= 0).all()
    assert curves["updates"][-1] == 60
    known = curves["log_likelihood"][np.isfinite(curves["log_likelihood"])]
    assert known[-1] > known[0]
    kept = json.loads((find_policy(folder).parent / "meta.json").read_text())
    assert kept["extra"]["log_likelihood"] == pytest.approx(known.max())
