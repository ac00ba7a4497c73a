import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import toys

import jaxpets
from jaxpets.rewards import pseudo_count, simhash

# Jitted once; the tests keep to a few sizes, for sorts are slow to compile.
count_states = jax.jit(jaxpets.rewards.count_states)
lookup = jax.jit(jaxpets.rewards.lookup)
bonus_of = jax.jit(pseudo_count)

SIZE, CAPACITY, D = 300, 512, 6


def dataset_of(states, capacity=CAPACITY):
    """A dataset whose next_obs are `states`; the rest is another thing."""
    states = np.float32(states)
    rows = jaxpets.Transition(states + 7, states[:, :1], states)
    return toys.dataset_of(rows, capacity)


def clustered(seed=0, size=SIZE):
    """States around a few centres, so that codes of many bits repeat, too."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(12, D)) * [1, 5, 0.1, 30, 1, 2]
    picks = centres[rng.integers(0, 12, size)]
    return (picks * (1 + 1e-3 * rng.normal(size=picks.shape))).astype(np.float32)


def margin(counts, states):
    """Distance of the closest product to 0: below 1e-5, float32 may flip a sign."""
    g = (np.float64(states) - counts.mean) / counts.std
    return np.abs(g @ np.float64(counts.projection).T).min()


@pytest.mark.parametrize("num_bits", [1, 8, 16, 31, 32])
def test_counts_equal_a_dictionary(num_bits):
    states = clustered(seed=num_bits)
    queries = np.concatenate([states[:80], clustered(seed=99, size=80)])
    projection = np.asarray(simhash(jax.random.key(num_bits), num_bits, D))
    want = reference.DictCounts(projection, states)
    assert margin(want, states) > 1e-5 and margin(want, queries) > 1e-5
    counts = count_states(jnp.asarray(projection), dataset_of(states))
    got = lookup(counts, jnp.asarray(queries))
    assert got.dtype == jnp.int32
    np.testing.assert_array_equal(got, [want.count(query) for query in queries])
    bonus = bonus_of(counts, None, None, jnp.asarray(queries))
    # The reciprocal root is good to 1e-6 in float32.
    np.testing.assert_allclose(bonus, [want.bonus(q) for q in queries], rtol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_blew_up_is_not_new(bad):
    projection = simhash(jax.random.key(0), 16, D)
    counts = count_states(projection, dataset_of(clustered()))
    states = np.zeros((2, D), np.float32)
    states[1, 3] = bad
    bonus = np.asarray(bonus_of(counts, None, None, states))
    assert bonus[0] > 0 and np.isnan(bonus[1])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_blew_up_is_not_counted(bad):
    """Compared with anything it is no more, so it would have the code of no bits."""
    states = clustered()
    broken = np.zeros((7, D), np.float32)
    broken[:, 2] = bad
    projection = simhash(jax.random.key(0), 3, D)
    want = count_states(projection, dataset_of(states))
    got = count_states(projection, dataset_of(np.concatenate([broken, states])))
    assert lookup(got, states).tolist() == lookup(want, states).tolist()
    assert got.visits.max() == want.visits.max() and lookup(got, states[0]) > 0
    zero = -jnp.linalg.pinv(projection).sum(1) * want.std + want.mean
    assert lookup(got, zero) == lookup(want, zero)


@pytest.mark.parametrize("num_bits", [1, 8, 16, 31, 32])
def test_counts_sum_to_the_size(num_bits):
    states = clustered(seed=num_bits)
    projection = simhash(jax.random.key(num_bits), num_bits, D)
    n = np.asarray(lookup(count_states(projection, dataset_of(states)), states))
    # A code with n states is met n times: the sum of 1/n is the number of codes.
    projection = np.asarray(projection)
    codes = {reference.simhash(projection, *stats(states), s) for s in states}
    np.testing.assert_allclose((1.0 / n).sum(), len(codes), rtol=1e-6)
    assert n.min() >= 1


def stats(states):
    return reference.input_scaler(np.float64(states))


@pytest.mark.parametrize("num_bits", [31, 32])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_extreme_codes_are_exact_beside_padding(num_bits, sign):
    """All bits set is the padding's code; all bits clear is the other end."""
    projection = np.ones((num_bits, 1), np.float32)
    # Standardised, three states lie above the mean and one below, or vice versa.
    states = np.float32(sign) * np.float32([[1.0], [1.1], [0.9], [-5.0]])
    counts = count_states(projection, dataset_of(states, capacity=16))
    np.testing.assert_array_equal(lookup(counts, states), [3, 3, 3, 1])
    full = count_states(projection, dataset_of(states, capacity=4))
    np.testing.assert_array_equal(lookup(full, states), [3, 3, 3, 1])


