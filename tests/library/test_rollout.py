import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import toys

import jaxpets

E, P, N, H = 3, 4, 5, 6


def linear(params, key, obs, action):
    """x' = A_e x + B_e a + std_e eps; the observation carries x and the eps used."""
    a, b, std = params
    state = obs[..., :2]
    noise = jax.random.normal(key, state.shape, jnp.float32)
    pushed = jnp.einsum("eij,erj->eri", a, state) + jnp.einsum("eij,rj->eri", b, action)
    return jnp.concatenate([pushed + std[:, None] * noise, noise], axis=-1)


def linear_params(seed=0):
    rng = np.random.default_rng(seed)
    arrays = (
        0.6 * rng.normal(size=(E, 2, 2)),
        rng.normal(size=(E, 2, 1)),
        0.3 + rng.uniform(size=(E, 2)),
    )
    return tuple(x.astype(np.float32) for x in arrays)


def rolled(seed=0):
    rollout = jaxpets.particle_rollout(linear, num_members=E, num_particles=E * P)
    rng = np.random.default_rng(seed)
    actions = rng.uniform(-1, 1, (N, H, 1)).astype(np.float32)
    obs = jnp.concatenate([jnp.array([0.3, -0.7]), jnp.zeros(2)])
    path = rollout(linear_params(), jax.random.key(seed), obs, jnp.asarray(actions))
    return np.asarray(path), np.asarray(obs), actions


def test_equals_trajectory_sampling_of_the_reference():
    path, obs, actions = rolled()
    assert path.shape == (N, H + 1, E, P, 4)
    noise = np.float64(path[:, 1:, ..., 2:]).swapaxes(0, 1)
    members = [tuple(np.float64(x[e]) for x in linear_params()) for e in range(E)]
    want = reference.ts_infinity(members, noise, obs[:2], np.float64(actions))
    # Six float32 steps.
    np.testing.assert_allclose(path[..., :2], want, atol=1e-4)


def test_index_zero_is_the_start():
    path, obs, _ = rolled()
    np.testing.assert_array_equal(path[:, 0], np.broadcast_to(obs, path[:, 0].shape))


def test_every_particle_has_its_own_noise_at_every_step():
    noise = rolled()[0][:, 1:, ..., 2:].ravel()
    assert len(np.unique(noise)) == noise.size
    assert abs(noise.mean()) < 0.15 and abs(noise.std() - 1) < 0.1  # 720 draws


def test_members_are_fixed_and_have_equally_many_particles():
    def who(params, key, obs, action):
        return jnp.broadcast_to(
            jnp.arange(E, dtype=jnp.float32)[:, None, None], obs.shape
        )

    rollout = jaxpets.particle_rollout(who, num_members=E, num_particles=E * P)
    path = rollout((), jax.random.key(0), jnp.zeros(1), jnp.zeros((N, H, 1)))
    assert path.shape == (N, H + 1, E, P, 1)
    for e in range(E):
        np.testing.assert_array_equal(path[:, 1:, e], e)


def test_deterministic_dynamics_keep_particles_together(key):
    rollout = jaxpets.particle_rollout(toys.cart, num_members=2, num_particles=6)
    actions = jnp.linspace(-1, 1, N * H).reshape(N, H, 1)
    path = rollout(jnp.float32(1.0), key, jnp.array([0.1, 0.2]), actions)
    np.testing.assert_array_equal(path, np.broadcast_to(path[:, :, :1, :1], path.shape))


def test_permuting_candidates_permutes_paths(key):
    rollout = jaxpets.particle_rollout(toys.cart, num_members=2, num_particles=4)
    actions = jnp.linspace(-1, 1, N * H).reshape(N, H, 1)
    order = jnp.array([3, 1, 4, 0, 2])
    run = jax.jit(rollout)
    obs = jnp.zeros(2)
    path = run(jnp.float32(1.0), key, obs, actions)
    moved = run(jnp.float32(1.0), key, obs, actions[order])
    np.testing.assert_array_equal(moved, path[order])


def test_dynamics_see_one_batch_per_member(key):
    shapes = []

    def dynamics(params, key, obs, action):
        shapes.append((obs.shape, action.shape))
        return obs

    rollout = jaxpets.particle_rollout(dynamics, num_members=E, num_particles=E * P)
    rollout((), key, jnp.zeros(2), jnp.zeros((N, H, 1)))
    # Traced once: one scan, not a Python loop over the horizon.
    assert shapes == [((E, N * P, 2), (N * P, 1))]


@pytest.mark.parametrize(("members", "particles"), [(3, 4), (5, 1), (2, 7)])
def test_particles_are_a_multiple_of_members(members, particles):
    text = rf"num_particles must be a multiple of num_members \({members}\), got"
    with pytest.raises(ValueError, match=text):
        jaxpets.particle_rollout(
            toys.cart, num_members=members, num_particles=particles
        )


def test_bad_counts_fail_when_built():
    with pytest.raises(ValueError, match="num_members must be at least 1, got 0"):
        jaxpets.particle_rollout(toys.cart, num_members=0)
    with pytest.raises(TypeError, match="num_particles must be a Python int"):
        jaxpets.particle_rollout(toys.cart, num_particles=2.0)


def test_wrong_arguments_fail_when_traced(key):
    rollout = jaxpets.particle_rollout(toys.cart)
    with pytest.raises(
        ValueError, match=r"obs must be float32\[D\], got float32\[3, 2"
    ):
        rollout(1.0, key, jnp.zeros((3, 2)), jnp.zeros((N, H, 1)))
    with pytest.raises(ValueError, match=r"actions must be float32\[N, H, A\], got"):
        rollout(1.0, key, jnp.zeros(2), jnp.zeros((H, 1)))


@pytest.mark.parametrize(
    "result", [jnp.zeros((1, N, 3)), jnp.zeros((1, N, 2), jnp.bfloat16)]
)
def test_wrong_dynamics_fail_when_traced(result, key):
    rollout = jaxpets.particle_rollout(lambda *_: result)
    text = r"dynamics_fn's result must be float32\[1, 5, 2\], got"
    with pytest.raises(ValueError, match=text):
        rollout((), key, jnp.zeros(2), jnp.zeros((N, H, 1)))
