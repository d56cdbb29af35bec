"""The layers of the policy network in torch; `actors.network_blocks` is the JAX twin.

A mask is a bias on the scores, 0 or `MASKED`. Who attends to nothing but padding adds
nothing; `some` says who attends to anything, and is None where everyone does.

The last block hands out the mean of its latents (`pooled`), which is all that is read
of them: the feed-forward's second product is linear, so it is taken of the mean.
"""

from collections.abc import Callable
from typing import Final, final

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from actors.network import NetworkConfig
from actors.network_blocks import MASKED, NORM_EPSILON

# Inductor's own kernel for a linear layer and what follows it; torch has no public
# name for it, so it may be gone in another version.
_LINEAR_THEN: Final[Callable[..., Tensor] | None] = getattr(
    torch.ops.mkldnn, "_linear_pointwise", None
)


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
        some: Bool[Tensor, "batch 1 1"] | None = None,
        *,
        pooled: bool = False,
    ) -> Float[Tensor, "batch *latents width"]:
        """Adds what the latents read."""
        count, width = latents.shape[1:]
        q = self.query(self.query_norm(latents))
        # Of few latents, keys and values of the tokens are never formed (see the
        # twin): 1.27 times as fast forward and backward for 4 latents, 1.1 for 8;
        # for the 32 of `paper`, a third of its width and 4 heads, 0.94 times.
        few = 2 * count * self.heads <= width
        told = self._folded(q, tokens, bias) if few else self._formed(q, tokens, bias)
        told = self.out(told)
        latents = latents + (told if some is None else told * some)
        return _feedforward(self, latents, pooled=pooled)

    def _formed(
        self,
        q: Float[Tensor, "batch latents width"],
        tokens: Float[Tensor, "batch tokens width"],
        bias: Float[Tensor, "batch 1 tokens"],
    ) -> Float[Tensor, "batch latents width"]:
        """Multi-head attention in the textbook's order."""

        def split(x: Tensor) -> Tensor:
            return x.view(*x.shape[:2], self.heads, -1).transpose(1, 2)

        keys, values = split(self.key(tokens)), split(self.value(tokens))
        y = _attend(split(q), keys, values, bias[:, None])
        return y.transpose(1, 2).reshape(q.shape)

    def _folded(
        self,
        q: Float[Tensor, "batch latents width"],
        tokens: Float[Tensor, "batch tokens width"],
        bias: Float[Tensor, "batch 1 tokens"],
    ) -> Float[Tensor, "batch latents width"]:
        """The same, tokens multiplied by what the queries are multiplied with."""
        batch, count, width = q.shape
        heads, split = self.heads, width // self.heads
        rows = batch * count
        q = q.view(rows, heads, split)
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
        return y.transpose(0, 1).reshape(batch, count, width)


@final
class LatentBlock(nn.Module):
    """Rows attend over each other, then feed forward; pre-norm and residual."""

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
        self,
        latents: Float[Tensor, "batch latents width"],
        valid: Bool[Tensor, "batch latents"] | None = None,
        *,
        pooled: bool = False,
    ) -> Float[Tensor, "batch *latents width"]:
        """Adds what the rows tell each other; `valid` hides padded ones."""
        batch, count, width = latents.shape
        qkv = self.query_key_value(self.query_norm(latents))
        qkv = qkv.view(batch, count, 3, self.heads, width // self.heads)
        mask = None if valid is None else mask_bias(valid)[:, None]
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        y = _attend(q, k, v, mask)
        told = self.out(y.transpose(1, 2).reshape(batch, count, width))
        if valid is not None:
            told = told * valid.any(-1)[:, None, None]
        return _feedforward(self, latents + told, pooled=pooled)


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


def mask_bias(valid: Bool[Tensor, "batch tokens"]) -> Float[Tensor, "batch 1 tokens"]:
    """0 where valid, else `MASKED`."""
    # MASKED added to a score of unit size is MASKED within rounding, and its
    # exponential is exactly 0.
    return (~valid).to(torch.float32).mul_(MASKED)[:, None, :]


def _attend(
    q: Float[Tensor, "batch heads rows split"],
    k: Float[Tensor, "batch heads others split"],
    v: Float[Tensor, "batch heads others split"],
    mask: Float[Tensor, "batch 1 1 others"] | None,
) -> Float[Tensor, "batch heads rows split"]:
    """Each row's mean of the others' values, weighed by its scores."""
    if q.dtype != torch.bfloat16 or q.is_cuda:
        return F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    # The CPU's kernel takes 6 times as long forward and backward in bfloat16 as this
    # (20.6 and 3.1 ms, 64 x 4 heads of 32 rows), and in float32 about as long.
    scores = q @ (k * q.shape[-1] ** -0.5).transpose(-2, -1)
    return (scores if mask is None else scores + mask).softmax(-1).to(v.dtype) @ v


def _feedforward(
    block: CrossBlock | LatentBlock,
    x: Float[Tensor, "batch latents width"],
    *,
    pooled: bool,
) -> Float[Tensor, "batch *latents width"]:
    """x + the feed-forward of x, or the mean of that over the latents."""
    hidden = _expanded(block.expand, block.feedforward_norm(x))
    if pooled:
        hidden, x = hidden.mean(dim=1), x.mean(dim=1)
    y: Tensor = x + block.contract(hidden)
    return y


def _expanded(
    linear: nn.Linear, x: Float[Tensor, "batch rows width"]
) -> Float[Tensor, "batch rows hidden"]:
    """The feed-forward's hidden units, GELU in its tanh form."""
    if (
        _LINEAR_THEN is None
        or torch.is_grad_enabled()
        or x.is_cuda
        or x.dtype != torch.float32
        or torch.is_autocast_enabled("cpu")
    ):
        return F.gelu(linear(x), approximate="tanh")
    # Where no gradient asks for what is between the two, oneDNN does both at once, in
    # 0.7 to 0.8 of the time at the three presets' sizes.
    y: Tensor = _LINEAR_THEN(x, linear.weight, linear.bias, "gelu", [], "tanh")
    return y
