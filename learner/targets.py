"""The arithmetic of prioritised double Q-learning, pure; torch only.

    y_t   = r_t + discount_t q_target(s_t, argmax_a q_online(s_t, a))
    delta = y_t - q_online(s_tm1, a_tm1)
    l     = 1/2 delta^2            where |delta| <= h
            h (|delta| - h / 2)    elsewhere                                 (Huber)
    w     = (1 / P)^beta / max over the batch of (1 / P)^beta
    loss  = mean over the batch of w l

Double Q-learning: van Hasselt, Guez and Silver, 2016, eq. 4. Prioritised replay:
Schaul et al., 2016, sec. 3.4. The weighted mean is Acme's: it divides by the batch's
size, where torchrl divides by the sum of the weights. `discount_t` is the discount
factor, or 0 if and only if s_t is terminal: a truncated episode still bootstraps.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def double_q_target(
    r_t: Float[Tensor, " batch"],
    discount_t: Float[Tensor, " batch"],
    q_online_t: Float[Tensor, "batch actions"],
    q_target_t: Float[Tensor, "batch actions"],
) -> Float[Tensor, " batch"]:
    """Selects with the online network, evaluates with the target network."""
    a_t = q_online_t.argmax(dim=-1, keepdim=True)
    v_t = q_target_t.gather(-1, a_t).squeeze(-1)
    return (r_t + discount_t * v_t).detach()


def td_error(
    q_tm1: Float[Tensor, "batch actions"],
    a_tm1: Int[Tensor, " batch"],
    target_tm1: Float[Tensor, " batch"],
) -> Float[Tensor, " batch"]:
    """Target minus the value of the action that was taken."""
    return target_tm1 - q_tm1.gather(-1, a_tm1[:, None]).squeeze(-1)


def huber(delta: Float[Tensor, " batch"], threshold: float) -> Float[Tensor, " batch"]:
    """Quadratic up to the threshold, linear with slope `threshold` beyond."""
    size = delta.abs()
    quadratic = size.clamp(max=threshold)
    return 0.5 * quadratic.square() + threshold * (size - quadratic)


def importance_weights(
    probabilities: Float[Tensor, " batch"], exponent: float
) -> Float[Tensor, " batch"]:
    """(1 / P)^exponent, divided by the batch's largest: at most 1."""
    # The largest weight is the least probable item's, so one division gives ratios
    # within [0, 1] where 1 / P could overflow.
    return (probabilities.min() / probabilities).pow(exponent)


def weighted_mean(
    losses: Float[Tensor, " batch"], weights: Float[Tensor, " batch"]
) -> Float[Tensor, ""]:
    """Acme's reduction: mean(w l), not sum(w l) / sum(w)."""
    return torch.mean(weights * losses)
