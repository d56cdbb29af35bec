"""A compiled function within another one that XLA may not merge with what is around it.

XLA on CPU drops optimisation barriers before it fuses, but never fuses across a call
that it may not inline.
"""

from typing import TypeVar

import jax
from jax.experimental.xla_metadata import set_xla_metadata

Result = TypeVar("Result")


def apart(result: Result) -> Result:
    """Marks the call of a `jax.jit` function that `result` comes from; on a CPU only.

    The call is marked, not what is called: in a context of `set_xla_metadata` every
    `jnp.where` in it would be a call of its own (measured: ten times slower).
    """
    if jax.default_backend() != "cpu":
        return result
    return set_xla_metadata(result, inlineable="false")  # type: ignore[no-untyped-call]
