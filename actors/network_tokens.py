"""Tokens of the policy network: what they are, and where modalities meet.

A modality is a grid [times, slots]: the ego state, the agents, road rows, lights. With
`time_axis` the ego's and the agents' grids have one row for each of the H states of an
observation, the latest last; a token is then one state of one object, with what does
not change (size and type; the ego's speed, turning and route) repeated in each. Without
it their states stand side by side in one token, and every grid has one row. Road rows
and lights have one row in either case: an observation holds them as they are now.

A positional embedding belongs to a position [time, slot] of a modality (Wayformer,
section 3: learned, for all modalities, initially zero). Slots have an order: agents and
lights by distance, road rows by distance from their cell's centre.

Wayformer's fusion (section 3.1) and attention (section 3.2) over these grids:

- early: one stack of layers over all modalities; hierarchical: a stack for each, one
  set of latents over all; late: a stack and latents for each. Wayformer's hierarchical
  encoders have latents of their own before the cross-modal ones; here only the last.
- multi-axis: a layer attends over all tokens of its stack. Factorised: a time layer
  attends within each slot, a space layer within each time; for early fusion grids of
  one row are tiled over the times first (section 5.2).
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from actors.network_blocks import (
    Weights,
    apply_linear,
    apply_norm,
    broadcast_rows,
    latent_block,
)
from sim.features import AGENT_FEATURES, AGENT_STEP_FEATURES
from sim.observation import Observation, ObservationSizes

MODALITIES = ("ego", "agents", "road", "lights")
EGO_NOW = 5  # speed, length, width, turn rate, pick-up: `sim.features.own_features`
EGO_POSE = 4  # x, y, sin of the turn, speed: of each past state

Fusion = Literal["early", "late", "hierarchical"]
Attention = Literal["multi-axis", "sequential", "interleaved"]
Group = tuple[Float[Array, "tokens width"], Bool[Array, " tokens"]]


class Grid(NamedTuple):
    """The tokens of one modality, or of several that met."""

    tokens: Float[Array, "times slots width"]
    valid: Bool[Array, "times slots"]


def time_steps(sizes: ObservationSizes, *, time_axis: bool) -> int:
    """Rows of the ego's and agents' grids; ValueError if the sizes do not tell."""
    if not time_axis:
        return 1
    steps, rest = divmod(sizes.agent - AGENT_FEATURES, AGENT_STEP_FEATURES)
    if steps < 1 or rest or sizes.ego < EGO_NOW + EGO_POSE * (steps - 1):
        raise ValueError(
            f"time_axis: {sizes.agent} features of an agent and {sizes.ego} of the "
            "ego are not those of whole states; switch it off"
        )
    return steps


def grid_shapes(
    sizes: ObservationSizes, *, time_axis: bool
) -> tuple[tuple[int, int], ...]:
    """Times and slots of each modality's grid."""
    steps = time_steps(sizes, time_axis=time_axis)
    return ((steps, 1), (steps, sizes.neighbours), (1, sizes.rows), (1, sizes.lights))


def token_features(sizes: ObservationSizes, *, time_axis: bool) -> tuple[int, ...]:
    """Features of a token of each modality, before the projection."""
    if not time_axis:
        return (sizes.ego, sizes.agent, sizes.road, sizes.light)
    steps = time_steps(sizes, time_axis=time_axis)
    ego = sizes.ego - EGO_POSE * (steps - 1) + EGO_POSE
    return (ego, AGENT_STEP_FEATURES + AGENT_FEATURES, sizes.road, sizes.light)


