import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxpets._src import moments as of_rows

moments = jax.jit(of_rows.moments)


def test_equal_the_reference_on_the_first_rows():
    rng = np.random.default_rng(0)
    rows = rng.normal(3.0, [0.1, 1.0, 50.0], size=(200, 3))
    rows[:, 1] = 0.25  # constant, and exact in float32
    padded = np.concatenate([rows, np.full((56, 3), np.nan)])
    mean, std = moments(np.float32(padded), jnp.int32(200))
    want_mean, want_std = reference.input_scaler(rows)
    # float32 sums of 200 rows against float64.
    np.testing.assert_allclose(mean, want_mean, rtol=1e-5)
    np.testing.assert_allclose(std, want_std, rtol=1e-5)
    assert std[1] == 1.0


def test_a_constant_column_has_no_noise_of_rounding():
    """Sums of most constants are not exact in float32."""
    rows = np.broadcast_to(np.linspace(0.1, 1000.1, 60, dtype=np.float32), (1000, 60))
    mean, std = moments(rows, jnp.int32(1000))
    np.testing.assert_array_equal(mean, rows[0])
    np.testing.assert_array_equal(std, 1.0)


def test_nor_has_one_whose_first_row_does_not_count():
    rows = np.full((1000, 2), 1234.567, np.float32)
    rows[0, 0] = np.nan
    mean, std = moments(rows, jnp.int32(1000))
    np.testing.assert_array_equal(mean, rows[1])
    np.testing.assert_array_equal(std, 1.0)


@pytest.mark.parametrize("at", [0, 7])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rows_that_are_not_finite_do_not_count(at, bad):
    rows = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    spoilt = rows.copy()
    spoilt[at, 1] = bad
    got = moments(jnp.asarray(spoilt), jnp.int32(20))
    rest = np.delete(rows, at, axis=0)
    np.testing.assert_allclose(got[0], rest.mean(0), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(got[1], rest.std(0), rtol=1e-4)


def test_no_rows_give_the_identity():
    mean, std = moments(jnp.full((4, 2), jnp.nan, jnp.float32), jnp.int32(0))
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_array_equal(std, 1.0)


def test_size_is_traced():
    rows = np.arange(12, dtype=np.float32).reshape(6, 2)
    jitted = jax.jit(functools.partial(of_rows.moments))  # with a cache of its own
    for size in (1, 3, 6):
        mean, _ = jitted(rows, jnp.int32(size))
        np.testing.assert_allclose(mean, rows[:size].mean(0), rtol=1e-6)
    assert jitted._cache_size() == 1