def test_bit_31_counts():
    """Two states that differ in the last bit only have two codes."""
    projection = np.zeros((32, 2), np.float32)
    projection[:31, 0] = projection[31, 1] = 1.0
    states = np.float32([[1.0, 1.0], [1.0, -1.0], [-2.0, 0.5]])
    counts = count_states(projection, dataset_of(states, capacity=8))
    np.testing.assert_array_equal(lookup(counts, states), [1, 1, 1])


def test_bonus_falls_with_the_root_of_visits():
    other = np.float32([[-1.0, 2.0]])
    for visits in (1, 3, 24):
        states = np.concatenate(
            [np.repeat(np.float32([[2.0, -1.0]]), visits, 0), other]
        )
        counts = count_states(simhash(jax.random.key(0), 16, 2), dataset_of(states))
        bonus = bonus_of(counts, None, None, states[:1])
        np.testing.assert_allclose(bonus, 1 / np.sqrt(1 + visits), rtol=1e-5)


def test_unseen_states_have_the_full_bonus():
    projection = simhash(jax.random.key(0), 32, D)
    empty = count_states(projection, jaxpets.datasets.init(CAPACITY, D, 1))
    obs = jnp.asarray(clustered()[:20].reshape(4, 5, D))
    np.testing.assert_array_equal(lookup(empty, obs), np.zeros((4, 5)))
    np.testing.assert_array_equal(bonus_of(empty, obs, None, obs), 1.0)


def test_old_states_are_hashed_anew():
    """Statistics of more data move old states to other codes."""
    projection = simhash(jax.random.key(1), 16, D)
    states = clustered()
    shifted = np.concatenate([states, states + 40.0])
    before = count_states(projection, dataset_of(states, 1024))
    after = count_states(projection, dataset_of(shifted, 1024))
    want = reference.DictCounts(np.asarray(projection), shifted)
    assert margin(want, shifted) > 1e-6
    got = lookup(after, jnp.asarray(states[:50]))
    np.testing.assert_array_equal(got, [want.count(s) for s in states[:50]])
    assert np.any(got != lookup(before, jnp.asarray(states[:50])))


def test_counts_follow_a_ring_that_went_round():
    states = clustered(size=300)
    dataset = jaxpets.datasets.init(200, D, 1)
    append = jax.jit(jaxpets.datasets.append)
    for part in states.reshape(2, 150, D):
        dataset = append(dataset, jaxpets.Transition(part, part[:, :1], part))
    projection = np.asarray(simhash(jax.random.key(2), 32, D))
    want = reference.DictCounts(projection, states[-200:])
    assert margin(want, states) > 1e-5
    got = lookup(count_states(jnp.asarray(projection), dataset), states[:60])
    np.testing.assert_array_equal(got, [want.count(s) for s in states[:60]])


def test_rewards_particles_inside_a_planner(key):
    states = clustered()[:, :2]
    projection = simhash(key, 8, 2)
    counts = count_states(projection, dataset_of(states))
    rollout = jaxpets.particle_rollout(toys.noisy_cart, num_members=2, num_particles=4)
    planner = jaxpets.plan(rollout, pseudo_count, toys.optimizer("cem"))
    params = jaxpets.PlanParams(jnp.float32(1.0), counts)
    out, _ = jax.jit(planner.step)(params, key, planner.init(), jnp.asarray(states[0]))
    assert 0 < out.value <= 5.0  # at most 1 a step


def test_simhash_is_standard_normal():
    projection = simhash(jax.random.key(0), 32, 500)
    assert projection.shape == (32, 500) and projection.dtype == jnp.float32
    assert abs(projection.mean()) < 0.03 and abs(projection.std() - 1) < 0.03


def test_bad_arguments_fail_when_built(key):
    with pytest.raises(ValueError, match="num_bits must be at most 32, got 33"):
        simhash(key, 33, D)
    with pytest.raises(ValueError, match="num_bits must be at least 1, got 0"):
        simhash(key, 0, D)
    data = dataset_of(clustered())
    with pytest.raises(ValueError, match="at most 32 rows, got 33"):
        count_states(jnp.zeros((33, D)), data)
    with pytest.raises(ValueError, match=r"projection must be float32\[k, 6\], got"):
        count_states(jnp.zeros((8, D + 1)), data)
    counts = count_states(jnp.ones((8, D)), data)
    with pytest.raises(ValueError, match=r"obs must be float32\[\.\.\., 6\], got"):
        lookup(counts, jnp.zeros((3, D + 1)))
