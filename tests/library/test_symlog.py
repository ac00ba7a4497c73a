"""Squashed values: an order that is kept, a way back, and slopes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets._src.symlog import symexp, symlog

VALUES = jnp.asarray([-2.0, -1.0, -0.01, 0.0, 1e-4, 0.3, 1.0, 5.0], jnp.float32)


@pytest.mark.parametrize("squash", [0.0, 1e-3, 1.0, 10.0, 1e4])
def test_a_value_comes_back_and_the_largest_stays(squash):
    found = symlog(VALUES, jnp.float32(squash))
    np.testing.assert_allclose(
        symexp(found, jnp.float32(squash)), VALUES, rtol=1e-4, atol=1e-7
    )
    assert (jnp.diff(found) > 0.0).all()
    for value in (-1.0, 0.0, 1.0):
        at = symlog(jnp.float32(value), jnp.float32(squash))
        np.testing.assert_allclose(at, value, rtol=1e-6)


def test_without_a_squash_values_are_as_they_are():
    for function in (symlog, symexp):
        np.testing.assert_array_equal(function(VALUES, jnp.zeros(())), VALUES)


def test_it_is_the_symlog_of_dreamer_in_its_own_unit():
    got = symlog(VALUES, jnp.ones(()))
    wanted = np.sign(VALUES) * np.log(np.abs(VALUES) + 1.0) / np.log(2.0)
    np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("squash", [0.0, 10.0])
@pytest.mark.parametrize("function", [symlog, symexp])
def test_slopes_are_finite_and_not_negative(function, squash):
    slopes = jax.vmap(jax.grad(function), (0, None))(VALUES, jnp.float32(squash))
    assert np.isfinite(slopes).all() and (slopes >= 0.0).all()


def test_what_is_too_large_stays_finite():
    for value in (-1e3, 1e3):
        assert np.isfinite(symexp(jnp.float32(value), jnp.float32(10.0)))


def test_small_values_count_for_more():
    """A thousandth of the largest counts for more than four."""
    small = symlog(jnp.float32(0.001), jnp.float32(10.0))
    np.testing.assert_allclose(small, 0.00417, rtol=1e-2)
