"""Transition rows: states travel, observations are rendered where they are consumed.

One row is one transition of one controlled object: the scene, the step t of s_t, the
object's last H+1 states (oldest first: the first H belong to s_tm1, the last H to
s_t), what it did and got. Everything else that it saw is a function of the scene and
the step, which every process of the run can look up, where all others replay the log.

Where an environment controls several objects, what one sees depends on the states of
them all: its row holds the others' states, too, so that any row can be drawn, weighed
and rendered on its own: 21 (H+1) + 4 bytes for each of the others. One row for all
objects of a step was rejected: it would save most of that, but what the replay draws
by priority and the learner weighs would be steps of scenes, not transitions.

A row of n steps (`actors.windows`) spans up to n: s_tm1 is where the action was
chosen, s_t the state `span` steps later; H+n states, of which the first H + span are
used.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from replay.spec import Field, RowSpec
from sim.bank import Bank
from sim.observation import (
    Observation,
    ObservationConfig,
    observe_first_batch,
)
from sim.world import View


def row_spec(
    history: int, components: int = 0, n_step: int = 1, others: int = 0
) -> RowSpec:
    """The layout of a row for `history` states per observation.

    With `components`, rows hold an expert's continuous action of as many, too. With
    `n_step` above 1 they span up to as many steps; with `others` they hold the states
    of as many further objects that were controlled beside the row's own.
    """
    states = history + n_step
    expert = (Field("continuous", "f4", (components,)),) if components else ()
    span = (Field("span", "i4"),) if n_step > 1 else ()
    beside = (
        (
            Field("others", "i4", (others,)),  # rows of the log, its length: empty
            Field("others_states", "f4", (others, states, 5)),
            Field("others_valid", "u1", (others, states)),
        )
        if others
        else ()
    )
    return RowSpec(
        (
            Field("scene", "i4"),
            Field("step", "i4"),  # t of s_t
            *span,  # steps from s_tm1 to s_t
            Field("controlled", "i4"),  # row of the log's objects
            Field("states", "f4", (states, 5)),  # x, y, yaw, v_x, v_y
            Field("valid", "u1", (states,)),
            *beside,
            Field("action", "i4"),  # a_tm1, index into the action table
            *expert,  # the same in its own units, see `actors.cloning`
            Field("reward", "f4"),  # r_t; of n steps, their return
            # 0 if and only if s_t is terminal, else 1; of n steps, that of all but one:
            # the learner multiplies each row's by its discount.
            Field("discount", "f4"),
            Field("weights_version", "i8"),  # of the policy that acted
            Field("actor", "i4"),
            Field("serial", "i8"),  # the actor's own count of its transitions
        )
    )


class Columns(NamedTuple):
    """The part of a batch of rows that observations are rendered from."""

    scene: Int[Array | np.ndarray, " batch"]
    step: Int[Array | np.ndarray, " batch"]
    controlled: Int[Array | np.ndarray, "batch objects"]  # the row's own first
    states: Float[Array | np.ndarray, "batch objects states 5"]
    valid: Bool[Array | np.ndarray, "batch objects states"]
    span: Int[Array | np.ndarray, " batch"] | None = None  # None: 1


def columns_of(rows: np.ndarray) -> Columns:
    """The columns of a batch of rows, as contiguous arrays."""
    controlled = rows["controlled"][:, None]
    states, valid = rows["states"][:, None], rows["valid"][:, None]
    names = rows.dtype.names or ()
    if "others" in names:
        controlled = np.concatenate([controlled, rows["others"]], 1)
        states = np.concatenate([states, rows["others_states"]], 1)
        valid = np.concatenate([valid, rows["others_valid"]], 1)
    return Columns(
        scene=np.ascontiguousarray(rows["scene"]),
        step=np.ascontiguousarray(rows["step"]),
        controlled=np.ascontiguousarray(controlled),
        states=np.ascontiguousarray(states),
        valid=valid.astype(bool),
        span=np.ascontiguousarray(rows["span"]) if "span" in names else None,
    )


def render(
    bank: Bank, columns: Columns, config: ObservationConfig
) -> tuple[Observation, Observation]:
    """The observations s_tm1 and s_t of rows, in one call of twice the batch.

    Bit for bit those that the actor acted on: `observe_first_batch` is the same
    program whatever surrounds it (tested).
    """
    before, after = views_of(columns, config.history)
    both = jax.tree.map(lambda *parts: jnp.concatenate(parts), before, after)
    seen = observe_first_batch(bank, both, config)
    batch = columns.scene.shape[0]
    first = jax.tree.map(lambda values: values[:batch], seen)
    second = jax.tree.map(lambda values: values[batch:], seen)
    return first, second


def render_before(
    bank: Bank, columns: Columns, config: ObservationConfig
) -> Observation:
    """The observations s_tm1 alone, where the action was chosen."""
    before, _ = views_of(columns, config.history)
    return observe_first_batch(bank, before, config)


def views_of(columns: Columns, history: int) -> tuple[View, View]:
    """What is observed at the two ends of each row."""
    states, valid = jnp.asarray(columns.states), jnp.asarray(columns.valid)
    if columns.span is None:
        span = jnp.ones_like(jnp.asarray(columns.step))
        last, last_valid = states[:, :, 1:], valid[:, :, 1:]
    else:
        span = jnp.asarray(columns.span)
        cut = functools.partial(jax.lax.dynamic_slice_in_dim, slice_size=history)
        ends = jax.vmap(functools.partial(cut, axis=1))
        last, last_valid = ends(states, span), ends(valid, span)
    after = View(
        scene=jnp.asarray(columns.scene),
        step=jnp.asarray(columns.step),
        controlled=jnp.asarray(columns.controlled),
        history=last,
        history_valid=last_valid,
    )
    before = after._replace(
        step=after.step - span,
        history=states[:, :, :history],
        history_valid=valid[:, :, :history],
    )
    return before, after
