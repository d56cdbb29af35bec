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
    """The last H states of some or all objects, oldest first; map frame."""

    motion: Float[Array, "objects history 6"]  # x, y [m], cos, sin, v_x, v_y [m/s]
    valid: Bool[Array, "objects history"]
    size: Float[Array, "objects 2"]  # m, length and width now
    kind: Int[Array, " objects"]  # `ObjectType`


def logged_world(bank: Bank, view: View, rows: Int[Array, " objects"]) -> World:
    """Some objects as the log has them; nothing is valid before its first step."""
    length = view.history.shape[1]
    wanted = view.step - jnp.arange(length - 1, -1, -1)
    steps = jnp.maximum(wanted, 0)[None]
    log = bank.log[view.scene, steps, rows[:, None]]
    return World(
        motion=_motion(log[..., :2], log[..., 3], log[..., 4:6]),
        valid=bank.log_valid[view.scene, steps, rows[:, None]] & (wanted >= 0)[None],
        size=log[:, -1, 6:8],
        kind=bank.object_type[view.scene, rows],
    )


def world_of(bank: Bank, view: View) -> World:
    """All objects, the controlled ones where they were simulated."""
    rows = jnp.arange(bank.log.shape[2], dtype=jnp.int32)
    logged = logged_world(bank, view, rows)
    own, history = view.controlled, view.history
    simulated = _motion(history[..., :2], history[..., 2], history[..., 3:])
    return logged._replace(
        motion=logged.motion.at[own].set(simulated, mode="drop"),
        valid=logged.valid.at[own].set(view.history_valid, mode="drop"),
    )


def simulated_world(bank: Bank, view: View, rows: Int[Array, " objects"]) -> World:
    """Some objects, those that are controlled where they were simulated."""
    logged = logged_world(bank, view, rows)
    same = rows[:, None] == view.controlled[None]
    controlled, slot = same.any(1), jnp.argmax(same, 1)
    history = view.history[slot]
    simulated = _motion(history[..., :2], history[..., 2], history[..., 3:])
    return logged._replace(
        motion=jnp.where(controlled[:, None, None], simulated, logged.motion),
        valid=jnp.where(controlled[:, None], view.history_valid[slot], logged.valid),
    )


def _motion(
    position: Float[Array, "objects history 2"],
    yaw: Float[Array, "objects history"],
    velocity: Float[Array, "objects history 2"],
) -> Float[Array, "objects history 6"]:
    heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], -1)
    return jnp.concatenate([position, heading, velocity], -1)


def exists(bank: Bank, controlled: Int[Array, "..."]) -> Bool[Array, "..."]:
    """Whether slots hold an object."""
    return controlled < bank.log.shape[2]


def row_of(bank: Bank, controlled: Int[Array, "..."]) -> Int[Array, "..."]:
    """Rows that can be read: an empty slot's is the last, whatever it holds."""
    return jnp.minimum(controlled, bank.log.shape[2] - 1)
