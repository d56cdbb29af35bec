"""The cloning learner: its loss by hand, what it learns, that it goes on exactly."""

import io

import numpy as np
import pytest
import torch

from actors.mixture import FIRST_SCALE
from actors.network import NetworkConfig, layout_hash
from actors.policy import read_policy
from learner.checkpoint import load_checkpoint, save_checkpoint
from learner.cloning import (
    CloningBatch,
    CloningLearner,
    clone,
)
from learner.config import CloningConfig
from learner.mixture import split_mixture
from learner.network import torch_layout
from sim.dynamics import ActionConfig, ActionSpace
from tests.networks import SIZES, make_observations

NETWORK = NetworkConfig(width=16, heads=2, latents=2, mlp_width=32, mlp_layers=2)
BICYCLE = ActionConfig(acceleration_bins=3, curvature_bins=3)
DELTA = ActionConfig(space=ActionSpace.DELTA)


def make_learner(action=BICYCLE, network=NETWORK, **fields):
    config = CloningConfig(**{"learning_rate": 1e-3, **fields})
    return CloningLearner(config=config, network=network, sizes=SIZES, action=action)


def make_batch(seed=0, batch=64):
    """The ego's first features say what the expert did, within the limits' half."""
    rng = np.random.default_rng(seed)
    observations = make_observations(batch, seed=seed)
    cue = np.tanh(observations.ego[:, :2])
    noise = 0.02 * rng.standard_normal((batch, 2))
    continuous = ((0.5 * cue + noise) * [6.0, 0.3]).astype(np.float32)
    index = (3 * (cue[:, 0] > 0) + (cue[:, 1] > 0)).astype(np.int32)
    return CloningBatch(observations, index, continuous)


def test_the_first_loss_is_the_uniform_one():
    """An untrained head is small, so every index has about the same probability."""
    learner = make_learner(mixture=0)
    assert learner.update(make_batch()).loss == pytest.approx(np.log(9), abs=0.02)


def test_the_first_mixture_is_apart():
    learner = make_learner(DELTA)
    mixture = split_mixture(learner.network.head.bias[None].detach(), 3)
    assert mixture.means.shape == (1, 10, 3)
    assert 0.6 < float(mixture.means.std()) < 1.5
    torch.testing.assert_close(mixture.log_weights.exp(), torch.full((1, 10), 0.1))
    assert float(mixture.scales.mean()) == pytest.approx(FIRST_SCALE + 0.005, abs=1e-5)


@pytest.mark.parametrize("mixture", [0, 4])
def test_it_learns_what_the_expert_does(mixture):
    learner = make_learner(mixture=mixture)
    unseen = make_batch(1000)
    before = learner.log_likelihood(unseen).mean()
    for seed in range(150):
        learner.update(make_batch(seed))
    after = learner.log_likelihood(unseen).mean()
    assert after > before + (1.0 if mixture == 0 else 1.5)


def test_actions_are_scaled_by_their_limits():
    """Twice the limits and twice the actions: the same batch."""
    batch = make_batch()
    twice = ActionConfig(
        acceleration=12.0, curvature=0.6, acceleration_bins=3, curvature_bins=3
    )
    doubled = batch._replace(continuous_tm1=2 * batch.continuous_tm1)
    np.testing.assert_allclose(
        make_learner().log_likelihood(batch),
        make_learner(twice).log_likelihood(doubled),
        rtol=1e-5,
    )


def test_the_loss_is_minus_the_mean_log_likelihood():
    learner, batch = make_learner(), make_batch()
    expected = -learner.log_likelihood(batch).mean()
    assert learner.update(batch).loss == pytest.approx(expected, rel=1e-5)


def losses_of(learner, first=0, updates=4):
    return [learner.update(make_batch(first + i)).loss for i in range(updates)]


def test_same_seed_same_losses():
    assert losses_of(make_learner()) == losses_of(make_learner())
    assert losses_of(make_learner()) != losses_of(make_learner(seed=1))


def test_a_restored_learner_goes_on_to_the_same_bits():
    whole, half, other = (make_learner(average_updates=3) for _ in range(3))
    losses = losses_of(whole, updates=8)
    losses_of(half)
    buffer = io.BytesIO()
    torch.save(half.state(), buffer)
    buffer.seek(0)
    other.restore(torch.load(buffer, weights_only=True))
    assert losses_of(other, first=4) == losses[4:]
    np.testing.assert_array_equal(other.vector(), whole.vector())
    np.testing.assert_array_equal(other.policy_vector(), whole.policy_vector())
    assert (whole.policy_vector() != whole.vector()).any()
    with pytest.raises(ValueError, match="not the state of a learner"):
        other.restore({**half.state(), "network": 3})


def test_gradients_are_clipped_only_on_request():
    batch = make_batch()
    assert np.isnan(make_learner().update(batch).gradient_norm)
    assert make_learner(max_gradient_norm=1e-3).update(batch).gradient_norm > 1e-3


def test_a_checkpoint_says_what_its_outputs_are(tmp_path):
    learner = make_learner(mixture=4)
    learner.update(make_batch())
    save_checkpoint(tmp_path, learner=learner, extra={"config": {}})
    policy = read_policy(tmp_path)
    assert (policy.mixture, policy.actions) == (4, 4 * 5)
    np.testing.assert_array_equal(policy.vector, learner.policy_vector())
    other = make_learner(mixture=4, seed=5)
    load_checkpoint(tmp_path, learner=other)
    np.testing.assert_array_equal(other.vector(), learner.vector())
    assert layout_hash(learner.layout) == layout_hash(torch_layout(learner.network))


def test_the_loop_takes_turns():
    learner, drawn = make_learner(), [make_batch(), None, make_batch(1)]
    dtype = [("action", "<i4"), ("continuous", "<f4", (2,))]
    rows = []
    for batch in drawn:
        row = None if batch is None else np.zeros(64, dtype)
        if row is not None:
            row["action"], row["continuous"] = batch.a_tm1, batch.continuous_tm1
        rows.append(row)
    source = iter(rows)
    steps = clone(
        learner=learner,
        sample=lambda: next(source),
        render=lambda rows: make_observations(len(rows)),
    )
    turns = [next(steps) for _ in rows]
    assert [turn is None for turn in turns] == [False, True, False]
    assert learner.updates == 2
    assert turns[2].result.loss != turns[0].result.loss


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"learning_rate": 0.0}, "learning_rate=0.0 must be above 0"),
        ({"mixture": -1}, "mixture=-1 must not be negative"),
    ],
)
def test_settings_that_learn_nothing_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        CloningConfig(**fields)


def test_dueling_is_refused_for_a_mixture():
    dueling = NetworkConfig(width=16, heads=2, dueling=True)
    with pytest.raises(ValueError, match="switch it off"):
        make_learner(network=dueling)
