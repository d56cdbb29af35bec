"""What the updates of double DQN and of cloning share: device, precision, step, state.

`bfloat16` computes matrix products of the forward and backward passes in bfloat16 where
torch's autocast deems it safe. Weights, gradients, Adam's moments, the outputs of the
network, losses and priorities stay float32. On the CPU it takes a processor with
bfloat16 instructions (AVX512-BF16, AMX) to be faster; elsewhere it is slower.

The parameters of a module lie in one vector: the optimiser's step, the copy to a target
network and an average are one kernel each, whatever the number of layers. What is saved
is by layer, as without.
"""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor, nn

from replay.allocator import MMAP_THRESHOLD, TRIM_THRESHOLD, tell_malloc

Precision = Literal["float32", "bfloat16-targets", "bfloat16"]


def keep_memory() -> bool:
    """Keeps freed memory in the process, where the C library can be told to.

    An update's tensors are freed when it ends. glibc hands those of megabytes back to
    the system and gets new pages for the next update, all zeroed and all faults:
    17,000 to 20,000 of them in an update of preset `paper`, a tenth of whose CPU time
    was the system's. Kept, they are the most that the process ever held at once.
    """
    kept = tell_malloc(MMAP_THRESHOLD, 2**30)
    return tell_malloc(TRIM_THRESHOLD, 2**31 - 1) and kept


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


def flatten(module: nn.Module) -> Tensor:
    """Moves a module's parameters into one vector, of which they become parts."""
    parameters = list(module.parameters())
    vector = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
    for parameter, part in zip(parameters, parts(vector, module), strict=True):
        parameter.data = part
    return vector


def parts(vector: Tensor, module: nn.Module) -> list[Tensor]:
    """Views of a vector as the module's parameters."""
    parameters = list(module.parameters())
    cut = torch.split(vector, [parameter.numel() for parameter in parameters])
    return [
        part.view(parameter.shape)
        for part, parameter in zip(cut, parameters, strict=True)
    ]


def make_adam(
    network: nn.Module, *, learning_rate: float, epsilon: float
) -> torch.optim.Adam:
    """Adam over all parameters, which it moves into one vector."""
    vector = nn.Parameter(flatten(network))
    vector.grad = torch.zeros_like(vector)
    gradients = parts(vector.grad, network)
    for parameter, gradient in zip(network.parameters(), gradients, strict=True):
        parameter.grad = gradient
    # Its count of steps has to be on the device for a CUDA graph to advance it.
    return torch.optim.Adam(
        [vector], lr=learning_rate, eps=epsilon, fused=True, capturable=vector.is_cuda
    )


def vector_of(optimiser: torch.optim.Adam) -> nn.Parameter:
    """All parameters, as `make_adam` laid them out; its gradient is theirs."""
    vector: nn.Parameter = optimiser.param_groups[0]["params"][0]
    return vector


def in_precision(
    precision: Precision, device: torch.device, *, learns: bool = True
) -> torch.autocast:
    """The context in which a network's forward pass computes so.

    `learns`: the pass is one that a gradient is taken of.
    """
    least = precision == "bfloat16" or (not learns and precision == "bfloat16-targets")
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=least)


def step_down(
    loss: Tensor, *, network: nn.Module, optimiser: torch.optim.Adam, limit: float
) -> Tensor:
    """One step against the gradient; its norm if it is clipped, or nan.

    Args:
        loss: what is to become less.
        network: whose parameters.
        optimiser: of these.
        limit: gradients are scaled down to this norm over all parameters; 0: never.
    """
    vector = vector_of(optimiser)
    assert vector.grad is not None
    gradients = torch.autograd.grad(loss, list(network.parameters()))
    torch.cat([gradient.reshape(-1) for gradient in gradients], out=vector.grad)
    norm = torch.full_like(loss, torch.nan)
    if limit:
        norm = nn.utils.clip_grad_norm_(vector, limit, foreach=True)
    optimiser.step()
    return norm.detach()


def training_state(
    modules: Mapping[str, nn.Module], optimiser: torch.optim.Adam, updates: int
) -> dict[str, object]:
    """The whole state, of types that `torch.load(weights_only=True)` reads.

    `modules` has the one that is optimised under `network`.
    """
    networks = {name: module.state_dict() for name, module in modules.items()}
    moments = optimiser.state_dict()
    for values in list(moments["state"].values()):
        by_layer = [
            {"exp_avg": mean, "exp_avg_sq": square, "step": values["step"]}
            for mean, square in zip(
                parts(values["exp_avg"], modules["network"]),
                parts(values["exp_avg_sq"], modules["network"]),
                strict=True,
            )
        ]
        moments["state"] = dict(enumerate(by_layer))
    return {**networks, "optimiser": moments, "updates": updates}


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
    whole = _joined(moments["state"])
    optimiser.load_state_dict({"state": whole, "param_groups": groups})
    return updates


def _joined(by_layer: Mapping[int, Mapping[str, Tensor]]) -> dict[int, dict[str, Any]]:
    """The moments of all layers as those of one vector; none before the first step."""
    layers = [by_layer[index] for index in sorted(by_layer)]
    if not layers:
        return {}
    joined = {
        name: torch.cat([layer[name].reshape(-1) for layer in layers])
        for name in ("exp_avg", "exp_avg_sq")
    }
    return {0: {**joined, "step": layers[0]["step"].clone()}}
