"""Tokens of the policy network in torch; `actors.network_tokens` specifies them.

Grids hold a batch in front: tokens [batch, times, slots, width].
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from actors.network import NetworkConfig
from actors.network_tokens import EGO_NOW, EGO_POSE, layer_axes
from sim.features import AGENT_STEP_FEATURES

Group = tuple[Float[Tensor, "batch tokens width"], Bool[Tensor, "batch tokens"]]


class Grid(NamedTuple):
    """The tokens of one modality, or of several that met."""

    tokens: Float[Tensor, "batch times slots width"]
    valid: Bool[Tensor, "batch times slots"]


class Inputs(NamedTuple):
    """One modality's features before the projection."""

    features: Float[Tensor, "batch times slots features"]
    valid: Bool[Tensor, "batch times slots"]


def split_over_time(
    ego: Float[Tensor, "batch ego"],
    agents: Float[Tensor, "batch neighbours agent"],
    agents_valid: Bool[Tensor, "batch neighbours"],
    steps: int,
) -> tuple[Inputs, Inputs]:
    """The ego's and agents' features cut into one row per state."""
    batch, neighbours = agents_valid.shape
    past = EGO_NOW + EGO_POSE * (steps - 1)
    pose = torch.cat([ego.new_zeros(batch, EGO_POSE - 1), ego[:, :1]], -1)  # the origin
    poses = torch.cat([ego[:, EGO_NOW:past], pose], -1).view(batch, steps, EGO_POSE)
    own = torch.cat(
        [
            ego[:, None, :EGO_NOW].expand(-1, steps, -1),
            poses,
            ego[:, None, past:].expand(-1, steps, -1),
        ],
        -1,
    )
    cut = steps * AGENT_STEP_FEATURES
    moving = agents[..., :cut].reshape(batch, neighbours, steps, AGENT_STEP_FEATURES)
    moving = moving.transpose(1, 2)
    fixed = agents[:, None, :, cut:].expand(-1, steps, -1, -1)
    there = (moving[..., -1] > 0.5) & agents_valid[:, None]
    return (
        Inputs(own[:, :, None], agents_valid.new_ones(batch, steps, 1)),
        Inputs(torch.cat([moving, fixed], -1), there),
    )


def encode_tokens(
    grids: Sequence[Grid],
    blocks: nn.ModuleList,
    norm: nn.LayerNorm,
    config: NetworkConfig,
) -> list[Group]:
    """The normalised tokens for each set of latents: all of them, or by modality."""
    factorised = config.attention != "multi-axis"
    if config.fusion == "early":
        grids = [_joined(grids, tiled=factorised)]
    axes = layer_axes(config.attention, config.token_layers)
    groups = []
    for encoder, grid in enumerate(grids):
        grid = grid if factorised else _flat(grid)
        for index, axis in enumerate(axes):
            grid = _layer(blocks[encoder * len(axes) + index], grid, axis)
        flat = _flat(grid)
        groups.append((norm(flat.tokens[:, 0]), flat.valid[:, 0]))
    if config.fusion == "hierarchical":
        every, valid = zip(*groups, strict=True)
        groups = [(torch.cat(every, 1), torch.cat(valid, 1))]
    return groups


def _joined(grids: Sequence[Grid], *, tiled: bool) -> Grid:
    """All modalities in one grid: tiled over the times, or all in one row."""
    if not tiled:
        grids = [_flat(grid) for grid in grids]
    steps = max(grid.valid.shape[1] for grid in grids)
    tokens = [grid.tokens.expand(-1, steps, -1, -1) for grid in grids]
    valid = [grid.valid.expand(-1, steps, -1) for grid in grids]
    return Grid(torch.cat(tokens, 2), torch.cat(valid, 2))


def _flat(grid: Grid) -> Grid:
    """The same tokens in one row."""
    return Grid(grid.tokens.flatten(1, 2)[:, None], grid.valid.flatten(1, 2)[:, None])


def _layer(block: nn.Module, grid: Grid, axis: int) -> Grid:
    """One layer of self-attention within each row, or within each column."""
    tokens, valid = grid
    if axis == 0:
        tokens, valid = tokens.transpose(1, 2), valid.transpose(1, 2)
    attended = block(tokens.flatten(0, 1), valid.flatten(0, 1)).view(tokens.shape)
    return Grid(attended.transpose(1, 2) if axis == 0 else attended, grid.valid)
