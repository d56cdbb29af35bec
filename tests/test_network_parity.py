"""The JAX twin equals the torch network, and both equal their definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from actors.network import (
    NetworkConfig,
    layout_hash,
    parameter_count,
    parameter_layout,
    q_values,
    unpack,
)
from learner.network import load_vector, to_torch, to_vector, torch_layout
from sim.observation import Observation
from tests.networks import (
    ACTIONS,
    CONFIGS,
    SIZES,
    make_network,
    make_observations,
    run_jax,
    run_torch,
)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("batch", [1, 7, 64])
@pytest.mark.parametrize("share", [0.7, 0.0])
def test_twin_equals_torch(name, batch, share):
    network = make_network(CONFIGS[name], seed=batch)
    observations = make_observations(batch, seed=batch, share=share)
    expected = run_torch(network, observations)
    actual = run_jax(to_vector(network), observations, CONFIGS[name])
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5)
    ordered = np.sort(expected, axis=1)
    clear = ordered[:, -1] - ordered[:, -2] > 1e-4
    assert clear.any()
    agree = actual.argmax(axis=1) == expected.argmax(axis=1)
    assert agree[clear].all()


@pytest.mark.parametrize("name", CONFIGS)
def test_layout_is_the_state_dict(name):
    network = make_network(CONFIGS[name])
    layout = parameter_layout(CONFIGS[name], SIZES, ACTIONS)
    assert layout == torch_layout(network)
    assert parameter_count(layout) == sum(p.numel() for p in network.parameters())
    weights = unpack(jnp.asarray(to_vector(network)), layout)
    for key, value in network.state_dict().items():
        np.testing.assert_array_equal(weights[key], value.numpy())


def test_layout_hash_tells_networks_apart():
    def of(config, actions=ACTIONS):
        return layout_hash(parameter_layout(config, SIZES, actions))

    hashes = [of(config) for config in CONFIGS.values()]
    assert len({*hashes, of(NetworkConfig(), actions=12)}) == 4
    assert of(NetworkConfig()) == hashes[0]


def test_a_vector_goes_there_and_back():
    network = make_network(CONFIGS["deep"])
    other = make_network(CONFIGS["deep"], seed=1)
    load_vector(other, to_vector(network))
    observations = make_observations(3)
    np.testing.assert_array_equal(
        run_torch(network, observations), run_torch(other, observations)
    )


def test_a_vector_of_another_length_is_refused():
    config = CONFIGS["quick"]
    layout = parameter_layout(config, SIZES, ACTIONS)
    with pytest.raises(ValueError, match="this network has"):
        unpack(jnp.zeros(parameter_count(layout) + 1), layout)
    with pytest.raises(ValueError, match="this network has"):
        load_vector(make_network(config), np.zeros(3, np.float32))


def test_same_seed_same_first_weights():
    first, second, other = (
        to_vector(make_network(CONFIGS["quick"], seed=seed, perturb=0.0))
        for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()


@pytest.mark.parametrize("name", CONFIGS)
def test_padding_never_influences_the_output(name):
    network = make_network(CONFIGS[name])
    clean = make_observations(7, share=0.5)
    fields = clean._asdict()
    for kind in ("agents", "road", "lights"):
        valid = fields[f"{kind}_valid"][..., None]
        fields[kind] = np.where(valid, fields[kind], np.float32(1000))
    dirty = Observation(**fields)
    vector = to_vector(network)
    np.testing.assert_array_equal(run_torch(network, clean), run_torch(network, dirty))
    np.testing.assert_array_equal(
        run_jax(vector, clean, CONFIGS[name]), run_jax(vector, dirty, CONFIGS[name])
    )


def test_every_valid_token_influences_the_output():
    """Else the test of padding could not fail."""
    network = make_network(CONFIGS["quick"])
    clean = make_observations(1, share=1.0)
    before = run_torch(network, clean)
    for kind in ("agents", "road", "lights"):
        for index in range(getattr(clean, kind).shape[1]):
            changed = getattr(clean, kind).copy()
            changed[:, index] += 1
            after = run_torch(network, clean._replace(**{kind: changed}))
            assert np.abs(after - before).max() > 1e-5


def test_tokens_are_a_set():
    network = make_network(CONFIGS["quick"])
    clean = make_observations(3, share=0.6)
    order = np.random.default_rng(0).permutation(SIZES.rows)
    shuffled = clean._replace(
        road=clean.road[:, order].copy(), road_valid=clean.road_valid[:, order].copy()
    )
    np.testing.assert_allclose(
        run_torch(network, clean), run_torch(network, shuffled), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("count", [8, 9])  # folded into the queries; formed
@pytest.mark.parametrize("gradients", [True, False])
def test_cross_attention_is_multi_head_attention(count, gradients):
    """Oracle: the textbook order, with keys and values of every token."""
    config = CONFIGS["deep"]
    block = make_network(config).cross[0].requires_grad_(gradients)
    latents, tokens = torch.randn(3, count, 48), torch.randn(3, 14, 48)
    valid = torch.rand(3, 1, 14) < 0.6
    valid[:, :, 0] = True
    query = block.query(block.query_norm(latents))
    q, k, v = (
        x.view(3, -1, config.heads, 16).transpose(1, 2)
        for x in (query, block.key(tokens), block.value(tokens))
    )
    y = torch.nn.functional.scaled_dot_product_attention(
        q, k, v, attn_mask=valid[:, None]
    )
    y = latents + block.out(y.transpose(1, 2).reshape(3, count, 48))
    hidden = block.expand(block.feedforward_norm(y))
    expected = y + block.contract(torch.nn.functional.gelu(hidden, approximate="tanh"))
    bias = torch.where(valid, 0.0, -1e9)
    with torch.set_grad_enabled(gradients):
        actual = block(latents, tokens, bias)
        pooled = block(latents, tokens, bias, pooled=True)
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(pooled, expected.mean(1), rtol=0, atol=1e-5)


def test_gradients_reach_every_parameter():
    network = make_network(CONFIGS["deep"])
    observations = to_torch(make_observations(4, share=1.0), torch.device("cpu"))
    torch.autograd.backward(network(*observations).square().sum())
    dead = [n for n, p in network.named_parameters() if not p.grad.abs().sum() > 0]
    assert not dead


def test_twin_compiles_once():
    config = CONFIGS["quick"]
    vector = jnp.asarray(to_vector(make_network(config)))

    @jax.jit
    def act(vector, observation):
        return q_values(
            vector, observation, config=config, sizes=SIZES, actions=ACTIONS
        )

    for seed in (0, 1):
        observation = jax.tree.map(lambda x: jnp.asarray(x[0]), make_observations(1))
        assert act(vector * (1.0 + seed), observation).shape == (ACTIONS,)
    assert act._cache_size() == 1


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"heads": 5}, "heads=5 must divide width=64"),
        ({"latents": 0}, "latents=0 must be at least 1"),
        ({"self_layers": -1}, "self_layers=-1"),
    ],
)
def test_sizes_that_make_no_network_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        NetworkConfig(**fields)
