"""The policy network in plain JAX: the actors' twin of `learner.network`.

Per observation, with D the width, Q the latents, T the tokens
(1 ego + neighbours + road rows + lights):

    tokens  = LayerNorm(relu(W_m x_m + b_m) + e_m)      per modality m      [T, D]
    latents = learned + W_e ego + b_e                                       [Q, D]
    cross   : latents += attend(LayerNorm(latents), tokens, mask)
              latents += feedforward(LayerNorm(latents))    `cross_layers` times
    self    : the same, latents attending over latents      `self_layers` times
    x       = W LayerNorm(mean of latents) + b                              [mlp_width]
    x      += W relu(LayerNorm(x)) + b                      `mlp_layers` times
    Q-values = W LayerNorm(x) + b                                           [actions]

The encoder is Wayformer's early fusion with latent queries (Nayakanti et al., 2022:
projection by relu, pre-normalisation, padding masked), the trunk the 4-layer residual
MLP that the Waymax paper puts on it. The feed-forward is GELU in its tanh form. Tokens
are a set: no slot has an embedding of its own.

Departures from Wayformer: the ego state is also added to the latents, so that the
residual path carries it; tokens are normalised once, not once per layer; the readout
is the mean of the latents.

Cross-attention is multi-head attention in another order of multiplication. A head's
scores are (W_q l) . (W_k t) = (W_k^T W_q l) . t, and its output is
W_v (sum_t a_t t) + b_v because the weights a_t sum to 1: keys and values of the many
tokens are never formed, only the few queries are multiplied. A key bias would add the
same number to all scores of a query, so there is none.

Weights are one float32 vector in the order of `parameter_layout`, which is the torch
module's `state_dict` order; `unpack` cuts it by static slices inside jit.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sim.observation import Observation, ObservationSizes

Layout = tuple[tuple[str, tuple[int, ...]], ...]
Weights = Mapping[str, Float[Array, "..."]]

NORM_EPSILON = 1e-5
MASKED = -1e9  # a score so low that its weight is exactly 0; finite, or 0 * inf is NaN
MODALITIES = ("ego", "agents", "road", "lights")


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Sizes of the policy network. The defaults are the preset `quick`."""

    width: int = 64
    """Features of a token and of a latent (D)."""

    heads: int = 4
    """Attention heads; they divide `width`."""

    latents: int = 4
    """Learned queries (Q) that read the tokens."""

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

    def __post_init__(self) -> None:
        """Refuses sizes that make no network."""
        for name in ("width", "heads", "latents", "cross_layers", "feedforward"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)} must be at least 1")
        if self.self_layers < 0 or self.mlp_layers < 0 or self.mlp_width < 1:
            raise ValueError(
                f"self_layers={self.self_layers} and mlp_layers={self.mlp_layers} "
                f"must be at least 0, mlp_width={self.mlp_width} at least 1"
            )
        if self.width % self.heads:
            raise ValueError(
                f"heads={self.heads} must divide width={self.width}: "
                "choose a multiple of heads as width"
            )


def parameter_layout(
    config: NetworkConfig, sizes: ObservationSizes, actions: int
) -> Layout:
    """Names and shapes of all parameters, in torch's `state_dict` order."""
    width, hidden = config.width, config.width * config.feedforward
    features = (sizes.ego, sizes.agent, sizes.road, sizes.light)

    def attention_block(prefix: str, projections: Layout) -> Iterator[Layout]:
        yield _norm(f"{prefix}.query_norm", width)
        yield tuple((f"{prefix}.{name}", shape) for name, shape in projections)
        yield _linear(f"{prefix}.out", width, width)
        yield _norm(f"{prefix}.feedforward_norm", width)
        yield _linear(f"{prefix}.expand", width, hidden)
        yield _linear(f"{prefix}.contract", hidden, width)

    def parts() -> Iterator[Layout]:
        yield (
            ("modality", (len(MODALITIES), width)),
            ("latents", (config.latents, width)),
        )
        for name, size in zip(MODALITIES, features, strict=True):
            yield _linear(f"project.{name}", size, width)
        yield _linear("ego_to_latents", sizes.ego, width)
        yield _norm("token_norm", width)
        cross = _linear("query", width, width) + _linear("key", width, width)[:1]
        cross += _linear("value", width, width)
        for index in range(config.cross_layers):
            yield from attention_block(f"cross.{index}", cross)
        for index in range(config.self_layers):
            yield from attention_block(
                f"latent.{index}", _linear("query_key_value", width, 3 * width)
            )
        yield _norm("pooled_norm", width)
        yield _linear("mlp_in", width, config.mlp_width)
        for index in range(config.mlp_layers):
            yield _norm(f"mlp.{index}.norm", config.mlp_width)
            yield _linear(f"mlp.{index}.linear", config.mlp_width, config.mlp_width)
        yield _norm("head_norm", config.mlp_width)
        yield _linear("head", config.mlp_width, actions)

    return tuple(itertools.chain.from_iterable(parts()))


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
    tokens, valid = _tokens(weights, observation)
    latents = weights["latents"] + _broadcast_rows(
        _apply_linear(weights, "ego_to_latents", observation.ego), config.latents
    )
    for index in range(config.cross_layers):
        prefix = f"cross.{index}"
        query = _apply_norm(weights, f"{prefix}.query_norm", latents)
        latents += _cross_attention(
            weights, prefix, query, tokens, valid, heads=config.heads
        )
        latents += _feedforward(weights, prefix, latents)
    for index in range(config.self_layers):
        prefix = f"latent.{index}"
        query = _apply_norm(weights, f"{prefix}.query_norm", latents)
        latents += _self_attention(weights, prefix, query, heads=config.heads)
        latents += _feedforward(weights, prefix, latents)
    pooled = _apply_norm(weights, "pooled_norm", latents.mean(axis=0))
    x = _apply_linear(weights, "mlp_in", pooled)
    for index in range(config.mlp_layers):
        hidden = jax.nn.relu(_apply_norm(weights, f"mlp.{index}.norm", x))
        x += _apply_linear(weights, f"mlp.{index}.linear", hidden)
    return _apply_linear(weights, "head", _apply_norm(weights, "head_norm", x))


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