def layer_axes(attention: Attention, layers: int) -> tuple[int, ...]:
    """Over which axis of the grid each layer attends: 0 times, 1 slots."""
    if attention == "sequential":
        return (0,) * (layers // 2) + (1,) * (layers - layers // 2)
    if attention == "interleaved":
        return (0, 1) * (layers // 2)
    return (1,) * layers


def make_grids(
    weights: Weights,
    observation: Observation,
    sizes: ObservationSizes,
    *,
    time_axis: bool,
) -> list[Grid]:
    """Projects the observation's features, and adds the embeddings."""
    steps = time_steps(sizes, time_axis=time_axis)
    if time_axis:
        ego, agents, agents_valid = _over_time(observation, steps)
    else:
        ego, agents = observation.ego[None, None, :], observation.agents[None]
        agents_valid = observation.agents_valid[None]
    rows = {
        "ego": (ego, jnp.ones((steps, 1), jnp.bool_)),
        "agents": (agents, agents_valid),
        "road": (observation.road[None], observation.road_valid[None]),
        "lights": (observation.lights[None], observation.lights_valid[None]),
    }
    grids, first = [], 0
    for index, (name, (features, valid)) in enumerate(rows.items()):
        times, slots, _ = features.shape
        flat = features.reshape(times * slots, -1)
        tokens = jax.nn.relu(apply_linear(weights, f"project.{name}", flat))
        tokens += broadcast_rows(weights["modality"][index], times * slots)
        if "positions" in weights:
            tokens += weights["positions"][first : first + times * slots]
        grids.append(Grid(tokens.reshape(times, slots, -1), valid))
        first += times * slots
    return grids


def encode_tokens(
    weights: Weights,
    grids: Sequence[Grid],
    *,
    fusion: Fusion,
    attention: Attention,
    layers: int,
    heads: int,
) -> list[Group]:
    """The normalised tokens for each set of latents: all of them, or by modality."""
    factorised = attention != "multi-axis"
    if fusion == "early":
        grids = [_joined(grids, tiled=factorised)]
    axes = layer_axes(attention, layers)
    groups = []
    for encoder, grid in enumerate(grids):
        grid = grid if factorised else _flat(grid)
        for index, axis in enumerate(axes):
            grid = _layer(
                weights, f"tokens.{encoder * layers + index}", grid, axis, heads=heads
            )
        flat = _flat(grid)
        tokens = apply_norm(weights, "token_norm", flat.tokens[0])
        groups.append((tokens, flat.valid[0]))
    if fusion == "hierarchical":
        every, valid = zip(*groups, strict=True)
        groups = [(jnp.concatenate(every), jnp.concatenate(valid))]
    return groups


def _over_time(
    observation: Observation, steps: int
) -> tuple[
    Float[Array, "times 1 ego"],
    Float[Array, "times neighbours agent"],
    Bool[Array, "times neighbours"],
]:
    """The ego's and agents' features cut into one row per state."""
    ego, agents = observation.ego, observation.agents
    past = EGO_NOW + EGO_POSE * (steps - 1)
    pose = jnp.stack([ego[0] * 0, ego[0] * 0, ego[0] * 0, ego[0]])  # the origin
    poses = jnp.concatenate([ego[EGO_NOW:past], pose]).reshape(steps, EGO_POSE)
    own = jnp.concatenate(
        [
            broadcast_rows(ego[:EGO_NOW], steps),
            poses,
            broadcast_rows(ego[past:], steps),
        ],
        -1,
    )
    neighbours = agents.shape[0]
    moving = agents[:, : steps * AGENT_STEP_FEATURES]
    moving = moving.reshape(neighbours, steps, AGENT_STEP_FEATURES).transpose(1, 0, 2)
    fixed = agents[:, steps * AGENT_STEP_FEATURES :][None]
    fixed = jnp.broadcast_to(fixed, (steps, neighbours, fixed.shape[-1]))
    there = moving[..., -1] > 0.5  # the state's own flag
    valid = there & jnp.broadcast_to(observation.agents_valid, there.shape)
    return own[:, None], jnp.concatenate([moving, fixed], -1), valid


def _joined(grids: Sequence[Grid], *, tiled: bool) -> Grid:
    """All modalities in one grid: tiled over the times, or all in one row."""
    if not tiled:
        grids = [_flat(grid) for grid in grids]
    steps = max(grid.valid.shape[0] for grid in grids)
    tokens = [
        jnp.broadcast_to(grid.tokens, (steps, *grid.tokens.shape[1:])) for grid in grids
    ]
    valid = [jnp.broadcast_to(g.valid, (steps, g.valid.shape[1])) for g in grids]
    return Grid(jnp.concatenate(tokens, 1), jnp.concatenate(valid, 1))


def _flat(grid: Grid) -> Grid:
    """The same tokens in one row."""
    width = grid.tokens.shape[-1]
    return Grid(grid.tokens.reshape(1, -1, width), grid.valid.reshape(1, -1))


def _layer(weights: Weights, prefix: str, grid: Grid, axis: int, *, heads: int) -> Grid:
    """One layer of self-attention within each row, or within each column."""

    def attend(
        tokens: Float[Array, "tokens width"], valid: Bool[Array, " tokens"]
    ) -> Float[Array, "tokens width"]:
        return latent_block(weights, prefix, tokens, heads=heads, valid=valid)

    other = 1 - axis
    over = jax.vmap(attend, in_axes=(other, other), out_axes=other)
    return Grid(over(grid.tokens, grid.valid), grid.valid)
