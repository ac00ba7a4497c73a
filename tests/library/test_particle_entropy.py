import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets.rewards import particle_entropy

D = 3
visited_states = jax.jit(jaxpets.rewards.visited_states, static_argnums=1)


def dataset_of(rows, capacity=None):
    rows, capacity = np.float32(rows), capacity or len(rows)
    data = jaxpets.Transition(np.zeros_like(rows), rows[:, :1], rows)
    empty = jaxpets.datasets.init(capacity, D, 1)
    return toys.dataset_of(data, capacity) if len(rows) else empty


def some_rows(count, seed=0):
    scale = np.array([0.1, 1.0, 30.0])
    rows = scale * np.random.default_rng(seed).normal(size=(count, D))
    return rows.astype(np.float32)


@functools.cache
def jitted(k):
    return jax.jit(particle_entropy(k))


def entropy(visited, states, k=3):
    states = np.float32(states)
    return np.asarray(jitted(k)(visited, states, jnp.zeros(1), states))


@pytest.mark.parametrize("count", [10, 2])
def test_particle_entropy_equals_the_reference(count):
    """The mean over the nearest, or over all, while there are fewer than k."""
    rows, states = some_rows(count), some_rows(8, seed=1).reshape(2, 4, D)
    got = entropy(visited_states(dataset_of(rows, capacity=20), 20), states)
    assert got.shape == (2, 4)
    unit = np.float64(rows).std(0)
    distance = np.linalg.norm((np.float64(states)[:, :, None] - rows) / unit, axis=-1)
    nearest = np.sort(distance, axis=-1)[..., :3]
    np.testing.assert_allclose(got, np.log(1 + nearest.mean(-1)), rtol=1e-4)


def test_before_any_data_no_state_is_worth_more():
    visited = visited_states(dataset_of(some_rows(0), capacity=5), 4)
    np.testing.assert_array_equal(entropy(visited, some_rows(6)), np.zeros(6))
    assert np.isnan(entropy(visited, np.full((2, D), [[np.nan], [np.inf]]))).all()


def test_visited_states_are_spread_over_the_data():
    rows = np.arange(10.0)[:, None] * np.ones(D)
    visited = visited_states(dataset_of(rows, capacity=12), 5)
    found = np.asarray(visited.states) * visited.std + np.asarray(visited.mean)
    np.testing.assert_allclose(found[:, 0], [0, 2, 4, 6, 8], atol=1e-5)
    assert visited.used.all()


def test_a_state_that_is_not_finite_is_no_neighbour():
    rows = some_rows(10)
    rows[4, 1] = np.nan
    visited = visited_states(dataset_of(rows), 10)
    assert visited.used.sum() == 9
    assert np.isfinite(entropy(visited, some_rows(6))).all()
    imagined = np.float32([[0.0, np.inf, 0.0], [np.nan, 0.0, 0.0]])
    assert not np.isfinite(entropy(visited, imagined)).any()


def test_a_far_state_is_worth_more_in_any_unit():
    rows = some_rows(30)
    states = np.stack([rows.mean(0), 5 * rows.std(0)])
    near, far = entropy(visited_states(dataset_of(rows), 30), states)
    assert far > near + 1
    unit = np.float32([1e3, 1e-2, 7])
    again = entropy(visited_states(dataset_of(unit * rows), 30), unit * states)
    np.testing.assert_allclose(again, [near, far], rtol=1e-3)


def test_what_does_not_fit_is_refused():
    visited = visited_states(dataset_of(some_rows(5)), 5)
    with pytest.raises(ValueError, match="num_neighbors must be at least 1, got 0"):
        particle_entropy(0)
    with pytest.raises(ValueError, match="num_states must be at least 6, got 5"):
        entropy(visited, some_rows(2), k=6)
    with pytest.raises(TypeError, match="params must be a VisitedStates, got"):
        entropy(visited.states, some_rows(2))
    with pytest.raises(ValueError, match=r"next_obs must be float32\[..., 3\], got"):
        entropy(visited, np.zeros((4, 2)))
    with pytest.raises(TypeError, match="dataset must be a Dataset"):
        visited_states(some_rows(5), 5)
