"""The policy network in torch. `actors.network` specifies it and is its JAX twin.

Written for a batch, because here it is trained: a fused multiplication for each
attention step. Parameters are drawn from the torch generator passed in, so a seed
fixes them whatever else has drawn numbers in the process.
"""

import math
import warnings
from typing import final

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from actors.network import MASKED, MODALITIES, NORM_EPSILON, Layout, NetworkConfig
from sim.observation import Observation, ObservationSizes

# What JAX rendered is read-only memory, and nothing here writes into observations.
warnings.filterwarnings("ignore", message="The given NumPy array is not writable")


@final
class CrossBlock(nn.Module):
    """Latents attend over tokens, then feed forward; both pre-norm and residual."""

    def __init__(self, config: NetworkConfig) -> None:
        """Creates uninitialised layers."""
        nn.Module.__init__(self)
        width = config.width
        self.heads = config.heads
        self.query_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width, bias=False)
        self.value = nn.Linear(width, width)
        self.out = nn.Linear(width, width)
        self.feedforward_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.expand = nn.Linear(width, width * config.feedforward)
        self.contract = nn.Linear(width * config.feedforward, width)

    def forward(
        self,
        latents: Float[Tensor, "batch latents width"],
        tokens: Float[Tensor, "batch tokens width"],
        bias: Float[Tensor, "batch 1 tokens"],
    ) -> Float[Tensor, "batch latents width"]:
        """Adds what the latents read; `bias` is 0 or `MASKED`."""
        batch, count, width = latents.shape
        heads, split = self.heads, width // self.heads
        rows = batch * count
        # Keys and values of the tokens are never formed (see `actors.network`):
        # measured 2.0 to 2.3 times faster forward and backward than forming them
        # for 4 latents over 49 tokens, 1.4 times for 8.
        q = self.query(self.query_norm(latents)).view(rows, heads, split)
        # The scale goes on the small weight: on the scores, its gradient would be
        # multiplied at the size of all tokens.
        key = self.key.weight.view(heads, split, width) * split**-0.5
        q = torch.bmm(q.transpose(0, 1), key)
        q = q.view(heads, batch, count, width).transpose(0, 1)
        q = q.reshape(batch, heads * count, width)
        scores = torch.baddbmm(bias, q, tokens.transpose(1, 2))
        pooled = torch.bmm(scores.softmax(-1), tokens)
        pooled = pooled.view(batch, heads, count, width).transpose(0, 1)
        y = torch.baddbmm(
            self.value.bias.view(heads, 1, split),
            pooled.reshape(heads, rows, width),
            self.value.weight.view(heads, split, width).transpose(1, 2),
        )
        latents = latents + self.out(y.transpose(0, 1).reshape(batch, count, width))
        return latents + _feedforward(self, latents)


@final
class LatentBlock(nn.Module):
    """Latents attend over each other, then feed forward; pre-norm and residual."""

    def __init__(self, config: NetworkConfig) -> None:
        """Creates uninitialised layers."""
        nn.Module.__init__(self)
        width = config.width
        self.heads = config.heads
        self.query_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.query_key_value = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.feedforward_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.expand = nn.Linear(width, width * config.feedforward)
        self.contract = nn.Linear(width * config.feedforward, width)

    def forward(
        self, latents: Float[Tensor, "batch latents width"]
    ) -> Float[Tensor, "batch latents width"]:
        """Adds what the latents tell each other."""
        batch, count, width = latents.shape
        qkv = self.query_key_value(self.query_norm(latents))
        qkv = qkv.view(batch, count, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        y = F.scaled_dot_product_attention(q, k, v)
        y = y.transpose(1, 2).reshape(batch, count, width)
        latents = latents + self.out(y)
        return latents + _feedforward(self, latents)


@final
class ResidualLayer(nn.Module):
    """x + linear(relu(norm(x)))."""

    def __init__(self, width: int) -> None:
        """Creates uninitialised layers."""
        nn.Module.__init__(self)
        self.norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.linear = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "batch width"]) -> Float[Tensor, "batch width"]:
        """Adds the layer's change to x."""
        y: Tensor = x + self.linear(self.norm(x).relu())
        return y


