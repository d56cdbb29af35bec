"""Which devices the processes of a run compute on, and how they share a GPU.

JAX takes three quarters of a GPU's memory when it starts, for itself: a second process,
or torch, then finds none. A run has several processes on one machine, so memory is
taken as it is needed, unless the user's own setting says otherwise.
"""

import os
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import Final

PREALLOCATE: Final = "XLA_PYTHON_CLIENT_PREALLOCATE"


def share_gpu(environment: MutableMapping[str, str] = os.environ) -> None:
    """For this process and those it starts; before JAX is imported."""
    environment.setdefault(PREALLOCATE, "false")


@dataclass(frozen=True)
class Devices:
    """What the two libraries find."""

    cuda: tuple[str, ...]  # names of torch's
    jax: tuple[str, ...]  # names of the default backend's
    backend: str  # cpu, gpu or tpu

    def use(self) -> str:
        """What a run would use, in words."""
        learner = "cpu"
        if self.cuda:
            learner = f"{self.cuda[0]} by --learner.device auto, else cpu"
        return f"learner on {learner}; actors and rendering on {', '.join(self.jax)}"

    def advice(self, environment: Mapping[str, str] = os.environ) -> str:
        """What keeps the two from sharing a GPU; empty if nothing does."""
        if bool(self.cuda) != (self.backend == "gpu"):
            lacks, has = ("jax", "torch") if self.cuda else ("torch", "jax")
            return f"{has} finds a GPU and {lacks} none: install its CUDA build"
        if self.cuda and environment.get(PREALLOCATE) != "false":
            return f"{PREALLOCATE} is not false: JAX takes most memory for itself"
        return ""


def find_devices() -> Devices:
    """Asks torch, where it is installed, and JAX."""
    import jax

    try:
        import torch
    except ImportError:
        cuda: tuple[str, ...] = ()
    else:
        count = torch.cuda.device_count()
        cuda = tuple(torch.cuda.get_device_name(index) for index in range(count))
    found = jax.devices()
    return Devices(
        cuda=cuda,
        jax=tuple(dict.fromkeys(device.device_kind for device in found)),
        backend=jax.default_backend(),
    )
