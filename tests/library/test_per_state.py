"""A model of one state, moved by hand particle by particle and as a batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets

OBS = jnp.sin(jnp.arange(12.0)).reshape(2, 3, 2)
ACTION = jnp.cos(jnp.arange(3.0))[:, None]


def cart(gain, key, obs, action):
    velocity = obs[1] + toys.DT * gain * action[0]
    return jnp.stack([obs[0] + toys.DT * velocity, velocity])


def shaken(gain, key, obs, action):
    return cart(gain, key, obs, action) + jax.random.normal(key, (2,), jnp.float32)


def test_every_particle_moves_as_it_would_alone(key):
    gain = jnp.float32(2.0)
    got = jaxpets.per_state(cart)(gain, key, OBS, ACTION)
    for e in range(2):
        for b in range(3):
            alone = cart(gain, None, OBS[e, b], ACTION[b])
            np.testing.assert_allclose(got[e, b], alone, rtol=1e-6)  # one rounding
    np.testing.assert_allclose(got, toys.cart(gain, key, OBS, ACTION), rtol=1e-6)


def test_a_member_may_have_actions_of_its_own(key):
    gain, model = jnp.float32(2.0), jaxpets.per_state(cart)
    got = model(gain, key, OBS, jnp.stack([ACTION, -ACTION]))
    for e, action in enumerate([ACTION, -ACTION]):
        np.testing.assert_array_equal(got[e], model(gain, key, OBS, action)[e])


def test_every_particle_has_noise_of_its_own(key):
    model = jaxpets.per_state(shaken)
    obs, action = jnp.zeros((2, 4000, 2)), jnp.zeros((4000, 1))
    noise = np.asarray(model(jnp.float32(1.0), key, obs, action))  # nothing moves
    assert len(np.unique(noise.reshape(-1, 2), axis=0)) == 8000
    # 8000 draws: the deviation of their mean is 0.011, of their variance 0.016.
    np.testing.assert_allclose(noise[..., 1].mean(), 0.0, atol=0.05)
    np.testing.assert_allclose(noise[..., 1].var(), 1.0, atol=0.08)
    correlation = np.corrcoef(noise[0, :, 1], noise[1, :, 1])[0, 1]
    assert abs(correlation) < 0.08  # its deviation is 0.016


@pytest.mark.parametrize("kind", ["threefry2x32", "rbg"])
def test_any_kind_of_key_will_do(kind):
    keys = [jax.random.key(seed, impl=kind) for seed in (0, 0, 1)]
    model = jaxpets.per_state(shaken)
    first, same, other = (model(jnp.float32(1.0), key, OBS, ACTION) for key in keys)
    np.testing.assert_array_equal(first, same)
    assert not np.any(first == other)


def test_chunks_have_the_noise_of_the_whole(key):
    rollout = jaxpets.particle_rollout(
        jaxpets.per_state(shaken), num_members=2, num_particles=4
    )
    actions = jnp.sin(jnp.arange(12.0)).reshape(6, 2, 1)
    params = jaxpets.PlanParams(jnp.float32(1.0), jnp.float32(0.5))

    def values(chunk_size):
        planner = jaxpets.plan(
            rollout, toys.reach, toys.probe(actions), chunk_size=chunk_size
        )
        return jax.jit(planner.step)(params, key, planner.init(), jnp.zeros(2))[1]

    whole = values(None)
    np.testing.assert_allclose(values(2), whole, rtol=1e-5)  # sums in another order
    assert len(np.unique(whole)) == 6


def test_a_batch_for_a_state_is_refused(key):
    model = jaxpets.per_state(lambda params, key, obs, action: obs[:1])
    text = r"step_fn's result must be float32\[2\], got float32\[1\]"
    with pytest.raises(ValueError, match=text):
        model((), key, OBS, ACTION)
    with pytest.raises(ValueError, match=r"obs must be float32\[E, B, D\], got"):
        model((), key, OBS[0], ACTION)
    with pytest.raises(ValueError, match=r"action must be float32\[..., 3, A\], got"):
        model((), key, OBS, ACTION[:2])
    with pytest.raises(TypeError, match="step_fn must be a function, got 3"):
        jaxpets.per_state(3)