def _linear(name: str, inputs: int, outputs: int) -> Layout:
    return ((f"{name}.weight", (outputs, inputs)), (f"{name}.bias", (outputs,)))


def _norm(name: str, size: int) -> Layout:
    return ((f"{name}.weight", (size,)), (f"{name}.bias", (size,)))


def _broadcast_rows(
    row: Float[Array, " features"], rows: int
) -> Float[Array, "rows features"]:
    return jnp.broadcast_to(row[None, :], (rows, row.shape[0]))


def _apply_linear(
    weights: Weights, name: str, x: Float[Array, "*rows inputs"]
) -> Float[Array, "*rows outputs"]:
    y = x @ weights[f"{name}.weight"].T
    return y + jnp.broadcast_to(weights[f"{name}.bias"], y.shape)


def _apply_norm(
    weights: Weights, name: str, x: Float[Array, "*rows features"]
) -> Float[Array, "*rows features"]:
    centred = x - x.mean(axis=-1, keepdims=True)
    variance = jnp.square(centred).mean(axis=-1, keepdims=True)
    scale = jnp.broadcast_to(weights[f"{name}.weight"], x.shape)
    shift = jnp.broadcast_to(weights[f"{name}.bias"], x.shape)
    return centred * jax.lax.rsqrt(variance + NORM_EPSILON) * scale + shift


def _tokens(
    weights: Weights, observation: Observation
) -> tuple[Float[Array, "tokens width"], Bool[Array, " tokens"]]:
    rows = {
        "ego": observation.ego[None, :],
        "agents": observation.agents,
        "road": observation.road,
        "lights": observation.lights,
    }
    parts = [
        jax.nn.relu(_apply_linear(weights, f"project.{name}", features))
        + _broadcast_rows(weights["modality"][index], features.shape[0])
        for index, (name, features) in enumerate(rows.items())
    ]
    valid = jnp.concatenate(
        [
            jnp.ones(1, jnp.bool_),
            observation.agents_valid,
            observation.road_valid,
            observation.lights_valid,
        ]
    )
    return _apply_norm(weights, "token_norm", jnp.concatenate(parts)), valid


def _cross_attention(
    weights: Weights,
    prefix: str,
    query: Float[Array, "latents width"],
    tokens: Float[Array, "tokens width"],
    valid: Bool[Array, " tokens"],
    *,
    heads: int,
) -> Float[Array, "latents width"]:
    latents, width = query.shape
    split = width // heads
    q = _apply_linear(weights, f"{prefix}.query", query)
    q = q.reshape(latents, heads, split) * (split**-0.5)
    key = weights[f"{prefix}.key.weight"].reshape(heads, split, width)
    value = weights[f"{prefix}.value.weight"].reshape(heads, split, width)
    q = jnp.einsum("qhs,hsd->hqd", q, key).reshape(heads * latents, width)
    scores = q @ tokens.T
    masked = jnp.where(jnp.broadcast_to(valid, scores.shape), scores, MASKED)
    pooled = (jax.nn.softmax(masked, axis=-1) @ tokens).reshape(heads, latents, width)
    y = jnp.einsum("hqd,hsd->qhs", pooled, value).reshape(latents, width)
    y += jnp.broadcast_to(weights[f"{prefix}.value.bias"], y.shape)
    return _apply_linear(weights, f"{prefix}.out", y)


def _self_attention(
    weights: Weights,
    prefix: str,
    query: Float[Array, "latents width"],
    *,
    heads: int,
) -> Float[Array, "latents width"]:
    latents, width = query.shape
    split = width // heads
    qkv = _apply_linear(weights, f"{prefix}.query_key_value", query)
    q, k, v = qkv.reshape(latents, 3, heads, split).transpose(1, 2, 0, 3)
    scores = jnp.einsum("hqs,hks->hqk", q, k) * (split**-0.5)
    y = jnp.einsum("hqk,hks->qhs", jax.nn.softmax(scores, axis=-1), v)
    return _apply_linear(weights, f"{prefix}.out", y.reshape(latents, width))


def _feedforward(
    weights: Weights, prefix: str, x: Float[Array, "rows width"]
) -> Float[Array, "rows width"]:
    hidden = _apply_norm(weights, f"{prefix}.feedforward_norm", x)
    hidden = _apply_linear(weights, f"{prefix}.expand", hidden)
    hidden = jax.nn.gelu(hidden, approximate=True)
    return _apply_linear(weights, f"{prefix}.contract", hidden)
