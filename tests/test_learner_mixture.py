"""The squashed mixture against hand-worked numbers, float64, torch and torchrl."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import distributions
from torchrl.modules import TanhNormal

from actors import mixture as twin
from learner.mixture import (
    Mixture,
    mixture_log_prob,
    shifted,
    softmax_log_prob,
    split_mixture,
)
from sim.dynamics import ActionConfig, ActionSpace


def test_log_prob_by_hand():
    """One component, standard normal: at a = 0, N(0) / (1 - 0) per component."""
    one = Mixture(torch.zeros(2, 1), torch.zeros(2, 1, 2), torch.ones(2, 1, 2))
    actual = mixture_log_prob(
        one, torch.tensor([[0.0, 0.0], [float(np.tanh(1.0)), 0.0]])
    )
    # -log(2 pi) = -1.837877; at u = 1: -1/2 - log(1 - tanh(1)^2) = -0.5 + 0.867562.
    expected = torch.tensor([-1.837877, -1.837877 - 0.5 + 0.867562])
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=0)


def test_two_components_by_hand():
    """0.25 N(0; 0, 1) + 0.75 N(0; 1, 0.5) = 0.25 0.398942 + 0.75 0.107982."""
    two = Mixture(
        torch.tensor([[0.25, 0.75]]).log(),
        torch.tensor([[[0.0], [1.0]]]),
        torch.tensor([[[1.0], [0.5]]]),
    )
    actual = mixture_log_prob(two, torch.zeros(1, 1)).exp()
    torch.testing.assert_close(actual, torch.tensor([0.180722]), atol=1e-6, rtol=0)


def test_softmax_by_hand():
    logits = torch.tensor([[1.0, 2.0, 3.0]]).log()
    actual = softmax_log_prob(logits, torch.tensor([2]))
    torch.testing.assert_close(actual, torch.tensor([0.5]).log())


def random_mixture(batch=16, mixture=10, components=3, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    outputs = torch.randn(
        batch, mixture * (1 + 2 * components), generator=generator, dtype=dtype
    )
    actions = 2 * torch.rand(batch, components, generator=generator, dtype=dtype) - 1
    return outputs, actions


def test_equals_torch_distributions_and_torchrl():
    outputs, actions = random_mixture()
    mixture = split_mixture(outputs, 3)
    weights = distributions.Categorical(logits=mixture.log_weights)
    squashed = distributions.TransformedDistribution(
        distributions.Normal(mixture.means, mixture.scales),
        distributions.TanhTransform(),
    )
    theirs = distributions.MixtureSameFamily(
        weights, distributions.Independent(squashed, 1)
    )
    actual = mixture_log_prob(mixture, actions)
    torch.testing.assert_close(actual, theirs.log_prob(actions), atol=1e-6, rtol=0)
    # torchrl has the components; their mixture is the definition's sum.
    each = TanhNormal(mixture.means, mixture.scales, event_dims=1)
    many = actions[:, None].expand(-1, mixture.means.shape[1], -1)
    summed = torch.logsumexp(mixture.log_weights + each.log_prob(many), -1)
    torch.testing.assert_close(actual, summed, atol=1e-6, rtol=0)


def by_definition(outputs, actions, components):
    """Oracle in float64: weights, normal densities and the tanh's derivative."""
    count = len(outputs) // (1 + 2 * components)
    logits, rest = outputs[:count], outputs[count:].reshape(2, count, components)
    scales = twin.SMALLEST + np.logaddexp(0, rest[1])
    z = (np.arctanh(actions) - rest[0]) / scales
    each = -(z**2) / 2 - np.log(scales) - np.log(2 * np.pi) / 2
    total = np.logaddexp.reduce(logits + each.sum(1)) - np.logaddexp.reduce(logits)
    return total - np.log((1 - actions) * (1 + actions)).sum()


near_one = st.floats(1e-6, 0.5).map(lambda gap: 1 - gap)
sizes = st.one_of(st.floats(0, 1), near_one)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(sizes, min_size=2, max_size=2),
    st.integers(0, 3),
    st.integers(0, 2**31),
)
def test_float32_is_stable_up_to_the_ends(values, signs, seed):
    signs = np.array([1 - 2 * (signs & 1), 1 - (signs & 2)], np.float32)
    action = np.array(values, np.float32) * signs
    rng = np.random.default_rng(seed)
    outputs = (3 * rng.standard_normal(50)).astype(np.float32)
    tensor = torch.from_numpy(outputs)[None].requires_grad_()
    actual = mixture_log_prob(split_mixture(tensor, 2), torch.from_numpy(action)[None])
    torch.autograd.backward(actual.sum())
    assert tensor.grad.isfinite().all()
    cut = np.clip(action, -np.float32(twin.LARGEST), np.float32(twin.LARGEST))
    expected = by_definition(outputs.astype(np.float64), cut.astype(np.float64), 2)
    np.testing.assert_allclose(actual.item(), expected, rtol=2e-5, atol=2e-4)


