"""The trained policy: read from a checkpoint without torch, and driving by it."""

import json
import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from actors.cloning import cloned
from actors.mixture import Choice, policy_outputs
from actors.network import (
    NetworkConfig,
    layout_hash,
    parameter_count,
    parameter_layout,
)
from sim.agents import Agent
from sim.environment import EnvironmentConfig
from sim.observation import ObservationSizes, observation_sizes

POLICY = "policy.npz"
LATEST = "latest"
BEST = "best"  # of a run that keeps its best checkpoint aside


class PolicyError(Exception):
    """A policy cannot be read or used; the message says what, where, what to do."""


@dataclass(frozen=True)
class Policy:
    """Weights with what they are the weights of."""

    vector: Float[np.ndarray, " parameters"]
    network: NetworkConfig
    sizes: ObservationSizes
    actions: int  # outputs of the network
    extra: dict[str, Any]  # what the run put beside it, its configuration
    mixture: int = 0  # components that the outputs are; 0: one output for each action

    def check(self, environment: EnvironmentConfig, where: Path) -> None:
        """Refuses an environment that this policy does not fit."""
        sizes = observation_sizes(environment.observation)
        outputs = policy_outputs(environment.action, self.mixture)
        if (self.sizes, self.actions) != (sizes, outputs):
            raise PolicyError(
                f"checkpoint {where} is of another network: it reads "
                f"{self.sizes} and has {self.actions} outputs, the environment gives "
                f"{sizes} and {outputs}; use the run's own config.json"
            )


def find_policy(path: Path) -> Path:
    """The `policy.npz` that a user means by a run, its checkpoints, or one of them."""
    for folder in (path, path / BEST, path / "checkpoints"):
        pointer = folder / LATEST
        if pointer.is_file():
            path = folder / pointer.read_text().strip()
            break
    file = path if path.name == POLICY else path / POLICY
    if not file.is_file():
        raise PolicyError(
            f"{path}: no checkpoint there (looked for {POLICY}); name a run folder, a "
            "checkpoint in it, or one of the built-in agents"
        )
    return file


# What numpy, zipfile and json raise for files that are cut, damaged or of another kind.
_UNREADABLE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    NotImplementedError,
    zipfile.BadZipFile,
    zlib.error,
    msgspec.ValidationError,
)


def read_policy(path: Path) -> Policy:
    """Reads a policy, whichever of its folders is named."""
    file = find_policy(path)
    try:
        with np.load(file, allow_pickle=False) as arrays:
            named = str(arrays["layout_hash"])
            policy = Policy(
                vector=_weights(arrays["vector"]),
                network=_network(arrays["network"]),
                sizes=ObservationSizes(**_whole_numbers(arrays["sizes"])),
                actions=int(arrays["actions"]),
                extra=json.loads(str(arrays["extra"])),
                mixture=int(arrays["mixture"]) if "mixture" in arrays else 0,
            )
    except _UNREADABLE as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise PolicyError(
            f"{file}: cannot be read as a policy ({reason}); it is damaged or of "
            "another version: use another checkpoint"
        ) from error
    layout = parameter_layout(policy.network, policy.sizes, policy.actions)
    if layout_hash(layout) != named or policy.vector.shape != (
        parameter_count(layout),
    ):
        raise PolicyError(
            f"{file}: its weights are laid out for another network ({named}, this "
            f"program lays it out as {layout_hash(layout)}); use another checkpoint"
        )
    return policy


def _weights(vector: np.ndarray) -> np.ndarray:
    """The vector, if it is one; ValueError else."""
    if vector.ndim != 1 or vector.dtype != np.float32:
        raise ValueError(f"weights are {vector.dtype} of shape {vector.shape}")
    return vector


def _network(text: np.ndarray) -> NetworkConfig:
    """The network's sizes; fields that an older version lacked have their defaults."""
    values = json.loads(str(text))
    unknown = values.keys() - {field.name for field in fields(NetworkConfig)}
    if unknown:
        raise ValueError(f"unknown {', '.join(sorted(unknown))}")
    return msgspec.convert(values, NetworkConfig)


def _whole_numbers(text: np.ndarray) -> dict[str, int]:
    """A JSON object of whole numbers; ValueError else."""
    values = json.loads(str(text))
    if any(type(value) is not int for value in values.values()):
        raise ValueError(f"{values} are not all whole numbers")
    return dict(values)


def greedy(
    vector: Float[Array, " parameters"],
    network: NetworkConfig,
    config: EnvironmentConfig,
    slots: int | None = None,
) -> Agent:
    """Takes the action of the highest Q-value for every controlled object.

    With `slots` for the first ones only (`actors.cloning.cloned`).
    """
    return cloned(vector, network, config, components=0, slots=slots)


def policy_agent(
    policy: Policy,
    config: EnvironmentConfig,
    choice: Choice = "mode",
    slots: int | None = None,
) -> Agent:
    """Drives by a policy, whatever it was trained by; Q-values greedily by default."""
    return cloned(
        jnp.asarray(policy.vector),
        policy.network,
        config,
        components=policy.mixture,
        choice=choice,
        slots=slots,
    )


def random_vector(
    key: PRNGKeyArray, network: NetworkConfig, config: EnvironmentConfig
) -> Float[Array, " parameters"]:
    """Weights of an untrained network: norms at 1, the rest normal by fan-in."""
    sizes = observation_sizes(config.observation)
    parts = []
    layout = parameter_layout(network, sizes, config.action.count)
    for name, shape in layout:
        key, own_key = jax.random.split(key)
        if len(shape) > 1:
            scale = shape[-1] ** -0.5
            parts.append((jax.random.normal(own_key, shape) * scale).ravel())
        else:
            norm = name.endswith("norm.weight")
            parts.append(jnp.full(shape, 1.0 if norm else 0.0))
    return jnp.concatenate(parts)
