"""What the updates of double DQN and of cloning share: device, precision, step, state.

`bfloat16` computes matrix products of the forward and backward passes in bfloat16 where
torch's autocast deems it safe. Weights, gradients, Adam's moments, the outputs of the
network, losses and priorities stay float32. On the CPU it takes a processor with
bfloat16 instructions (AVX512-BF16, AMX) to be faster; elsewhere it is slower.
"""

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn

Precision = Literal["float32", "bfloat16"]


def compute_device(name: str) -> torch.device:
    """The device of that name; `auto` is CUDA's where there is one, else the CPU."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    device = torch.device(name)
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise ValueError(
                f"device={name}: torch finds no CUDA device here; give cpu or auto"
            )
        torch.set_float32_matmul_precision("high")  # TF32; the CPU ignores it
    return device


def make_adam(
    network: nn.Module, *, learning_rate: float, epsilon: float
) -> torch.optim.Adam:
    """Adam over all parameters, in one kernel."""
    # Fused: 0.19 ms a step for the 50 small tensors of `quick`, 0.59 as foreach.
    return torch.optim.Adam(
        network.parameters(), lr=learning_rate, eps=epsilon, fused=True
    )


def in_precision(precision: Precision, device: torch.device) -> torch.autocast:
    """The context in which a network's forward pass computes so."""
    return torch.autocast(
        device.type, dtype=torch.bfloat16, enabled=precision == "bfloat16"
    )


def step_down(
    loss: Tensor, *, network: nn.Module, optimiser: torch.optim.Adam, limit: float
) -> float:
    """One step against the gradient; its norm if it is clipped, or nan.

    Args:
        loss: what is to become less.
        network: whose parameters.
        optimiser: of these.
        limit: gradients are scaled down to this norm over all parameters; 0: never.
    """
    optimiser.zero_grad(set_to_none=True)
    torch.autograd.backward(loss)
    norm = float("nan")
    if limit:
        norm = float(
            nn.utils.clip_grad_norm_(network.parameters(), limit, foreach=True)
        )
    optimiser.step()
    return norm


def training_state(
    modules: Mapping[str, nn.Module], optimiser: torch.optim.Adam, updates: int
) -> dict[str, object]:
    """The whole state, of types that `torch.load(weights_only=True)` reads."""
    networks = {name: module.state_dict() for name, module in modules.items()}
    return {**networks, "optimiser": optimiser.state_dict(), "updates": updates}


def restore_training(
    state: Mapping[str, object],
    modules: Mapping[str, nn.Module],
    optimiser: torch.optim.Adam,
) -> int:
    """Loads what `training_state` gave, and returns its number of updates.

    Hyperparameters stay the optimiser's, so that a resumed run may change them.
    """
    updates, moments = state["updates"], state["optimiser"]
    if not isinstance(updates, int) or not isinstance(moments, dict):
        raise ValueError("not the state of a learner")
    for name, module in modules.items():
        values = state[name]
        if not isinstance(values, dict):
            raise ValueError("not the state of a learner")
        module.load_state_dict(values)
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": moments["state"], "param_groups": groups})
    return updates