def test_beyond_the_ends_is_at_the_ends():
    outputs, _ = random_mixture(batch=3, dtype=torch.float32)
    mixture = split_mixture(outputs, 3)
    ends = [mixture_log_prob(mixture, torch.full((3, 3), a)) for a in (1.0, 5.0)]
    torch.testing.assert_close(*ends, rtol=0, atol=0)
    assert ends[0].isfinite().all()


def test_the_density_integrates_to_one():
    outputs, _ = random_mixture(batch=1, components=1)
    grid = torch.linspace(-1, 1, 200_001, dtype=torch.float64)[1:-1, None]
    mixture = Mixture(
        *(x.expand(len(grid), *x.shape[1:]) for x in split_mixture(outputs, 1))
    )
    area = mixture_log_prob(mixture, grid).exp().sum() * 1e-5
    assert area == pytest.approx(1.0, abs=1e-3)


def test_twin_equals_torch():
    outputs, actions = random_mixture(dtype=torch.float32)
    expected = mixture_log_prob(split_mixture(outputs, 3), actions)

    @jax.jit
    def one(outputs, action):
        return twin.log_prob(twin.split_mixture(outputs, 3), action)

    actual = jax.vmap(one)(jnp.asarray(outputs.numpy()), jnp.asarray(actions.numpy()))
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


def three(weights, means, scales):
    return twin.Mixture(
        jnp.log(jnp.array(weights)), jnp.array(means), jnp.array(scales)
    )


def test_mode_is_the_likeliest_mean():
    """The lighter component is the sharper: 0.4 / 0.1 > 0.6 / 0.5 at the means."""
    mixture = three([0.6, 0.4], [[-1.0], [1.0]], [[0.5], [0.1]])
    np.testing.assert_allclose(twin.mode(mixture), [np.tanh(1.0)], rtol=1e-6)


def test_mean_and_samples_agree():
    mixture = three([0.3, 0.7], [[-1.0, 0.2], [0.5, 2.0]], [[0.3, 1.0], [0.8, 0.1]])
    keys = jax.random.split(jax.random.key(0), 20_000)
    draws = np.asarray(jax.jit(jax.vmap(twin.sample, in_axes=(0, None)))(keys, mixture))
    assert np.abs(draws).max() < 1
    deviation = draws.std(0) / np.sqrt(len(draws))
    expected = np.asarray(twin.mean(mixture))
    assert (np.abs(draws.mean(0) - expected) < 4 * deviation).all()
    # Of the first component of the action, 0.3 lies around tanh(-1).
    assert np.mean(draws[:, 0] < -0.5) == pytest.approx(0.3 + 0.7 * 0.095, abs=0.02)


def test_outputs_and_limits_of_the_spaces():
    bicycle = ActionConfig()
    delta = ActionConfig(space=ActionSpace.DELTA)
    assert twin.policy_outputs(bicycle, 0) == 91
    assert twin.policy_outputs(bicycle, 10) == 50
    assert twin.policy_outputs(delta, 10) == 70
    np.testing.assert_allclose(twin.action_limits(bicycle), [6.0, 0.3])
    np.testing.assert_allclose(twin.action_limits(delta), [3.0, 0.2, 0.2])
    steering = ActionConfig(space=ActionSpace.STEERING)
    np.testing.assert_allclose(twin.action_limits(steering), [6.0, 9.0])


def test_an_untrained_delta_mixture_goes_on_as_before():
    """One sharp component at 0: the action is v dt ahead, and the same in torch."""
    config = ActionConfig(space=ActionSpace.DELTA)
    outputs = torch.tensor([[0.0, 0.0, 0.0, 0.0, -20.0, -20.0, -20.0]])
    limits = twin.action_limits(config)
    for speed in (0.0, 0.3, 12.0, 29.0):
        going_on = twin.inertia(jnp.float32(speed), config, 0.1)
        split = twin.shifted(twin.split_mixture(jnp.array(outputs[0]), 3), going_on)
        for choose in (twin.mode, twin.mean):
            expected = [0.1 * speed, 0.0, 0.0]
            np.testing.assert_allclose(choose(split) * limits, expected, atol=1e-3)
        theirs = shifted(split_mixture(outputs, 3), torch.tensor([speed]), config, 0.1)
        np.testing.assert_allclose(theirs.means[0], split.means, atol=1e-5)
    beyond = [twin.inertia(jnp.float32(v), config, 0.1)[0] for v in (29.9, 80.0)]
    assert beyond[0] == beyond[1] < 3.0


def test_accelerations_are_relative_to_none():
    mixture = split_mixture(random_mixture(components=2)[0], 2)
    assert shifted(mixture, torch.ones(16), ActionConfig(), 0.1) is mixture
    assert not twin.inertia(jnp.float32(5.0), ActionConfig(), 0.1).any()
