"""Fusion, attention, time axis, positions and dueling: twins, padding, definitions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from actors.network import (
    NetworkConfig,
    laptop_network,
    paper_network,
    parameter_count,
    parameter_layout,
    quick_network,
)
from actors.network_tokens import EGO_NOW, EGO_POSE, layer_axes
from learner.network import to_torch, to_vector, torch_layout
from learner.network_tokens import split_over_time
from sim import environment
from sim.environment import EnvironmentConfig
from sim.observation import Observation, ObservationConfig, observation_sizes
from sim.procedural import generate_many
from tests import scenes
from tests.networks import (
    ACTIONS,
    FUSIONS,
    SIZES,
    make_network,
    make_observations,
    run_jax,
    run_torch,
)

TIMES, STEP, FIXED = 3, 7, 5  # states of an agent, features of each, features once
# Every option in the fast ones; the others combine them.
SLOW = {"multi-axis", "late interleaved", "hierarchical sequential"}
NAMES = [
    pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else [])
    for name in FUSIONS
]


@pytest.mark.parametrize("name", NAMES)
def test_twin_equals_torch(name):
    config = FUSIONS[name]
    network = make_network(config, seed=1)
    vector = to_vector(network)
    assert parameter_layout(config, SIZES, ACTIONS) == torch_layout(network)
    # The other batches of `test_network_parity` for one: each is a compilation.
    for batch in (1, 7, 64) if name == "sequential" else (7,):
        for share in (0.7, 0.0):
            observations = make_observations(batch, seed=batch, share=share)
            expected = run_torch(network, observations)
            actual = run_jax(vector, observations, config)
            np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-5)
            assert np.ptp(expected, axis=1).min() > 1e-3


def soiled(observations: Observation, *, times: bool) -> Observation:
    """Other features under every False mask; NaN-free, as a mask multiplies by 0."""
    fields = observations._asdict()
    rng = np.random.default_rng(9)
    for kind in ("agents", "road", "lights"):
        values, valid = fields[kind], fields[f"{kind}_valid"][..., None]
        dirt = 1000 * rng.standard_normal(values.shape).astype(np.float32)
        fields[kind] = np.where(valid, values, dirt)
    if times:
        agents = fields["agents"].copy()
        moving = agents[..., : TIMES * STEP].reshape(*agents.shape[:2], TIMES, STEP)
        absent = moving[..., -1:] <= 0.5
        dirt = np.where(absent, np.float32(-700), moving)
        dirt[..., -1] = moving[..., -1]  # the flag itself is no padding
        agents[..., : TIMES * STEP] = dirt.reshape(*agents.shape[:2], -1)
        fields["agents"] = np.where(
            fields["agents_valid"][..., None], agents, fields["agents"]
        )
    return Observation(**fields)


def without(observations: Observation, *kinds: str) -> Observation:
    """The same with whole modalities masked."""
    masks = {f"{kind}_valid" for kind in kinds}
    return observations._replace(
        **{name: np.zeros_like(getattr(observations, name)) for name in masks}
    )


@pytest.mark.parametrize("name", NAMES)
def test_padding_never_influences_the_output(name):
    config = FUSIONS[name]
    network = make_network(config)
    vector = to_vector(network)
    some = make_observations(7, share=0.5)
    for clean in (
        some,
        without(some, "agents"),
        without(some, "road", "lights"),
        without(some, "agents", "road", "lights"),
    ):
        dirty = soiled(clean, times=config.time_axis)
        np.testing.assert_array_equal(
            run_torch(network, clean), run_torch(network, dirty)
        )
        np.testing.assert_array_equal(
            run_jax(vector, clean, config), run_jax(vector, dirty, config)
        )


@pytest.mark.parametrize("name", NAMES)
def test_every_valid_token_influences_the_output(name):
    """Else the test of padding could not fail."""
    network = make_network(FUSIONS[name])
    clean = make_observations(1, share=1.0)
    cut = TIMES * STEP
    moving = clean.agents[..., :cut].reshape(1, -1, TIMES, STEP).copy()
    moving[..., -1] = 1.0
    clean.agents[..., :cut] = moving.reshape(1, -1, cut)
    before = run_torch(network, clean)
    for kind in ("agents", "road", "lights"):
        for index in range(getattr(clean, kind).shape[1]):
            for feature in (0, STEP, 2 * STEP) if kind == "agents" else (0,):
                changed = getattr(clean, kind).copy()
                changed[:, index, feature] += 3
                after = run_torch(network, clean._replace(**{kind: changed}))
                assert np.abs(after - before).max() > 1e-6, (kind, index, feature)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_every_parameter(name):
    network = make_network(FUSIONS[name])
    observations = to_torch(make_observations(16, share=1.0), torch.device("cpu"))
    torch.autograd.backward(network(*observations).square().sum())
    dead = [n for n, p in network.named_parameters() if not p.grad.abs().sum() > 0]
    if name == "late latents":  # whoever asks a single token needs not compare
        dead = [n for n in dead if not n.startswith(("cross.0.query", "cross.0.key"))]
    assert not dead


def test_modalities_meet_where_the_fusion_says():
    """Early: a token of a modality depends on others; hierarchical: it does not."""
    seen = {}
    for fusion in ("early", "hierarchical"):
        config = dataclasses.replace(
            FUSIONS["hierarchical"], fusion=fusion, positions=False
        )
        network = make_network(config)
        kept = []
        network.token_norm.register_forward_hook(
            lambda _, inputs, output, kept=kept: kept.append(output)
        )
        clean = make_observations(2, share=1.0)
        run_torch(network, clean)
        run_torch(network, clean._replace(road=clean.road + np.float32(1)))
        before, after = kept[: len(kept) // 2], kept[len(kept) // 2 :]
        seen[fusion] = [
            float((a[:, :1] - b[:, :1]).abs().max())
            for a, b in zip(before, after, strict=True)
        ]
    assert seen["early"][0] > 1e-3  # the ego's token, in the one joined group
    assert [change > 1e-3 for change in seen["hierarchical"]] == [
        False,  # ego
        False,  # agents
        True,  # road
        False,  # lights
    ]


def test_factorised_layers_go_over_time_then_space():
    assert layer_axes("sequential", 4) == (0, 0, 1, 1)
    assert layer_axes("interleaved", 4) == (0, 1, 0, 1)
    assert layer_axes("multi-axis", 3) == (1, 1, 1)


def test_a_time_layer_stays_within_a_slot():
    """With time layers alone, an agent's tokens do not see another agent's."""
    config = FUSIONS["hierarchical sequential"]
    network = make_network(config)
    with torch.no_grad():
        for index in range(1, len(network.tokens), 2):  # the space layers add nothing
            network.tokens[index].out.weight.zero_()
            network.tokens[index].out.bias.zero_()
    kept = []
    network.token_norm.register_forward_hook(lambda _, __, out: kept.append(out))
    clean = make_observations(1, share=1.0)
    changed = clean.agents.copy()
    changed[:, 2] += 1
    changed[:, 2, STEP - 1 : TIMES * STEP : STEP] = 1.0  # all its states are there
    run_torch(network, clean)
    run_torch(network, clean._replace(agents=changed))
    difference = (kept[1] - kept[5]).abs().amax(-1).view(TIMES, SIZES.neighbours)
    assert (difference[:, 2] > 1e-3).all()
    assert (difference[:, [0, 1, 3, 4]] == 0).all()


def test_positions_start_at_zero_and_break_the_symmetry():
    config = FUSIONS["positions"]
    network = make_network(config, perturb=0.0)
    assert (network.positions == 0).all()
    assert network.positions.shape[0] == 1 + SIZES.neighbours + SIZES.rows + 2
    clean = make_observations(2, share=1.0)
    swapped = clean._replace(road=clean.road[:, ::-1].copy())
    np.testing.assert_allclose(
        run_torch(network, clean), run_torch(network, swapped), atol=1e-6
    )
    with torch.no_grad():
        network.positions.normal_(generator=torch.Generator().manual_seed(0))
    before, after = run_torch(network, clean), run_torch(network, swapped)
    assert np.abs(before - after).max() > 1e-4


def test_dueling_is_value_plus_centred_advantage():
    config = FUSIONS["positions"]
    network = make_network(config)
    observations = make_observations(5)
    kept = {}
    for name in ("head", "value"):
        getattr(network, name).register_forward_hook(
            lambda _, __, out, name=name: kept.update({name: out.numpy()})
        )
    values = run_torch(network, observations)
    # Wang et al., 2016, eq. 9: the mean over the actions is the state's value.
    np.testing.assert_allclose(values.mean(1), kept["value"][:, 0], atol=1e-5)
    np.testing.assert_allclose(
        values - values.mean(1, keepdims=True),
        kept["head"] - kept["head"].mean(1, keepdims=True),
        atol=1e-5,
    )


def test_the_time_axis_cuts_an_observation_where_its_features_end(tmp_path):
    """Oracle: the features of a rendered observation, by name."""
    config = EnvironmentConfig()
    bank = scenes.bank_of(list(generate_many(2, 1)), tmp_path).bank

    @jax.jit
    def first(bank):
        state = environment.reset(bank, jnp.int32(0), bank.sdc[0][None], config)
        return environment.observe_state(bank, state, config)

    look = jax.tree.map(np.asarray, first(bank))
    ego, agents, valid, *_ = to_torch(look, torch.device("cpu"))
    own, others = split_over_time(ego, agents, valid, TIMES)
    assert own.features.shape == (1, TIMES, 1, EGO_NOW + EGO_POSE + 5 + 16)
    now = own.features[0, -1, 0]
    # The current pose is the origin, at the current speed.
    np.testing.assert_array_equal(now[EGO_NOW : EGO_NOW + EGO_POSE - 1], np.zeros(3))
    assert now[EGO_NOW + EGO_POSE - 1] == now[0] == ego[0, 0]
    past = own.features[0, :, 0, EGO_NOW]
    assert past[0] < past[1] < 0  # it drives: its past lies behind it
    assert others.features.shape == (1, TIMES, 16, STEP + FIXED)
    there = others.features[0, ..., STEP - 1] == 1
    np.testing.assert_array_equal(there & valid[0], others.valid[0])
    size = others.features[0, -1, :, STEP : STEP + 2]
    np.testing.assert_array_equal(size, agents[0, :, -FIXED : 2 - FIXED])


def test_presets_have_the_sizes_that_the_table_says():
    """docs/design.md lists them."""
    sizes = {
        "quick": ObservationConfig(neighbours=8, road_rows=32, lights=2),
        "laptop": ObservationConfig(),
        "paper": ObservationConfig(),
    }
    counts = {
        name: parameter_count(
            parameter_layout(config, observation_sizes(sizes[name]), 91)
        )
        for name, config in (
            ("quick", quick_network()),
            ("laptop", laptop_network()),
            ("paper", paper_network()),
        )
    }
    assert quick_network() == NetworkConfig()
    assert counts == {"quick": 128_987, "laptop": 261_787, "paper": 921_435}


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"fusion": "hierarchical"}, "token_layers=0 is early fusion"),
        ({"attention": "sequential", "token_layers": 2}, "needs time_axis"),
        (
            {"attention": "interleaved", "token_layers": 3, "time_axis": True},
            "even token_layers, not 3",
        ),
        ({"token_layers": -1}, "token_layers=-1"),
    ],
)
def test_options_that_contradict_each_other_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        NetworkConfig(**fields)


def test_a_time_axis_needs_whole_states():
    odd = SIZES._replace(agent=20)
    with pytest.raises(ValueError, match="not those of whole states"):
        parameter_layout(NetworkConfig(time_axis=True), odd, ACTIONS)


@pytest.mark.parametrize("name", ["sequential", "late latents"])
def test_bfloat16_on_the_cpu_attends_alike(name):
    """Its attention, with and without a mask, is float32's within rounding."""
    network, observations = make_network(FUSIONS[name]), make_observations(7)
    exact = run_torch(network, observations)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        outputs = network(*to_torch(observations, torch.device("cpu")))
    assert outputs.dtype == torch.bfloat16
    fast = outputs.float().numpy()
    assert 0 < np.abs(fast - exact).max() < 0.05 * np.abs(exact).max()
