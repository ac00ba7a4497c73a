"""Imagination: the law of samples, and the bound that keeps them near the data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets

E, B, D, A = 3, 7, 2, 1


@pytest.fixture(scope="module")
def params():
    """A model that has seen data."""
    model = toys.small_ensemble()
    data = toys.transitions(50)
    scaler = jax.jit(model.fit_scaler)(data, jnp.int32(50))
    return jax.jit(model.init)(jax.random.key(0))._replace(scaler=scaler)


def batch(seed=0):
    rng = np.random.default_rng(seed)
    obs = jnp.asarray(rng.normal(size=(E, B, D)), jnp.float32)
    return obs, jnp.asarray(rng.uniform(-1, 1, size=(B, A)), jnp.float32)


def test_sample_has_the_predicted_law(params):
    model = toys.small_ensemble(state_margin=None)
    row = batch()[0][:, :1]
    obs, action = jnp.broadcast_to(row, (E, 20_000, D)), jnp.zeros((20_000, A))
    mean, variance = jax.jit(model.predict)(params, row, action[:1])
    drawn = jax.jit(model.sample)(params, jax.random.key(5), obs, action)
    std = np.sqrt(variance[:, 0])
    # 20,000 draws: the mean is known to 0.7 % of the deviation, the variance to 1 %.
    np.testing.assert_array_less(np.abs(drawn.mean(1) - mean[:, 0]), 0.04 * std)
    np.testing.assert_allclose(drawn.std(1), std, rtol=0.04)
    residual = np.asarray(drawn - mean).reshape(E, -1)
    np.testing.assert_allclose(np.corrcoef(residual), np.eye(E), atol=0.03)


def unstable(state_margin):
    """A linear ensemble that triples its state at every step, and its parameters."""
    model = toys.small_ensemble(
        hidden_sizes=(), weight_decays=(0.0,), state_margin=state_margin
    )
    params = jax.jit(model.init)(jax.random.key(0))
    kernel = jnp.zeros((E, D + A, 2 * D)).at[:, :D, :D].set(2.0 * jnp.eye(D))
    layer = params.network.members["params"]["layer_0"] | {"kernel": kernel}
    network = params.network._replace(members={"params": {"layer_0": layer}})
    data = toys.transitions(50)
    scaler = jax.jit(model.fit_scaler)(data, jnp.int32(50))
    identity = scaler._replace(mean=jnp.zeros(D + A), std=jnp.ones(D + A))
    return model, params._replace(network=network, scaler=identity)


def imagine(model, params, horizon=120):
    rollout = jaxpets.particle_rollout(model.sample, num_members=E, num_particles=E)
    actions = jnp.zeros((4, horizon, A))
    return jax.jit(rollout)(params, jax.random.key(0), jnp.ones(D), actions)


def test_bound_keeps_a_blow_up_near_the_data():
    model, params = unstable(0.5)
    path = imagine(model, params)
    low, high = params.scaler.low, params.scaler.high
    margin = 0.5 * (high - low) + 1e-5
    assert jnp.all(path >= low - margin) and jnp.all(path <= high + margin)
    assert jnp.any(path[:, -1] > high)  # the margin is used


def test_bound_can_be_switched_off():
    model, params = unstable(None)
    path = imagine(model, params)
    assert jnp.max(jnp.abs(path[:, 20])) > 1e6  # blown up, and finite
    assert not jnp.all(jnp.isfinite(path[:, -1]))


@pytest.mark.parametrize("margin", [0.0, 0.5, None])
def test_before_any_data_there_is_no_bound(margin):
    model = toys.small_ensemble(state_margin=margin)
    params = jax.jit(model.init)(jax.random.key(0))
    obs, action = batch()
    drawn = jax.jit(model.sample)(params, jax.random.key(1), 1e3 * obs, action)
    assert jnp.all(jnp.isfinite(drawn))
    assert jnp.max(jnp.abs(drawn)) > 100


def test_margin_zero_keeps_to_the_range_of_the_data():
    model, params = unstable(0.0)
    path = imagine(model, params)
    low, high = params.scaler.low, params.scaler.high
    assert jnp.all(path[:, 1:] >= low) and jnp.all(path[:, 1:] <= high)