@final
class QNetwork(nn.Module):
    """Q-values of all actions (or their logits) for a batch of observations."""

    def __init__(
        self,
        *,
        config: NetworkConfig,
        sizes: ObservationSizes,
        actions: int,
        generator: torch.Generator,
    ) -> None:
        """Creates and initialises the network."""
        nn.Module.__init__(self)
        width = config.width
        self.modality = nn.Parameter(torch.empty(len(MODALITIES), width))
        self.latents = nn.Parameter(torch.empty(config.latents, width))
        features = (sizes.ego, sizes.agent, sizes.road, sizes.light)
        self.project = nn.ModuleDict(
            {
                name: nn.Linear(size, width)
                for name, size in zip(MODALITIES, features, strict=True)
            }
        )
        self.ego_to_latents = nn.Linear(sizes.ego, width)
        self.token_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.cross = nn.ModuleList(
            CrossBlock(config) for _ in range(config.cross_layers)
        )
        self.latent = nn.ModuleList(
            LatentBlock(config) for _ in range(config.self_layers)
        )
        self.pooled_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.mlp_in = nn.Linear(width, config.mlp_width)
        self.mlp = nn.ModuleList(
            ResidualLayer(config.mlp_width) for _ in range(config.mlp_layers)
        )
        self.head_norm = nn.LayerNorm(config.mlp_width, eps=NORM_EPSILON)
        self.head = nn.Linear(config.mlp_width, actions)
        _initialise(self, generator)

    def forward(
        self,
        ego: Float[Tensor, "batch ego_features"],
        agents: Float[Tensor, "batch neighbours agent_features"],
        agents_valid: Bool[Tensor, "batch neighbours"],
        road: Float[Tensor, "batch rows road_features"],
        road_valid: Bool[Tensor, "batch rows"],
        lights: Float[Tensor, "batch lights light_features"],
        lights_valid: Bool[Tensor, "batch lights"],
    ) -> Float[Tensor, "batch actions"]:
        """Takes the fields of `Observation` in their order."""
        rows = (ego[:, None, :], agents, road, lights)
        tokens = torch.cat(
            [
                self.project[name](x).relu() + self.modality[index]
                for index, (name, x) in enumerate(zip(MODALITIES, rows, strict=True))
            ],
            dim=1,
        )
        tokens = self.token_norm(tokens)
        bias = _mask_bias(agents_valid, road_valid, lights_valid)
        latents = self.latents + self.ego_to_latents(ego)[:, None, :]
        for cross in self.cross:
            latents = cross(latents, tokens, bias)
        for block in self.latent:
            latents = block(latents)
        x = self.mlp_in(self.pooled_norm(latents.mean(dim=1)))
        for layer in self.mlp:
            x = layer(x)
        values: Tensor = self.head(self.head_norm(x))
        return values


def to_torch(observation: Observation, device: torch.device) -> tuple[Tensor, ...]:
    """The fields of a batch of observations as tensors, without a copy on a CPU."""
    return tuple(
        torch.from_numpy(np.asarray(field)).to(device, non_blocking=True)
        for field in observation
    )


def torch_layout(network: nn.Module) -> Layout:
    """Names and shapes as the module has them; equals `parameter_layout`."""
    return tuple(
        (name, tuple(value.shape)) for name, value in network.state_dict().items()
    )


def to_vector(network: nn.Module) -> Float[np.ndarray, " parameters"]:
    """All parameters as one float32 vector, a copy, in `state_dict` order."""
    parts = [value.detach().reshape(-1) for value in network.state_dict().values()]
    vector: np.ndarray = torch.cat(parts).to("cpu", torch.float32).numpy()
    return vector


def load_vector(network: nn.Module, vector: Float[np.ndarray, " parameters"]) -> None:
    """Writes the vector into the parameters, in place."""
    values = network.state_dict().values()
    if vector.shape[0] != sum(value.numel() for value in values):
        raise ValueError(
            f"weight vector of {vector.shape[0]} values, "
            f"this network has {sum(value.numel() for value in values)}"
        )
    source, start = torch.from_numpy(vector.copy()), 0
    with torch.no_grad():
        for value in values:
            value.copy_(source[start : start + value.numel()].view(value.shape))
            start += value.numel()


def _feedforward(
    block: CrossBlock | LatentBlock, x: Float[Tensor, "batch latents width"]
) -> Float[Tensor, "batch latents width"]:
    hidden = block.expand(block.feedforward_norm(x))
    y: Tensor = block.contract(F.gelu(hidden, approximate="tanh"))
    return y


def _mask_bias(
    agents_valid: Bool[Tensor, "batch neighbours"],
    road_valid: Bool[Tensor, "batch rows"],
    lights_valid: Bool[Tensor, "batch lights"],
) -> Float[Tensor, "batch 1 tokens"]:
    ego_valid = agents_valid.new_ones(agents_valid.shape[0], 1)
    valid = torch.cat([ego_valid, agents_valid, road_valid, lights_valid], dim=1)
    # MASKED added to a score of unit size is MASKED within rounding, and its
    # exponential is exactly 0.
    return (~valid).to(torch.float32).mul_(MASKED)[:, None, :]


def _initialise(network: QNetwork, generator: torch.Generator) -> None:
    """Truncated normals of variance 1 / inputs, zero biases, a small head.

    Latents start at unit variance, or all queries would ask the same and stay equal.
    The small head makes first Q-values small against rewards of about 1.
    """
    for module in network.modules():
        if isinstance(module, nn.Linear):
            deviation = 1.0 / math.sqrt(module.in_features)
            if module is network.head:
                deviation *= 0.01
            nn.init.trunc_normal_(
                module.weight,
                std=deviation,
                a=-2 * deviation,
                b=2 * deviation,
                generator=generator,
            )
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    nn.init.normal_(network.modality, std=0.5, generator=generator)
    nn.init.normal_(network.latents, std=1.0, generator=generator)
