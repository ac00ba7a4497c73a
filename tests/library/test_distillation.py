import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets.rewards import random_network_distillation

D = 2
SIZES = dict(obs_size=D, hidden_size=16, num_features=4)
RND = random_network_distillation(
    optax.adam(1e-2), **SIZES, num_epochs=20, batch_size=8
)
REWARD = jax.jit(RND.reward)


def dataset_of(rows, capacity=64):
    rows = np.asarray(rows, np.float32)
    data = jaxpets.Transition(rows, rows[:, :1], rows)
    empty = jaxpets.datasets.init(capacity, D, 1)
    return toys.dataset_of(data, capacity) if len(rows) else empty


def some_rows(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, D)).astype(np.float32)


@pytest.fixture(scope="module")
def refresh():
    return jax.jit(RND.refresh)


@pytest.fixture(scope="module")
def untrained():
    return jax.jit(RND.init)(jax.random.key(0))


def novelty(state, rows):
    rows = jnp.asarray(rows)
    return np.asarray(REWARD(state, rows, jnp.zeros(1), rows))


def outputs(layers, x):
    """What a network of rectifiers makes of rows, in float64."""
    for number, (kernel, bias) in enumerate(layers, start=1):
        x = x @ np.float64(kernel) + np.float64(bias)
        x = x if number == len(layers) else np.maximum(x, 0)
    return x


def test_the_reward_equals_the_reference(refresh, untrained):
    rows = 3 * some_rows(30) + 1
    state = refresh(untrained, (), dataset_of(rows))
    assert (len(state.target), len(state.predictor)) == (3, 5)
    mean, std = np.float64(rows).mean(0), np.float64(rows).std(0)

    def error(x):
        z = np.clip((x - mean) / std, -5, 5)
        nets = (outputs(net, z) for net in (state.predictor, state.target))
        return np.sum(np.subtract(*nets) ** 2, -1)

    np.testing.assert_allclose(state.scale, error(rows).mean(), rtol=1e-3)
    states = 20 * some_rows(12, seed=1).reshape(3, 4, D)
    want = error(np.float64(states)) / error(rows).mean()
    got = novelty(state, states)
    assert got.shape == (3, 4)
    # The error is a difference of outputs that are nearly equal.
    np.testing.assert_allclose(got, want, rtol=1e-2, atol=1e-3)


def test_what_was_visited_is_less_new(refresh, untrained):
    rows = some_rows(60) * np.float32(0.3)
    rows[30:] += 2.0  # two heaps, and nothing between or beside them
    state = untrained
    for _ in range(3):
        state = refresh(state, (), dataset_of(rows))
    assert novelty(state, rows).mean() == pytest.approx(1.0, rel=1e-3)
    elsewhere = np.float32([[2.0, 0.0], [0.0, 2.0], [4.0, -1.0]])
    assert novelty(state, elsewhere).min() > 5
    assert state.scale < 0.05 * untrained_error(untrained, state, rows)
    jax.tree.map(np.testing.assert_array_equal, untrained.target, state.target)


def untrained_error(untrained, state, rows):
    """What the predictor's error was at first, on inputs of the same scale."""
    first = state._replace(predictor=untrained.predictor, scale=jnp.float32(1))
    return novelty(first, rows).mean()


def test_without_data_nothing_is_learned(refresh, untrained):
    state = refresh(untrained, (), dataset_of(some_rows(0)))
    jax.tree.map(np.testing.assert_array_equal, untrained, state)
    assert np.isfinite(novelty(state, some_rows(3))).all()


def test_padding_and_rows_that_are_not_finite_teach_nothing(refresh, untrained):
    rows = some_rows(20)
    bad = np.concatenate([rows[:12], np.full((1, D), np.nan, np.float32)])
    state = refresh(untrained, (), dataset_of(bad))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state))
    # Two batches of 13 rows have the rows of 12 and of 13 at the same places.
    want = refresh(untrained, (), dataset_of(rows[:12]))
    np.testing.assert_allclose(state.scale, want.scale, rtol=1e-3)


def test_an_imagined_state_that_blew_up_has_no_novelty(untrained):
    assert np.isnan(novelty(untrained, np.float32([[np.inf, 0], [0, np.nan]]))).all()


def test_a_step_that_is_not_finite_is_left_out():
    """As of a rate at which training blows up; it stays usable."""
    wild = random_network_distillation(
        optax.sgd(1e4), **SIZES, num_epochs=20, batch_size=8
    )
    state = jax.jit(wild.init)(jax.random.key(0))
    for _ in range(2):
        state = jax.jit(wild.refresh)(state, (), dataset_of(some_rows(60)))
    assert np.isfinite(novelty(state, some_rows(2, seed=1))).all()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.predictor))


def test_it_is_reward_data_of_a_learner(untrained):
    """It keeps its shapes, over seeds as well."""
    data = jaxpets.RewardData(RND.init, RND.refresh)
    template = jax.eval_shape(lambda: data.init(jax.random.key(0)))
    after = jax.eval_shape(data.refresh, template, (), dataset_of(some_rows(3)))
    described = jax.tree.map(lambda x: (x.shape, x.dtype), (template, after))
    assert described[0] == described[1]


def test_what_does_not_fit_is_refused(untrained):
    with pytest.raises(TypeError, match="optimizer must be of optax"):
        random_network_distillation(1e-3, obs_size=2)
    with pytest.raises(ValueError, match="num_epochs must be at least 1, got 0"):
        random_network_distillation(optax.sgd(1.0), obs_size=2, num_epochs=0)
    with pytest.raises(TypeError, match="params must be a DistillationState, got"):
        novelty((), some_rows(2))
    with pytest.raises(ValueError, match=r"next_obs must be float32\[..., 2\], got"):
        novelty(untrained, np.zeros((3, 4), np.float32))
    with pytest.raises(TypeError, match="key must be a typed key"):
        RND.init(jax.random.PRNGKey(0))
    with pytest.raises(TypeError, match="dataset must be a Dataset, got tuple"):
        RND.refresh(untrained, (), ())
    with pytest.raises(ValueError, match=r"next_obs must be float32\[C, 2\], got"):
        RND.refresh(untrained, (), jaxpets.datasets.init(4, 3, 1))
