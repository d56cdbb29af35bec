"""Networks in torch and JAX with the same random weights, and observations for them."""

import jax
import jax.numpy as jnp
import numpy as np
import torch

from actors.network import NetworkConfig, batched
from learner.network import QNetwork, to_torch
from sim.observation import Observation, ObservationSizes

SIZES = ObservationSizes(
    ego=22, neighbours=5, agent=26, rows=6, road=4, lights=2, light=3
)
ACTIONS = 11
CONFIGS = {
    "quick": NetworkConfig(),
    "deep": NetworkConfig(
        width=48, heads=3, latents=8, cross_layers=2, self_layers=2, feedforward=4
    ),
    "smallest": NetworkConfig(
        width=4, heads=1, latents=1, feedforward=1, mlp_width=8, mlp_layers=0
    ),
}

SMALL = {"width": 16, "heads": 2, "latents": 3, "mlp_width": 16, "mlp_layers": 1}
FUSIONS = {
    "positions": NetworkConfig(positions=True, dueling=True, **SMALL),
    "multi-axis": NetworkConfig(token_layers=2, time_axis=True, **SMALL),
    "sequential": NetworkConfig(
        token_layers=2, time_axis=True, attention="sequential", positions=True, **SMALL
    ),
    "late latents": NetworkConfig(fusion="late", self_layers=1, **SMALL),
    "late interleaved": NetworkConfig(
        fusion="late",
        token_layers=2,
        time_axis=True,
        attention="interleaved",
        self_layers=1,
        **SMALL,
    ),
    "hierarchical": NetworkConfig(
        fusion="hierarchical", token_layers=1, cross_layers=2, positions=True, **SMALL
    ),
    "hierarchical sequential": NetworkConfig(
        fusion="hierarchical",
        token_layers=2,
        time_axis=True,
        attention="sequential",
        **SMALL,
    ),
}


def make_network(config, seed=0, perturb=0.1):
    generator = torch.Generator().manual_seed(seed)
    network = QNetwork(config=config, sizes=SIZES, actions=ACTIONS, generator=generator)
    with torch.no_grad():
        for value in network.parameters():
            # Zero biases and unit scales would hide parameters that are swapped.
            value.add_(torch.randn(value.shape, generator=generator) * perturb)
    return network


def make_observations(batch, *, seed=0, share=0.7):
    """Random features; each mask is True with probability `share`."""
    rng = np.random.default_rng(seed)

    def features(*shape):
        return rng.standard_normal((batch, *shape)).astype(np.float32)

    def mask(count):
        return rng.random((batch, count)) < share

    return Observation(
        ego=features(SIZES.ego),
        agents=features(SIZES.neighbours, SIZES.agent),
        agents_valid=mask(SIZES.neighbours),
        road=features(SIZES.rows, SIZES.road),
        road_valid=mask(SIZES.rows),
        lights=features(SIZES.lights, SIZES.light),
        lights_valid=mask(SIZES.lights),
    )


def run_torch(network, observations):
    with torch.no_grad():
        return network(*to_torch(observations, torch.device("cpu"))).numpy()


run_batch = jax.jit(batched, static_argnames=("config", "sizes", "actions"))


def run_jax(vector, observations, config):
    return np.asarray(
        run_batch(
            jnp.asarray(vector),
            jax.tree.map(jnp.asarray, observations),
            config=config,
            sizes=SIZES,
            actions=ACTIONS,
        )
    )
