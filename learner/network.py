"""The policy network in torch. `actors.network` specifies it and is its JAX twin.

Written for a batch, because here it is trained: a fused multiplication for each
attention step. Parameters are drawn from the torch generator passed in, so a seed
fixes them whatever else has drawn numbers in the process.
"""

import math
import warnings
from typing import final

import jax
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from actors.network import Layout, NetworkConfig
from actors.network_blocks import NORM_EPSILON
from actors.network_tokens import MODALITIES, grid_shapes, time_steps, token_features
from learner.network_blocks import CrossBlock, LatentBlock, ResidualLayer, mask_bias
from learner.network_tokens import Grid, Inputs, encode_tokens, split_over_time
from sim.observation import Observation, ObservationSizes

# What JAX rendered is read-only memory, and nothing here writes into observations.
warnings.filterwarnings("ignore", message="The given NumPy array is not writable")


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
        width, time_axis = config.width, config.time_axis
        self.config = config
        self.times = time_steps(sizes, time_axis=time_axis)
        self.modality = nn.Parameter(torch.empty(len(MODALITIES), width))
        self.latents = nn.Parameter(torch.empty(config.readers * config.latents, width))
        self.counts = [t * s for t, s in grid_shapes(sizes, time_axis=time_axis)]
        if config.positions:
            self.positions = nn.Parameter(torch.zeros(sum(self.counts), width))
        features = token_features(sizes, time_axis=time_axis)
        self.project = nn.ModuleDict(
            {
                name: nn.Linear(size, width)
                for name, size in zip(MODALITIES, features, strict=True)
            }
        )
        self.ego_to_latents = nn.Linear(sizes.ego, width)
        self.tokens = nn.ModuleList(
            LatentBlock(config)
            for _ in range(config.token_encoders * config.token_layers)
        )
        self.token_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.cross = nn.ModuleList(
            CrossBlock(config) for _ in range(config.readers * config.cross_layers)
        )
        self.latent = nn.ModuleList(
            LatentBlock(config) for _ in range(config.readers * config.self_layers)
        )
        self.pooled_norm = nn.LayerNorm(width, eps=NORM_EPSILON)
        self.mlp_in = nn.Linear(width, config.mlp_width)
        self.mlp = nn.ModuleList(
            ResidualLayer(config.mlp_width) for _ in range(config.mlp_layers)
        )
        self.head_norm = nn.LayerNorm(config.mlp_width, eps=NORM_EPSILON)
        self.head = nn.Linear(config.mlp_width, actions)
        if config.dueling:
            self.value = nn.Linear(config.mlp_width, 1)
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
        if self.config.time_axis:
            objects = split_over_time(ego, agents, agents_valid, self.times)
        else:
            here = agents_valid.new_ones(agents_valid.shape[0], 1, 1)
            objects = (
                Inputs(ego[:, None, None], here),
                Inputs(agents[:, None], agents_valid[:, None]),
            )
        grids = self._grids(
            *objects,
            Inputs(road[:, None], road_valid[:, None]),
            Inputs(lights[:, None], lights_valid[:, None]),
        )
        x = self.mlp_in(self.pooled_norm(self._read(grids, ego)))
        for layer in self.mlp:
            x = layer(x)
        x = self.head_norm(x)
        values: Tensor = self.head(x)
        if self.config.dueling:
            values = values + self.value(x) - values.mean(-1, keepdim=True)
        return values

    def _grids(self, *modalities: Inputs) -> list[Grid]:
        """Projects the features, and adds the embeddings."""
        grids, first = [], 0
        for index, (name, inputs) in enumerate(
            zip(MODALITIES, modalities, strict=True)
        ):
            embedding = self.modality[index]
            if self.config.positions:
                stop = first + self.counts[index]
                own = self.positions[first:stop] + embedding
                embedding = own.view(*inputs.features.shape[1:3], -1)
                first = stop
            tokens = self.project[name](inputs.features).relu() + embedding
            grids.append(Grid(tokens, inputs.valid))
        return grids

    def _read(
        self, grids: list[Grid], ego: Float[Tensor, "batch ego_features"]
    ) -> Float[Tensor, "batch width"]:
        """The mean of what all latents hold in the end."""
        config = self.config
        groups = encode_tokens(grids, self.tokens, self.token_norm, config)
        own = self.ego_to_latents(ego)[:, None, :]
        read = []
        for reader, (tokens, valid) in enumerate(groups):
            first = reader * config.latents
            latents = self.latents[first : first + config.latents] + own
            bias = mask_bias(valid)
            # One reader always sees the ego.
            some = valid.any(-1)[:, None, None] if config.readers > 1 else None
            for index in range(config.cross_layers):
                block = self.cross[reader * config.cross_layers + index]
                last = config.self_layers == 0 and index == config.cross_layers - 1
                latents = block(latents, tokens, bias, some, pooled=last)
            for index in range(config.self_layers):
                block = self.latent[reader * config.self_layers + index]
                latents = block(latents, pooled=index == config.self_layers - 1)
            read.append(latents)
        # Each reader has as many latents, so this is the mean of them all.
        return torch.stack(read).mean(dim=0) if len(read) > 1 else read[0]


def to_torch(observation: Observation, device: torch.device) -> tuple[Tensor, ...]:
    """The fields of a batch of observations as tensors.

    Without a copy on a CPU, and where JAX rendered on the GPU that torch computes on.
    """
    # On a GPU, through the host there would be two copies and a wait in between.
    host = device.type == "cpu"
    return tuple(
        shared_tensor(field, host=host).to(device, non_blocking=True)
        for field in observation
    )


def shared_tensor(field: np.ndarray | jax.Array, *, host: bool) -> Tensor:
    """The same memory as a tensor, on the host or where JAX has it."""
    if host or not isinstance(field, jax.Array):
        return torch.from_numpy(np.asarray(field))  # 2 us, where DLPack takes 10
    return torch.utils.dlpack.from_dlpack(field)


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


@torch.no_grad()
def follow_average(
    average: nn.Module, network: nn.Module, *, updates: int, window: int
) -> None:
    """Moves the average towards the network; at first it is a plain mean."""
    if window:
        torch._foreach_lerp_(
            list(average.parameters()),
            list(network.parameters()),
            1.0 / min(updates, window),
        )


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
