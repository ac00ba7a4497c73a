"""HalfCheetah without its physics: tasks and the coordinates of the model."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

import jaxpets
from jaxpets.envs import half_cheetah as hc

task_reward = jax.jit(hc.task_reward)

# -- tasks ---------------------------------------------------------------------------


@pytest.mark.parametrize("lead", [(), (7,), (5, 4), (2, 3, 4)])
@pytest.mark.parametrize("name", hc.TASK_NAMES)
def test_task_reward_equals_the_reference_at_every_leading_shape(name, lead):
    rng = np.random.default_rng(0)
    obs, next_obs = rng.normal(size=(2, *lead, 18)).astype(np.float32)
    action = rng.uniform(-1, 1, (*lead, 6)).astype(np.float32)
    got = task_reward(hc.task(name), obs, action, next_obs)
    assert got.shape == lead and got.dtype == jnp.float32
    want = reference.task_reward(name.replace("-", "_"), action, next_obs)
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-6)


def test_one_action_serves_a_particle_set():
    next_obs = jnp.ones((5, 4, 18))
    got = hc.task_reward(hc.task("forward"), next_obs, jnp.ones(6), next_obs)
    np.testing.assert_allclose(got, np.full((5, 4), 0.4), rtol=1e-6)


def test_tasks_are_a_vmap_axis():
    next_obs = jnp.zeros(18).at[hc.FORWARD_VELOCITY].set(2.0)
    next_obs = next_obs.at[hc.PITCH_RATE].set(3.0)
    reward = jax.vmap(hc.task_reward, (0, None, None, None))
    got = reward(hc.tasks(), next_obs, jnp.zeros(6), next_obs)
    np.testing.assert_allclose(got, [2.0, -2.0, 3.0, -3.0])
    for i, name in enumerate(hc.TASK_NAMES):
        one = jax.tree.map(lambda x, i=i: x[i], hc.tasks())
        assert jax.tree.map(float, hc.task(name)) == jax.tree.map(float, one)


def test_unknown_tasks_and_observations_fail():
    with pytest.raises(ValueError, match=r"task must be one of forward, .*'backflip'"):
        hc.task("backflip")
    obs = jnp.zeros((3, 17))
    with pytest.raises(
        ValueError, match=r"next_obs must be float32\[\.\.\., 18\], got"
    ):
        hc.task_reward(hc.task("forward"), obs, jnp.zeros(6), obs)


# -- model space ---------------------------------------------------------------------


def test_model_space_equals_the_reference():
    space = hc.model_space()
    rng = np.random.default_rng(0)
    obs, next_obs = (3 * rng.normal(size=(2, 6, 18))).astype(np.float32)
    features = space.features(jnp.asarray(obs))
    assert features.shape == (6, 18)
    want = reference.cheetah_inputs(np.float64(obs), np.zeros((6, 0)))
    np.testing.assert_allclose(features, want, atol=1e-6)
    target = space.target(jnp.asarray(obs), jnp.asarray(next_obs))
    want = reference.cheetah_targets(np.float64(obs), np.float64(next_obs))
    np.testing.assert_allclose(target, want, atol=1e-5)
    back = space.next_obs(jnp.asarray(obs), target)
    np.testing.assert_allclose(back, next_obs, atol=2e-6)  # o + (x - o), rounded


def test_features_leave_out_what_the_model_need_not_know():
    features = hc.model_space().features
    obs = jnp.linspace(-1, 1, 18)
    moved = obs.at[hc.FORWARD_VELOCITY].add(5.0)
    np.testing.assert_array_equal(features(moved), features(obs))
    turned = obs.at[hc.PITCH].add(2 * math.pi)
    np.testing.assert_allclose(features(turned), features(obs), atol=1e-6)


def test_bound_leaves_the_pitch_free():
    bound = hc.model_space().bound
    low, high = -jnp.ones(18), 2 * jnp.ones(18)
    for value, edge in ((50.0, 2.0), (-50.0, -1.0)):
        got = bound(jnp.full((3, 18), value), low, high)
        want = np.full((3, 18), edge)
        want[:, hc.PITCH] = value
        np.testing.assert_array_equal(got, want)
    inside = jnp.linspace(-1, 2, 18)
    np.testing.assert_array_equal(bound(inside, low, high), inside)


def test_imagined_flips_keep_turning(key):
    """The ensemble bounds every state but the pitch, whatever its data showed."""
    config = jaxpets.EnsembleConfig(
        num_members=2, hidden_sizes=(), weight_decays=(0.0,), state_margin=0.5
    )
    model = jaxpets.ensemble(config, hc.model_space(), obs_size=18, action_size=6)
    params = jax.jit(model.init)(key)
    kernel = jnp.zeros((2, 24, 36))
    push = jnp.zeros((2, 36)).at[:, :18].set(1.0).at[:, 18:].set(-20.0)
    members = {"params": {"layer_0": {"kernel": kernel, "bias": push}}}
    scaler = params.scaler._replace(low=-jnp.ones(18), high=jnp.ones(18))
    params = params._replace(
        network=params.network._replace(members=members), scaler=scaler
    )
    rollout = jaxpets.particle_rollout(model.sample, num_members=2, num_particles=2)
    path = rollout(params, key, jnp.zeros(18), jnp.zeros((1, 30, 6)))
    last = np.asarray(path[0, -1].reshape(2, 18))
    np.testing.assert_allclose(last[:, hc.PITCH], 30.0, rtol=0.05)
    rest = np.delete(last, hc.PITCH, axis=1)
    assert np.abs(rest).max() <= 2.0 + 1e-6
