"""The layers of the policy network in plain JAX, for one observation.

Cross-attention is multi-head attention in another order of multiplication. A head's
scores are (W_q l) . (W_k t) = (W_k^T W_q l) . t, and its output is
W_v (sum_t a_t t) + b_v because the weights a_t sum to 1: keys and values of the many
tokens are never formed, only the few queries are multiplied. A key bias would add the
same number to all scores of a query, so there is none.

Who attends to nothing but padding adds nothing: the softmax over an all-False mask is
uniform over the padding, and would let its values through.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Weights = Mapping[str, Float[Array, "..."]]

NORM_EPSILON = 1e-5
MASKED = -1e9  # a score so low that its weight is exactly 0; finite, or 0 * inf is NaN


def broadcast_rows(
    row: Float[Array, " features"], rows: int
) -> Float[Array, "rows features"]:
    """The same row `rows` times."""
    return jnp.broadcast_to(row[None, :], (rows, row.shape[0]))


def apply_linear(
    weights: Weights, name: str, x: Float[Array, "*rows inputs"]
) -> Float[Array, "*rows outputs"]:
    """W x + b of the last axis."""
    y = x @ weights[f"{name}.weight"].T
    return y + jnp.broadcast_to(weights[f"{name}.bias"], y.shape)


def apply_norm(
    weights: Weights, name: str, x: Float[Array, "*rows features"]
) -> Float[Array, "*rows features"]:
    """Layer normalisation of the last axis."""
    centred = x - x.mean(axis=-1, keepdims=True)
    variance = jnp.square(centred).mean(axis=-1, keepdims=True)
    scale = jnp.broadcast_to(weights[f"{name}.weight"], x.shape)
    shift = jnp.broadcast_to(weights[f"{name}.bias"], x.shape)
    return centred * jax.lax.rsqrt(variance + NORM_EPSILON) * scale + shift


def cross_block(
    weights: Weights,
    prefix: str,
    latents: Float[Array, "latents width"],
    tokens: Float[Array, "tokens width"],
    valid: Bool[Array, " tokens"],
    *,
    heads: int,
    may_be_empty: bool,
) -> Float[Array, "latents width"]:
    """Latents attend over tokens, then feed forward; both pre-norm and residual."""
    query = apply_norm(weights, f"{prefix}.query_norm", latents)
    told = _cross_attention(weights, prefix, query, tokens, valid, heads=heads)
    latents += jnp.where(valid.any(), told, 0.0) if may_be_empty else told
    return latents + _feedforward(weights, prefix, latents)


def latent_block(
    weights: Weights,
    prefix: str,
    latents: Float[Array, "latents width"],
    *,
    heads: int,
    valid: Bool[Array, " latents"] | None = None,
) -> Float[Array, "latents width"]:
    """Rows attend over each other, then feed forward; `valid` hides padded rows."""
    query = apply_norm(weights, f"{prefix}.query_norm", latents)
    told = _self_attention(weights, prefix, query, valid, heads=heads)
    latents += told if valid is None else jnp.where(valid.any(), told, 0.0)
    return latents + _feedforward(weights, prefix, latents)


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
    q = apply_linear(weights, f"{prefix}.query", query)
    q = q.reshape(latents, heads, split) * (split**-0.5)
    key = weights[f"{prefix}.key.weight"].reshape(heads, split, width)
    value = weights[f"{prefix}.value.weight"].reshape(heads, split, width)
    q = jnp.einsum("qhs,hsd->hqd", q, key).reshape(heads * latents, width)
    scores = q @ tokens.T
    masked = jnp.where(jnp.broadcast_to(valid, scores.shape), scores, MASKED)
    pooled = (jax.nn.softmax(masked, axis=-1) @ tokens).reshape(heads, latents, width)
    y = jnp.einsum("hqd,hsd->qhs", pooled, value).reshape(latents, width)
    y += jnp.broadcast_to(weights[f"{prefix}.value.bias"], y.shape)
    return apply_linear(weights, f"{prefix}.out", y)


def _self_attention(
    weights: Weights,
    prefix: str,
    query: Float[Array, "latents width"],
    valid: Bool[Array, " latents"] | None,
    *,
    heads: int,
) -> Float[Array, "latents width"]:
    latents, width = query.shape
    split = width // heads
    qkv = apply_linear(weights, f"{prefix}.query_key_value", query)
    q, k, v = qkv.reshape(latents, 3, heads, split).transpose(1, 2, 0, 3)
    scores = jnp.einsum("hqs,hks->hqk", q, k) * (split**-0.5)
    if valid is not None:
        scores = jnp.where(jnp.broadcast_to(valid, scores.shape), scores, MASKED)
    y = jnp.einsum("hqk,hks->qhs", jax.nn.softmax(scores, axis=-1), v)
    return apply_linear(weights, f"{prefix}.out", y.reshape(latents, width))


def _feedforward(
    weights: Weights, prefix: str, x: Float[Array, "rows width"]
) -> Float[Array, "rows width"]:
    hidden = apply_norm(weights, f"{prefix}.feedforward_norm", x)
    hidden = apply_linear(weights, f"{prefix}.expand", hidden)
    hidden = jax.nn.gelu(hidden, approximate=True)
    return apply_linear(weights, f"{prefix}.contract", hidden)
