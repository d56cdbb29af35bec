"""The policy network in plain JAX: the actors' twin of `learner.network`.

Per observation, with D the width, Q the latents, T the tokens:

    tokens  = relu(W_m x_m + b_m) + e_m [+ p_m]         per modality m      [T, D]
    tokens  = blocks of self-attention and feed-forward `token_layers` times
    tokens  = LayerNorm(tokens)
    latents = learned + W_e ego + b_e                                       [Q, D]
    cross   : latents += attend(LayerNorm(latents), tokens, mask)
              latents += feedforward(LayerNorm(latents))    `cross_layers` times
    self    : the same, latents attending over latents      `self_layers` times
    x       = W LayerNorm(mean of latents) + b                              [mlp_width]
    x      += W relu(LayerNorm(x)) + b                      `mlp_layers` times
    Q-values = A = W LayerNorm(x) + b                                       [actions]
    dueling : V + A - mean(A)       (Wang et al., 2016, eq. 9), V another linear of x

This is Wayformer's scene encoder (Nayakanti et al., 2022, section 3: projection by
relu, learned positional embeddings that start at zero, pre-normalisation, padding
masked) with the 4-layer residual MLP that the Waymax paper puts on it. The feed-forward
is GELU in its tanh form. `actors.network_tokens` says what the tokens are and where the
modalities meet; `actors.network_blocks` has the attention.

Latent queries always read the tokens, also where self-attention came before: they
are Wayformer's first encoder block with latent queries (its section 3.2) when
`token_layers` is 0, and stand for the cross-attention of its decoder when not.

Departures from Wayformer: the ego state is also added to the latents, so that the
residual path carries it; tokens are normalised once for all cross layers; the readout
is the mean of the latents, over all times; an embedding e_m of each modality stands
beside the positional ones, which are off in the preset `quick` (a set has no order).

Weights are one float32 vector in the order of `parameter_layout`, which is the torch
module's `state_dict` order; `unpack` cuts it by static slices inside jit.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from actors.network_blocks import (
    Weights,
    apply_linear,
    apply_norm,
    broadcast_rows,
    cross_block,
    latent_block,
)
from actors.network_tokens import (
    MODALITIES,
    encode_tokens,
    grid_shapes,
    make_grids,
    token_features,
)
from sim.observation import Observation, ObservationSizes

Layout = tuple[tuple[str, tuple[int, ...]], ...]


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Sizes of the policy network. The defaults are the preset `quick`."""

    width: int = 64
    """Features of a token and of a latent (D)."""

    heads: int = 4
    """Attention heads; they divide `width`."""

    latents: int = 4
    """Learned queries (Q) that read the tokens; with late fusion, of each modality."""

    cross_layers: int = 1
    """Layers in which the latents attend over the tokens, at least 1."""

    self_layers: int = 0
    """Layers in which the latents attend over each other, after the cross layers."""

    feedforward: int = 2
    """Hidden width of the feed-forward layers, as a multiple of `width`."""

    mlp_width: int = 128
    """Width of the residual MLP after the encoder."""

    mlp_layers: int = 4
    """Residual layers of that MLP."""

    fusion: Literal["early", "late", "hierarchical"] = "early"
    """Where modalities meet: before the tokens' self-attention (early), between it and
    the latent queries (hierarchical), or after them, in the readout (late)."""

    attention: Literal["multi-axis", "sequential", "interleaved"] = "multi-axis"
    """Self-attention of tokens: over all at once, or over time and space by turns, the
    time layers first (sequential) or alternating (interleaved)."""

    token_layers: int = 0
    """Layers of self-attention among tokens, before the latents read them."""

    time_axis: bool = False
    """One token for each state of an object, not one with its states side by side."""

    positions: bool = False
    """A learned embedding for each position of each modality, zero at first."""

    dueling: bool = False
    """Q-values as a state's value plus the actions' advantages."""

    def __post_init__(self) -> None:
        """Refuses sizes that make no network."""
        for name in ("width", "heads", "latents", "cross_layers", "feedforward"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if min(self.self_layers, self.mlp_layers, self.token_layers) < 0 or (
            self.mlp_width < 1
        ):
            raise ValueError(
                f"self_layers={self.self_layers}, mlp_layers={self.mlp_layers} and "
                f"token_layers={self.token_layers} must be at least 0, "
                f"mlp_width={self.mlp_width} at least 1"
            )
        if self.width % self.heads:
            raise ValueError(
                f"heads={self.heads} must divide width={self.width}: "
                "choose a multiple of heads as width"
            )
        self._check_attention()

    def _check_attention(self) -> None:
        if self.fusion == "hierarchical" and self.token_layers == 0:
            raise ValueError(
                "fusion=hierarchical with token_layers=0 is early fusion: "
                "give the modalities layers of their own"
            )
        if self.attention == "multi-axis":
            return
        if not self.time_axis or self.token_layers < 2 or self.token_layers % 2:
            raise ValueError(
                f"attention={self.attention} goes over time and space by turns: it "
                f"needs time_axis and an even token_layers, not {self.token_layers}"
            )

    @property
    def readers(self) -> int:
        """Sets of latents: one, or with late fusion one of each modality."""
        return len(MODALITIES) if self.fusion == "late" else 1

    @property
    def token_encoders(self) -> int:
        """Stacks of token layers: one, or one of each modality."""
        return 1 if self.fusion == "early" else len(MODALITIES)


def quick_network() -> NetworkConfig:
    """Minutes on two cores: 4 latent queries read the tokens once."""
    return NetworkConfig()


def laptop_network() -> NetworkConfig:
    """An hour on two cores: one layer among 8 latents more, positions, wider layers."""
    return NetworkConfig(width=96, latents=8, self_layers=1, positions=True)


def paper_network() -> NetworkConfig:
    """Wayformer's largest depth of 4 at the Waymax paper's width of 128.

    Early fusion with latent queries: 1 layer reads the tokens, 3 go on among 32
    latents, a quarter of the paper preset's 119 tokens (Wayformer, section 4.2).
    """
    return NetworkConfig(
        width=128,
        latents=32,
        self_layers=3,
        feedforward=4,
        time_axis=True,
        positions=True,
    )


def parameter_layout(
    config: NetworkConfig, sizes: ObservationSizes, actions: int
) -> Layout:
    """Names and shapes of all parameters, in torch's `state_dict` order."""
    return tuple(itertools.chain(_encoder(config, sizes), _trunk(config, actions)))


def _encoder(
    config: NetworkConfig, sizes: ObservationSizes
) -> Iterator[tuple[str, tuple[int, ...]]]:
    width, time_axis = config.width, config.time_axis
    yield "modality", (len(MODALITIES), width)
    yield "latents", (config.readers * config.latents, width)
    if config.positions:
        shapes = grid_shapes(sizes, time_axis=time_axis)
        yield "positions", (sum(times * slots for times, slots in shapes), width)
    features = token_features(sizes, time_axis=time_axis)
    for name, size in zip(MODALITIES, features, strict=True):
        yield from _linear(f"project.{name}", size, width)
    yield from _linear("ego_to_latents", sizes.ego, width)
    among = _linear("query_key_value", width, 3 * width)
    for index in range(config.token_encoders * config.token_layers):
        yield from _attention_block(f"tokens.{index}", among, config)
    yield from _norm("token_norm", width)
    over = _linear("query", width, width) + _linear("key", width, width)[:1]
    over += _linear("value", width, width)
    for index in range(config.readers * config.cross_layers):
        yield from _attention_block(f"cross.{index}", over, config)
    for index in range(config.readers * config.self_layers):
        yield from _attention_block(f"latent.{index}", among, config)


def _attention_block(
    prefix: str, projections: Layout, config: NetworkConfig
) -> Iterator[tuple[str, tuple[int, ...]]]:
    width, hidden = config.width, config.width * config.feedforward
    yield from _norm(f"{prefix}.query_norm", width)
    yield from ((f"{prefix}.{name}", shape) for name, shape in projections)
    yield from _linear(f"{prefix}.out", width, width)
    yield from _norm(f"{prefix}.feedforward_norm", width)
    yield from _linear(f"{prefix}.expand", width, hidden)
    yield from _linear(f"{prefix}.contract", hidden, width)


def _trunk(
    config: NetworkConfig, actions: int
) -> Iterator[tuple[str, tuple[int, ...]]]:
    yield from _norm("pooled_norm", config.width)
    yield from _linear("mlp_in", config.width, config.mlp_width)
    for index in range(config.mlp_layers):
        yield from _norm(f"mlp.{index}.norm", config.mlp_width)
        yield from _linear(f"mlp.{index}.linear", config.mlp_width, config.mlp_width)
    yield from _norm("head_norm", config.mlp_width)
    yield from _linear("head", config.mlp_width, actions)
    if config.dueling:
        yield from _linear("value", config.mlp_width, 1)


def layout_hash(layout: Layout) -> str:
    """16 hex digits that two layouts share only if names, shapes and order agree."""
    text = json.dumps([[name, list(shape)] for name, shape in layout])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def parameter_count(layout: Layout) -> int:
    """Length of the weight vector."""
    return sum(math.prod(shape) for _, shape in layout)


def unpack(
    vector: Float[Array, " parameters"], layout: Layout
) -> dict[str, Float[Array, "..."]]:
    """Cuts the vector into named parameters by static slices; free inside jit."""
    if vector.shape[0] != parameter_count(layout):
        raise ValueError(
            f"weight vector of {vector.shape[0]} values, "
            f"this network has {parameter_count(layout)}"
        )
    weights, start = {}, 0
    for name, shape in layout:
        stop = start + math.prod(shape)
        weights[name] = vector[start:stop].reshape(shape)
        start = stop
    return weights


def q_values(
    vector: Float[Array, " parameters"],
    observation: Observation,
    *,
    config: NetworkConfig,
    sizes: ObservationSizes,
    actions: int,
) -> Float[Array, " actions"]:
    """Q-values (or logits) of one observation; batch it with `jax.vmap` or `batched`.

    `in_axes` is None for the vector: the weights are shared by the batch.
    """
    weights = unpack(vector, parameter_layout(config, sizes, actions))
    latents = _read(weights, observation, config, sizes)
    pooled = apply_norm(weights, "pooled_norm", latents.mean(axis=0))
    x = apply_linear(weights, "mlp_in", pooled)
    for index in range(config.mlp_layers):
        hidden = jax.nn.relu(apply_norm(weights, f"mlp.{index}.norm", x))
        x += apply_linear(weights, f"mlp.{index}.linear", hidden)
    x = apply_norm(weights, "head_norm", x)
    values = apply_linear(weights, "head", x)
    if config.dueling:
        above = apply_linear(weights, "value", x) - values.mean(keepdims=True)
        values += jnp.broadcast_to(above, values.shape)
    return values


def batched(
    vector: Float[Array, " parameters"],
    observations: Observation,
    *,
    config: NetworkConfig,
    sizes: ObservationSizes,
    actions: int,
) -> Float[Array, "batch actions"]:
    """`q_values` of a batch: one axis in front of every field of `observations`."""

    def one(observation: Observation) -> Float[Array, " actions"]:
        return q_values(
            vector, observation, config=config, sizes=sizes, actions=actions
        )

    return jax.vmap(one)(observations)


def _read(
    weights: Weights,
    observation: Observation,
    config: NetworkConfig,
    sizes: ObservationSizes,
) -> Float[Array, "latents width"]:
    """What all latents hold in the end."""
    grids = make_grids(weights, observation, sizes, time_axis=config.time_axis)
    groups = encode_tokens(
        weights,
        grids,
        fusion=config.fusion,
        attention=config.attention,
        layers=config.token_layers,
        heads=config.heads,
    )
    ego = apply_linear(weights, "ego_to_latents", observation.ego)
    read = []
    for reader, (tokens, valid) in enumerate(groups):
        first = reader * config.latents
        latents = weights["latents"][first : first + config.latents]
        latents += broadcast_rows(ego, config.latents)
        for index in range(config.cross_layers):
            prefix = f"cross.{reader * config.cross_layers + index}"
            latents = cross_block(
                weights,
                prefix,
                latents,
                tokens,
                valid,
                heads=config.heads,
                may_be_empty=config.readers > 1,
            )
        for index in range(config.self_layers):
            prefix = f"latent.{reader * config.self_layers + index}"
            latents = latent_block(weights, prefix, latents, heads=config.heads)
        read.append(latents)
    return jnp.concatenate(read)


def _linear(name: str, inputs: int, outputs: int) -> Layout:
    return ((f"{name}.weight", (outputs, inputs)), (f"{name}.bias", (outputs,)))


def _norm(name: str, size: int) -> Layout:
    return ((f"{name}.weight", (size,)), (f"{name}.bias", (size,)))
