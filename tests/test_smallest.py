"""The smallest values of rows: against sorting, for rows of any length."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import smallest

LENGTHS = (1, 5, 32, 33, 64, 100)

_argmin = jax.jit(smallest.argmin)
_any_of = jax.jit(smallest.any_of)
_nearest = jax.jit(smallest.nearest, static_argnums=2)


@pytest.mark.parametrize("length", LENGTHS)
def test_the_first_of_the_least(length: int) -> None:
    rng = np.random.default_rng(length)
    values = rng.integers(0, 9, (50, length)).astype(np.float32)  # many are equal
    np.testing.assert_array_equal(_argmin(values), values.argmin(1))


@pytest.mark.parametrize("length", LENGTHS)
def test_any(length: int) -> None:
    values = np.random.default_rng(length).random((50, length)) < 1 / length
    np.testing.assert_array_equal(_any_of(values), values.any(1))


@pytest.mark.parametrize("length", LENGTHS)
def test_the_nearest_are_a_sorts(length: int) -> None:
    rng = np.random.default_rng(length)
    squared = rng.uniform(0, 3600, (50, length)).round().astype(np.float32)
    seen = rng.random((50, length)) < 0.7
    chosen, used = jax.device_get(_nearest(squared, seen, 7))
    for row in range(50):
        order = np.argsort(np.where(seen[row], squared[row], np.inf), kind="stable")
        expected = order[: min(7, seen[row].sum())]
        assert used[row].sum() == len(expected)
        assert used[row, : len(expected)].all()
        assert chosen[row, : len(expected)].tolist() == expected.tolist()


def test_rows_are_independent_of_their_batch() -> None:
    """One row alone, in a batch, and under `vmap`."""
    rng = np.random.default_rng(3)
    squared = jnp.asarray(rng.uniform(0, 3600, (6, 40)), jnp.float32)
    seen = jnp.asarray(rng.random((6, 40)) < 0.5)
    whole = _nearest(squared, seen, 5)
    mapped = jax.jit(jax.vmap(lambda a, b: smallest.nearest(a, b, 5)))(squared, seen)
    for one, other in zip(whole, mapped, strict=True):
        np.testing.assert_array_equal(one, other)
    alone, _ = _nearest(squared[2], seen[2], 5)
    np.testing.assert_array_equal(alone, whole[0][2])
