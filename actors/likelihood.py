"""The held-out log-likelihood of a cloned policy, by the actors' twin of its network.

The mean over the expert's rows of log p(a_tm1 | s_tm1) [nats]: of the softmax over the
grid's actions, or of the mixture over scaled continuous actions (`actors.mixture`).
Observations are rendered once; the parameters are an argument of the one compiled
program, so every checkpoint of a run is judged by it.
"""

import functools
from typing import Final, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from actors import mixture
from actors.cloning import expert_rows, sdc_only
from actors.mixture import (
    action_limits,
    inertia,
    policy_outputs,
    shifted,
    split_mixture,
)
from actors.network import NetworkConfig, batched
from actors.rows import columns_of, render_before
from sim.bank import BankFile
from sim.environment import EnvironmentConfig
from sim.features import SPEED_SCALE
from sim.observation import Observation, observation_sizes

MOST_ROWS: Final = 2048  # drawn once
_BATCH: Final = 256


@final
class HeldOutLikelihood:
    """The recorded actions of the scenes' SDCs, and what these saw."""

    def __init__(
        self,
        file: BankFile,
        *,
        config: EnvironmentConfig,
        network: NetworkConfig,
        components: int,
        seed: int,
    ) -> None:
        """Renders what is seen.

        Args:
            file: scenes that nobody learns from.
            config: the action space and the observation.
            network: the policy's.
            components: of the policy's mixture; 0 is a softmax over the grid.
            seed: of which rows are drawn, where there are more than `MOST_ROWS`.
        """
        rows = expert_rows(file.bank, sdc_only(file.bank), config)
        order = np.random.default_rng(seed).permutation(len(rows))
        rows = rows[order[:MOST_ROWS]]
        size = min(_BATCH, len(rows))
        look = jax.jit(functools.partial(render_before, config=config.observation))
        self._batches = [
            (
                look(file.bank, columns_of(part)),
                jnp.asarray(part["action"]),
                jnp.asarray(part["continuous"] / action_limits(config.action)),
            )
            # Whole batches only: of one shape, for one compilation.
            for first in range(0, len(rows) - size + 1, max(size, 1))
            if len(part := rows[first : first + size])
        ]
        self._log_probs = _log_probs(config, network, components)

    def mean(self, parameters: Float[Array | np.ndarray, " parameters"]) -> float:
        """Over the rows [nats]; NaN where the scenes have none."""
        vector = jnp.asarray(np.array(parameters, np.float32, copy=True))
        every = [self._log_probs(vector, *batch) for batch in self._batches]
        return float(np.concatenate(every).mean()) if every else float("nan")


def _log_probs(
    config: EnvironmentConfig, network: NetworkConfig, components: int
) -> "jax.stages.Wrapped":
    """The compiled log-likelihoods of a batch."""
    sizes = observation_sizes(config.observation)
    outputs = policy_outputs(config.action, components)

    def log_probs(
        vector: Float[Array, " parameters"],
        observation: Observation,
        index: Int[Array, " batch"],
        scaled: Float[Array, "batch components"],
    ) -> Float[Array, " batch"]:
        values = batched(
            vector, observation, config=network, sizes=sizes, actions=outputs
        )
        if not components:
            every = jax.nn.log_softmax(values, -1)
            return jnp.take_along_axis(every, index[:, None], -1)[:, 0]

        def one(
            values: Float[Array, " outputs"],
            ego: Float[Array, " ego"],
            action: Float[Array, " components"],
        ) -> Float[Array, ""]:
            going_on = inertia(ego[0] * SPEED_SCALE, config.action, config.dt)
            split = split_mixture(values, action.shape[0])
            return mixture.log_prob(shifted(split, going_on), action)

        return jax.vmap(one)(values, observation.ego, scaled)

    return jax.jit(log_probs)
