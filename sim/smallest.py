"""The smallest of a row of values, in forms that XLA vectorises on a CPU.

Measured for rows of 64 on one core, in microseconds per row: `jnp.argmin` 0.27 (its
reduction carries a pair and stays scalar), the two minima of `argmin` here 0.06. A
minimum over more than `LANES` values is rewritten by XLA into a slow windowed one (1.2
against 0.2 for sixteen minima), so rows are cut into pieces of that length.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim.apart import apart

LANES = 32
_NONE = 2**31 - 1  # int32's largest


def minimum(values: Int[Array, "*rows n"]) -> Int[Array, "*rows"]:
    """The least value of each row."""
    pieces = [
        values[..., start : start + LANES].min(-1)
        for start in range(0, values.shape[-1], LANES)
    ]
    return functools.reduce(jnp.minimum, pieces)


def any_of(values: Bool[Array, "*rows n"]) -> Bool[Array, "*rows"]:
    """Whether any value of each row is true."""
    return minimum((~values).astype(jnp.int32)) == 0


def argmin(values: Float[Array, "*rows n"]) -> Int[Array, "*rows"]:
    """The index of the least value of each row, the first of several; none negative."""
    # As integers the bits of floats that are not negative are in the same order.
    bits = jax.lax.bitcast_convert_type(values, jnp.int32)
    index = jnp.arange(values.shape[-1], dtype=jnp.int32)
    index = index.reshape((1,) * (values.ndim - 1) + (-1,))
    least = minimum(bits)[..., None]
    return minimum(jnp.where(bits == least, index, _NONE))


def nearest(
    squared: Float[Array, "*rows n"], seen: Bool[Array, "*rows n"], count: int
) -> tuple[Int[Array, "*rows count"], Bool[Array, "*rows count"]]:
    """The `count` seen values of each row least first, and which slots are used.

    Values that agree to one part in 2^23 / n (7e-6 for 64, half a millimetre of a
    distance of 60 m) are in order of their index; none may be negative.

    Sixteen minima of keys that hold the index in their low bits. Rejected, by the same
    measure for 16 of 64, 0.18 here: counting how many are less 1.0 (and 9 of 128, for
    0.4), `top_k` 1.2, minima of the exact value and then of the index 1.2.
    """
    n = squared.shape[-1]
    low = (1 << (n - 1).bit_length()) - 1
    index = jnp.arange(n, dtype=jnp.int32).reshape((1,) * (squared.ndim - 1) + (-1,))
    bits = jax.lax.bitcast_convert_type(squared, jnp.int32)
    keys = jnp.where(seen, (bits & ~low) | index, _NONE)
    # Fused, every minimum would work the keys out anew; a call that XLA may not inline
    # has them as its argument.
    keys = apart(_least(keys, count=count))
    used = keys < _NONE
    return jnp.where(used, keys & low, 0), used


@functools.partial(jax.jit, static_argnames="count")
def _least(keys: Int[Array, "*rows n"], count: int) -> Int[Array, "*rows count"]:
    """The `count` least keys of each row, in order; no two are equal but `_NONE`."""
    pieces = [
        keys[..., start : start + LANES] for start in range(0, keys.shape[-1], LANES)
    ]
    found: list[Int[Array, "*rows"]] = []
    least = jnp.full(keys.shape[:-1], -1, jnp.int32)
    for _ in range(count):
        after = least[..., None]
        least = functools.reduce(
            jnp.minimum,
            [jnp.where(piece > after, piece, _NONE).min(-1) for piece in pieces],
        )
        found.append(least)
    return jnp.stack(found, -1)
