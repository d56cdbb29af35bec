"""A mixture of Gaussians squashed by tanh, over actions scaled to [-1, 1].

    p(a) = sum_k w_k prod_d N(u_d; m_kd, s_kd) / (1 - a_d^2)       u = atanh(a)

in plain JAX for one observation; `learner.mixture` has the same in torch for a batch.
The Waymax paper (appendix A.2) clones continuous actions by a 10-component mixture of
this kind and leaves the rest open. Here: components have diagonal covariances; a
network's outputs are K logits of the weights w, then K D means m, then K D numbers r
with s = `SMALLEST` + softplus(r). An action is scaled by the limits of its space
(`action_limits`), symmetric also where the grid is not: Delta's grid goes forward only,
but a car at rest would then lie at the squashed range's end.

Means are relative to going on as before (`inertia`): a Delta action is a distance, of
which a thousandth of the limit too much in each step is an acceleration of 0.3 m/s^2
that never ends, for the next step starts from the speed that it led to.

Recorded actions beyond a limit are cut to it. There u is infinite: `LARGEST` bounds
|a|, so that what lies at the limit counts as u = 7.3.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sim.dynamics import ActionConfig, ActionSpace

SMALLEST = 0.005  # of a deviation, before squashing: 1.5 cm of Delta's 3 m
LARGEST = 1.0 - 1e-6
FASTEST = 0.995  # of a limit, from which on what keeps the speed is not told apart
FIRST_SCALE = 0.3  # of an untrained mixture
Choice = Literal["mode", "mean", "sample"]
_NODES, _NODE_WEIGHTS = np.polynomial.hermite.hermgauss(16)


class Mixture(NamedTuple):
    """The distribution of one action, before squashing."""

    log_weights: Float[Array, " mixture"]
    means: Float[Array, "mixture components"]
    scales: Float[Array, "mixture components"]


def action_limits(config: ActionConfig) -> Float[np.ndarray, " components"]:
    """The largest size of each component of the space's continuous actions."""
    if config.space == ActionSpace.BICYCLE:
        limits = [config.acceleration, config.curvature]
    elif config.space == ActionSpace.STEERING:
        limits = [config.acceleration, config.wheel]
    else:
        limits = [config.forward, config.sideways, config.turn]
    return np.array(limits, np.float32)


def policy_outputs(config: ActionConfig, mixture: int) -> int:
    """Outputs of the network: the grid's actions, or a mixture's parameters.

    `mixture` is the number of components of a mixture, 0 for a choice on the grid.
    """
    if mixture == 0:
        return config.count
    return mixture * (1 + 2 * len(action_limits(config)))


def inertia(
    speed: Float[Array, ""], config: ActionConfig, dt: float
) -> Float[Array, " components"]:
    """The scaled action that keeps speed [m/s] and heading, before squashing.

    0 where actions are accelerations; of Delta's, the distance ahead.
    """
    still = jnp.zeros(len(action_limits(config)))
    if config.space != ActionSpace.DELTA:
        return still
    scaled = jnp.clip(speed * (dt / config.forward), 0.0, FASTEST)
    return still.at[0].set(jnp.arctanh(scaled))


def split_mixture(outputs: Float[Array, " outputs"], components: int) -> Mixture:
    """A network's outputs as a mixture over actions of so many components."""
    count = outputs.shape[0] // (1 + 2 * components)
    rest = outputs[count:].reshape(2, count, components)
    return Mixture(
        log_weights=jax.nn.log_softmax(outputs[:count]),
        means=rest[0],
        scales=SMALLEST + jax.nn.softplus(rest[1]),
    )


def shifted(mixture: Mixture, by: Float[Array, " components"]) -> Mixture:
    """The same distribution elsewhere, before squashing."""
    return mixture._replace(means=mixture.means + by[None])


def log_prob(mixture: Mixture, action: Float[Array, " components"]) -> Float[Array, ""]:
    """The log density of a scaled action [nats]."""
    cut = jnp.clip(action, -LARGEST, LARGEST)
    # 1 - a is exact near 1, so neither of these loses digits there.
    above, below = jnp.log1p(cut), jnp.log1p(-cut)
    return _log_normals(mixture, 0.5 * (above - below)) - (above + below).sum()


def mode(mixture: Mixture) -> Float[Array, " components"]:
    """The scaled action of the component's mean that is likeliest before squashing.

    Exact where components do not overlap. Squashing is left out on purpose: it
    heaps the density of a wide component up at the range's ends.
    """
    densities = jax.vmap(lambda mean: _log_normals(mixture, mean))(mixture.means)
    return jnp.tanh(mixture.means[jnp.argmax(densities)])


def mean(mixture: Mixture) -> Float[Array, " components"]:
    """The expected scaled action, by Gauss-Hermite quadrature with 16 nodes."""
    nodes = jnp.asarray(np.sqrt(2.0) * _NODES, jnp.float32)[:, None, None]
    shares = jnp.asarray(_NODE_WEIGHTS / np.sqrt(np.pi), jnp.float32)[:, None, None]
    squashed = jnp.tanh(mixture.means[None] + nodes * mixture.scales[None])
    expected = (shares * squashed).sum(0)
    return (jnp.exp(mixture.log_weights)[:, None] * expected).sum(0)


def sample(key: PRNGKeyArray, mixture: Mixture) -> Float[Array, " components"]:
    """A draw of a scaled action."""
    component_key, normal_key = jax.random.split(key)
    chosen = jax.random.categorical(component_key, mixture.log_weights)
    normal = jax.random.normal(normal_key, mixture.means.shape[1:])
    return jnp.tanh(mixture.means[chosen] + normal * mixture.scales[chosen])


def _log_normals(mixture: Mixture, u: Float[Array, " components"]) -> Float[Array, ""]:
    """The log density before squashing."""
    z = (u[None] - mixture.means) / mixture.scales
    each = -0.5 * z**2 - jnp.log(mixture.scales) - 0.5 * float(np.log(2 * np.pi))
    return jax.nn.logsumexp(mixture.log_weights + each.sum(-1))
