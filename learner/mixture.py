"""Log-likelihoods of behaviour cloning, pure; torch only.

The tanh-squashed Gaussian mixture that `actors.mixture` specifies, and the softmax over
a grid's actions. Any floating type: the tests compare with float64.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from actors.mixture import FASTEST, LARGEST, SMALLEST
from sim.dynamics import ActionConfig, ActionSpace


class Mixture(NamedTuple):
    """The distributions of a batch of actions, before squashing."""

    log_weights: Float[Tensor, "batch mixture"]
    means: Float[Tensor, "batch mixture components"]
    scales: Float[Tensor, "batch mixture components"]


def split_mixture(outputs: Float[Tensor, "batch outputs"], components: int) -> Mixture:
    """A network's outputs as mixtures over actions of so many components."""
    count = outputs.shape[1] // (1 + 2 * components)
    rest = outputs[:, count:].reshape(-1, 2, count, components)
    return Mixture(
        log_weights=outputs[:, :count].log_softmax(-1),
        means=rest[:, 0],
        scales=SMALLEST + F.softplus(rest[:, 1]),
    )


def shifted(
    mixture: Mixture,
    speed: Float[Tensor, " batch"],
    config: ActionConfig,
    dt: float,
) -> Mixture:
    """With means relative to what keeps the speed [m/s]: `actors.mixture.inertia`."""
    if config.space != ActionSpace.DELTA:
        return mixture
    scaled = (speed * (dt / config.forward)).clamp(0.0, FASTEST)
    going_on = torch.zeros_like(mixture.means[:, :1])
    going_on[..., 0] = torch.atanh(scaled)[:, None]
    return mixture._replace(means=mixture.means + going_on)


def mixture_log_prob(
    mixture: Mixture, action: Float[Tensor, "batch components"]
) -> Float[Tensor, " batch"]:
    """The log densities of scaled actions, |a| cut to `LARGEST` [nats]."""
    cut = action.clamp(-LARGEST, LARGEST)
    # 1 - a is exact near 1, so neither of these loses digits there.
    above, below = torch.log1p(cut), torch.log1p(-cut)
    u = 0.5 * (above - below)  # atanh
    z = (u[:, None] - mixture.means) / mixture.scales
    each = -0.5 * z.square() - mixture.scales.log() - 0.5 * math.log(2 * math.pi)
    normals = torch.logsumexp(mixture.log_weights + each.sum(-1), -1)
    return normals - (above + below).sum(-1)


def softmax_log_prob(
    logits: Float[Tensor, "batch actions"], action: Int[Tensor, " batch"]
) -> Float[Tensor, " batch"]:
    """The log probabilities of indices: minus the cross-entropy."""
    return -F.cross_entropy(logits, action, reduction="none")
