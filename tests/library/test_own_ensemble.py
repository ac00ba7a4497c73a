"""An ensemble of a user's own, written from the docstring of `Ensemble` alone."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import EnsembleParams, FitConfig

E, D, A = 2, 2, 1


class Member(nn.Module):
    """Means and standard deviations of the change of an observation."""

    @nn.compact
    def __call__(self, inputs):
        hidden = nn.tanh(nn.Dense(8)(inputs))
        return nn.Dense(D)(hidden), nn.softplus(nn.Dense(D)(hidden)) + 0.01


def own_ensemble():
    net = Member()

    def init(key):
        keys = jax.random.split(key, E)
        rows = jnp.zeros((1, D + A))
        members = jax.vmap(net.init, (0, None))(keys, rows)
        return EnsembleParams({"members": members}, {"center": jnp.zeros(D)})

    def forward(network, inputs):
        return jax.vmap(net.apply)(network["members"], inputs)

    def encode_inputs(scaler, obs, action):
        return jnp.concatenate([obs - scaler["center"], action], axis=-1)

    def predict(params, obs, action):
        action = jnp.broadcast_to(action, (E, *action.shape))
        inputs = encode_inputs(params.scaler, obs, action)
        mean, std = forward(params.network, inputs)
        return obs + mean, std**2

    def sample(params, key, obs, action):
        mean, variance = predict(params, obs, action)
        noise = jax.random.normal(key, mean.shape, jnp.float32)
        return mean + jnp.sqrt(variance) * noise

    def fit_scaler(data, size):
        used = (jnp.arange(data.obs.shape[0]) < size)[:, None]
        count = jnp.maximum(size, 1).astype(jnp.float32)
        return {"center": jnp.sum(jnp.where(used, data.obs, 0.0), 0) / count}

    def encode(scaler, data):
        inputs = encode_inputs(scaler, data.obs, data.action)
        return inputs, data.next_obs - data.obs

    def loss(network, inputs, targets, weight):
        mean, std = forward(network, inputs)
        square = (mean - targets) ** 2
        rows = jnp.mean(square / std**2 + 2 * jnp.log(std), axis=-1)
        nll = jnp.sum(rows * weight)
        return nll, (nll, jnp.sum(jnp.mean(square, axis=(0, 2)) * weight))

    return jaxpets.Ensemble(
        init,
        predict,
        sample,
        fit_scaler,
        encode,
        loss,
        project=lambda network: network,
        num_members=E,
        obs_size=D,
        action_size=A,
    )


@pytest.fixture(scope="module")
def model():
    return own_ensemble()


@pytest.fixture(scope="module")
def fitter(model):
    config = FitConfig(num_epochs=20, batch_size=8)
    return jaxpets.fitter(model, optax.adam(1e-2), config)


def test_it_trains(model, params, fitter, step):
    dataset = toys.dataset_of(toys.transitions(40))
    state = fitter.init(params)
    params, state, first = step(params, jax.random.key(0), state, dataset)
    params, state, second = step(params, jax.random.key(1), state, dataset)
    assert second.nll < first.nll and second.mse < first.mse
    assert int(second.num_updates) == 20 * 5 and int(second.num_skipped) == 0
    center = toys.transitions(40).obs.mean(0)
    # The same forty rows, added up in another order.
    np.testing.assert_allclose(params.scaler["center"], center, atol=1e-6)
    leaves = jax.tree.leaves(params.network)
    assert all(leaf.shape[0] == E for leaf in leaves)


def test_it_explores(model, fitter):
    env = toys.cart_env()
    rollout = jaxpets.particle_rollout(model.sample, num_members=E, num_particles=4)
    search = toys.optimizer("cem", horizon=3)
    explorer = jaxpets.plan(rollout, jaxpets.rewards.epistemic, search)
    data = jaxpets.RewardData(init=lambda key: jnp.ones(D))
    learner = jaxpets.learner(env, model, fitter, data, trial_length=10, capacity=20)
    step = jax.jit(learner.step, static_argnums=0)
    state = jax.jit(learner.init)(jax.random.key(0))
    for trial in range(2):
        state, output = step(explorer, jax.random.key(trial), state)
    assert state.dataset.size == 20
    assert jnp.all(output.plans.value > 0)  # members disagree about every plan
    assert jnp.isfinite(output.fit.nll)


def poisoned(model, index):
    """The ensemble with a gradient that is NaN in one leaf, and a finite loss."""

    def loss(network, inputs, targets, weight):
        total, errors = model.loss(network, inputs, targets, weight)
        leaf = jax.tree.leaves(network)[index]
        return total + jnp.sqrt(0.0 * jnp.sum(leaf)), errors

    return model._replace(loss=loss)


@pytest.mark.parametrize("index", range(6))
def test_what_is_not_finite_is_found_in_any_leaf(model, params, index):
    """The default of `sentinels`: nobody said which parts tell of the others."""
    config = FitConfig(num_epochs=1, batch_size=40)
    fitter = jaxpets.fitter(poisoned(model, index), optax.sgd(1e-2), config)
    assert len(jax.tree.leaves(params.network)) == 6
    dataset = toys.dataset_of(toys.transitions(40))
    after, _, metrics = jax.jit(fitter.step)(
        params, jax.random.key(0), fitter.init(params), dataset
    )
    assert int(metrics.num_skipped) == int(metrics.num_updates) == 1
    toys.assert_trees_close(after.network, params.network, rtol=0)


def test_there_is_no_kernel_for_it(model):
    with pytest.raises(ValueError, match=r"model must be built by .*particle_rollout"):
        jaxpets.fused_rollout(model, num_particles=4)
