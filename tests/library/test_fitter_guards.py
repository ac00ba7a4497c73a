"""What training refuses, skips and keeps in order."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys
from toys import dataset_of

import jaxpets
from jaxpets import FitConfig

CAPACITY = 40


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_update_whose_loss_is_not_finite_is_dropped(
    model, params, step, fitter, bad
):
    data = toys.transitions(40)
    data = data._replace(next_obs=data.next_obs.at[11].set(bad))
    after, state, metrics = step(
        params, jax.random.key(0), fitter.init(params), dataset_of(data)
    )
    for leaf in jax.tree.leaves((after.network, state)):
        assert np.all(np.isfinite(np.asarray(leaf)))
    assert 0 < metrics.num_skipped < metrics.num_updates
    # Dropped updates leave the optimizer alone, too.
    assert int(state.opt_state[0].count) == metrics.num_updates - metrics.num_skipped
    assert jnp.isfinite(metrics.nll)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("entry", ["obs", "next_obs"])
def test_metrics_are_means_over_the_updates_that_were_kept(
    model, params, step, fitter, seed, entry
):
    """One bad row of forty: about what the clean data give, and no NaN."""
    data = toys.transitions(40)
    bad = getattr(data, entry).at[11].set(jnp.nan)

    def run(data):
        dataset = dataset_of(data)
        return step(params, jax.random.key(seed), fitter.init(params), dataset)

    _, _, clean = run(data)
    _, _, spoilt = run(data._replace(**{entry: bad}))
    assert spoilt.num_skipped < spoilt.num_updates
    np.testing.assert_allclose(spoilt.nll, clean.nll, atol=1.0)
    np.testing.assert_allclose(spoilt.mse, clean.mse, rtol=1.0)


def test_metrics_without_an_update_that_was_kept_are_nan(params, step, fitter):
    data = toys.transitions(40)
    data = data._replace(next_obs=jnp.full_like(data.next_obs, jnp.nan))
    after, _, metrics = step(
        params, jax.random.key(0), fitter.init(params), dataset_of(data)
    )
    toys.assert_trees_close(after.network, params.network, rtol=0, atol=0)
    assert metrics.num_skipped == metrics.num_updates
    assert jnp.isnan(metrics.nll) and jnp.isnan(metrics.mse)


@pytest.mark.parametrize("size", [5, 19, 24])
def test_rows_behind_the_data_are_never_looked_at(size):
    """Features that are not finite where the capacity is empty."""
    space = jaxpets.delta_space()._replace(features=jnp.log)
    model = toys.small_ensemble(space=space)
    params = jax.jit(model.init)(jax.random.key(0))
    data = jax.tree.map(
        lambda x: np.abs(np.asarray(x)) + np.float32(0.1), toys.transitions(size)
    )
    config = FitConfig(num_epochs=2, batch_size=8, bootstrap=False)
    fitter = jaxpets.fitter(model, optax.adam(1e-3), config)
    _, _, metrics = jax.jit(fitter.step)(
        params, jax.random.key(0), fitter.init(params), dataset_of(data)
    )
    assert metrics.num_skipped == 0 and jnp.isfinite(metrics.nll)


def test_the_model_stays_usable_after_a_bad_row(model, params, step, fitter):
    data = toys.transitions(40)
    data = data._replace(next_obs=data.next_obs.at[11].set(jnp.nan))
    after, _, _ = step(params, jax.random.key(0), fitter.init(params), dataset_of(data))
    drawn = jax.jit(model.sample)(
        after, jax.random.key(1), jnp.zeros((3, 4, 2)), jnp.zeros((4, 1))
    )
    assert jnp.all(jnp.isfinite(drawn))


def test_an_update_whose_gradient_is_not_finite_is_dropped(model, params):
    """A loss may be finite where its gradient is not."""

    def loss(network, inputs, targets, weight):
        total, errors = model.loss(network, inputs, targets, weight)
        zero = jnp.sum(weight) - jnp.sum(weight)
        # The root has the value 0 and an infinite slope.
        return total + jnp.sqrt(zero * jnp.sum(network.max_logvar)), errors

    fitter = jaxpets.fitter(model._replace(loss=loss), optax.adam(1e-3), FitConfig())
    dataset = dataset_of(toys.transitions(40))
    after, _, metrics = jax.jit(fitter.step)(
        params, jax.random.key(0), fitter.init(params), dataset
    )
    for leaf in jax.tree.leaves(after.network):
        assert np.all(np.isfinite(np.asarray(leaf)))
    assert metrics.num_skipped == metrics.num_updates


@pytest.mark.parametrize("build", [optax.sgd, optax.adam])
def test_an_epoch_that_ends_without_numbers_is_undone(model, params, build):
    """A rate that is far too high: gradients are finite, and weights are not."""
    optimizer = optax.chain(build(1e38), optax.scale(1e38))
    fitter = jaxpets.fitter(model, optimizer, FitConfig(num_epochs=3, batch_size=8))
    before, dataset = fitter.init(params), dataset_of(toys.transitions(40))
    after, state, metrics = jax.jit(fitter.step)(
        params, jax.random.key(0), before, dataset
    )
    chex.assert_trees_all_equal(after.network, params.network)
    chex.assert_trees_all_equal(state, before)
    assert metrics.num_skipped == metrics.num_updates == 15
    assert jnp.isnan(metrics.nll) and jnp.isnan(metrics.mse)


def test_max_logvar_never_crosses_min_logvar():
    """A strong pull on the bounds and a high rate: they meet and stop."""
    model = toys.small_ensemble(bound_decay=300.0)
    params = jax.jit(model.init)(jax.random.key(0))
    config = FitConfig(num_epochs=20, batch_size=8)
    fitter = jaxpets.fitter(model, optax.adam(0.3), config)
    step = jax.jit(fitter.step)
    state, dataset = fitter.init(params), dataset_of(toys.transitions(40))
    met = False
    for call in range(5):
        params, state, _ = step(params, jax.random.key(call), state, dataset)
        gap = params.network.max_logvar - params.network.min_logvar
        assert jnp.all(gap > 0)
        met |= bool(jnp.any(gap < 0.2))
        assert jnp.all(jaxpets.rewards.max_variance(params) > 1e-12)
    assert met  # the case is the one meant


def test_bad_settings_fail_when_built():
    with pytest.raises(ValueError, match="num_epochs must be at least 1, got 0"):
        FitConfig(num_epochs=0)
    with pytest.raises(TypeError, match="batch_size must be a Python int"):
        FitConfig(batch_size=32.0)
    with pytest.raises(TypeError, match="bootstrap must be True or False, got 1"):
        FitConfig(bootstrap=1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        FitConfig().batch_size = 1


def test_a_raw_key_fails_when_traced(fitter, params):
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    with pytest.raises(TypeError, match="key must be a typed key"):
        fitter.step(params, jax.random.PRNGKey(0), fitter.init(params), dataset)


@pytest.mark.parametrize("sizes", [(3, 1), (2, 2)])
def test_a_dataset_of_other_sizes_fails_when_traced(fitter, params, sizes):
    dataset = jaxpets.datasets.init(CAPACITY, *sizes)
    with pytest.raises(ValueError, match=r"data\S* must be float32\[.*got float32"):
        jax.eval_shape(
            fitter.step, params, jax.random.key(0), fitter.init(params), dataset
        )


def test_data_of_numpy_are_learned_from_outside_jit(fitter, params, step):
    """As those of a file: rows are picked by what is traced, which NumPy cannot."""
    dataset = dataset_of(toys.transitions(9))
    args = (params, jax.random.key(0), fitter.init(params))
    want = step(*args, dataset)
    # Compiled apart, the sums round otherwise.
    toys.assert_trees_close(
        fitter.step(*args, jax.device_get(dataset)), want, rtol=1e-4, atol=1e-6
    )
