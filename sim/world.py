"""All objects of one scene as its controlled objects meet them.

The log, overlaid where objects are controlled by their simulated states. A slot of
`View.controlled` that holds the log's number of objects (one past the last row) is
empty: it controls nothing, is never valid, seen or set.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim.bank import Bank


class View(NamedTuple):
    """What the observations of one scene depend on, beside the bank."""

    scene: Int[Array, ""]  # row of the bank
    step: Int[Array, ""]  # of the recording
    controlled: Int[Array, " controlled"]  # rows of the log's objects, or its length
    history: Float[Array, "controlled history 5"]  # x, y, yaw, v_x, v_y; oldest first
    history_valid: Bool[Array, "controlled history"]  # the last of them at `step`


class World(NamedTuple):
    """The last H states of all objects, oldest first; map frame."""

    state: Float[Array, "history objects 5"]  # x, y [m], yaw [rad], v_x, v_y [m/s]
    valid: Bool[Array, "history objects"]
    size: Float[Array, "objects 2"]  # m, length and width now


def world_of(bank: Bank, view: View) -> World:
    """The log's last H steps, each controlled object where it was simulated.

    Before the recording's first step nothing is valid.
    """
    length = view.history.shape[1]
    wanted = view.step - jnp.arange(length - 1, -1, -1)
    steps = jnp.maximum(wanted, 0)
    log = bank.log[view.scene, steps]
    state = jnp.concatenate([log[..., :2], log[..., 3:6]], -1)
    valid = bank.log_valid[view.scene, steps] & (wanted >= 0)[:, None]
    size = log[-1, :, 6:8]
    if view.controlled.shape[0] == 1:
        # Nobody but itself sees where it is, and itself it does not look up here.
        return World(state, valid, size)
    own = view.controlled
    return World(
        state.at[:, own].set(view.history.transpose(1, 0, 2), mode="drop"),
        valid.at[:, own].set(view.history_valid.T, mode="drop"),
        size,
    )


def exists(bank: Bank, controlled: Int[Array, "..."]) -> Bool[Array, "..."]:
    """Whether slots hold an object."""
    return controlled < bank.log.shape[2]


def row_of(bank: Bank, controlled: Int[Array, "..."]) -> Int[Array, "..."]:
    """Rows that can be read: an empty slot's is the last, whatever it holds."""
    return jnp.minimum(controlled, bank.log.shape[2] - 1)
