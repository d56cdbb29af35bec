"""Transition rows: states travel, observations are rendered where they are consumed.

One row is one transition of the controlled object in log-replayed traffic: the scene,
the step t of s_t, the object's last H+1 states (oldest first: the first H belong to
s_tm1, the last H to s_t), what it did and got. Everything else that it saw is a
function of the scene and the step, which every process of the run can look up.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from replay.spec import Field, RowSpec
from sim.bank import Bank
from sim.observation import Observation, ObservationConfig, observe_batch
from sim.world import View


def row_spec(history: int, components: int = 0, n_step: int = 1) -> RowSpec:
    """The layout of a row for `history` states per observation.

    With `components`, rows hold an expert's continuous action of as many, too. With
    `n_step` n above 1 a row spans n steps: H + n states, the first H of s_tm1 and the
    last H of the state n steps later, where `step` is; n rewards and n discounts.
    """
    each = (n_step,) if n_step > 1 else ()
    expert = (Field("continuous", "f4", (components,)),) if components else ()
    return RowSpec(
        (
            Field("scene", "i4"),
            Field("step", "i4"),  # t of s_t
            Field("controlled", "i4"),  # row of the log's objects
            Field("states", "f4", (history + n_step, 5)),  # x, y, yaw, v_x, v_y
            Field("valid", "u1", (history + n_step,)),
            Field("action", "i4"),  # a_tm1, index into the action table
            *expert,  # the same in its own units, see `actors.cloning`
            Field("reward", "f4", each),  # r_t
            Field("discount", "f4", each),  # 1, or 0 if and only if s_t is terminal
            Field("weights_version", "i8"),  # of the policy that acted
            Field("actor", "i4"),
            Field("serial", "i8"),  # the actor's own count of its transitions
        )
    )


class Columns(NamedTuple):
    """The part of a batch of rows that observations are rendered from."""

    scene: Int[Array | np.ndarray, " batch"]
    step: Int[Array | np.ndarray, " batch"]
    controlled: Int[Array | np.ndarray, " batch"]
    states: Float[Array | np.ndarray, "batch states 5"]
    valid: Bool[Array | np.ndarray, "batch states"]


def columns_of(rows: np.ndarray) -> Columns:
    """The columns of a batch of rows, as contiguous arrays."""
    return Columns(
        scene=np.ascontiguousarray(rows["scene"]),
        step=np.ascontiguousarray(rows["step"]),
        controlled=np.ascontiguousarray(rows["controlled"]),
        states=np.ascontiguousarray(rows["states"]),
        valid=rows["valid"].astype(bool),
    )


def render(
    bank: Bank, columns: Columns, config: ObservationConfig
) -> tuple[Observation, Observation]:
    """The observations s_tm1 and s_t of rows, in one call of twice the batch.

    Bit for bit those that the actor acted on: `observe_batch` is the same program
    whatever surrounds it (tested).
    """
    before, after = views_of(columns, config.history)
    both = jax.tree.map(lambda *parts: jnp.concatenate(parts), before, after)
    seen = observe_batch(bank, both, config)
    batch = columns.scene.shape[0]
    first = jax.tree.map(lambda values: values[:batch, 0], seen)
    second = jax.tree.map(lambda values: values[batch:, 0], seen)
    return first, second


def render_before(
    bank: Bank, columns: Columns, config: ObservationConfig
) -> Observation:
    """The observations s_tm1 alone, where the action was chosen."""
    seen = observe_batch(bank, views_of(columns, config.history)[0], config)
    return jax.tree.map(lambda values: values[:, 0], seen)


def views_of(columns: Columns, history: int) -> tuple[View, View]:
    """What is observed at the two ends of each row."""
    states, valid = jnp.asarray(columns.states), jnp.asarray(columns.valid)
    ago = states.shape[1] - history
    after = View(
        scene=jnp.asarray(columns.scene),
        step=jnp.asarray(columns.step),
        controlled=jnp.asarray(columns.controlled)[:, None],
        history=states[:, None, ago:],
        history_valid=valid[:, None, ago:],
    )
    before = after._replace(
        step=after.step - ago,
        history=states[:, None, :history],
        history_valid=valid[:, None, :history],
    )
    return before, after
