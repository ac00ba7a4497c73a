import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import FitConfig, RewardData, coordinates

ENV = toys.cart_env()
MODEL = toys.small_ensemble()
FITTER = jaxpets.fitter(MODEL, optax.adam(3e-3), FitConfig(num_epochs=10, batch_size=8))
ROLLOUT = jaxpets.particle_rollout(MODEL.sample, num_members=3, num_particles=6)
EXPLORER = jaxpets.plan(ROLLOUT, jaxpets.rewards.epistemic, toys.optimizer("cem"))
CHANCE = jaxpets.random_planner(ENV.action_low, ENV.action_high)
BASELINE = RewardData(
    init=lambda key: jnp.zeros(2),
    refresh=lambda data, params, dataset: jaxpets.rewards.max_variance(params),
)
LENGTH = 20


def build(reward_data=BASELINE, capacity=3 * LENGTH, trial_length=LENGTH):
    return jaxpets.learner(
        ENV, MODEL, FITTER, reward_data, trial_length=trial_length, capacity=capacity
    )


LEARNER = build()
INIT = jax.jit(LEARNER.init)
STEPS = [
    jax.jit(lambda key, state, planner=planner: LEARNER.step(planner, key, state))
    for planner in (CHANCE, EXPLORER)
]


def trial(number, key, state):
    """Trial 0 is random, the others explore; keys as an experiment derives them."""
    return STEPS[min(number, 1)](jax.random.fold_in(key, number), state)


def test_no_key_is_used_twice(key):
    state = INIT(key)
    with jax.debug_key_reuse(True):  # which checks what is traced
        jax.jit(LEARNER.init).trace(key)
        jax.jit(lambda key, state: LEARNER.step(EXPLORER, key, state)).trace(key, state)


@pytest.mark.parametrize("unroll", [True, False])
def test_types_are_float32_and_int32_where_64_bits_are_enabled(key, unroll):
    """And nothing is promoted without a word."""
    search = jaxpets.optimizers.icem(
        horizon=3, action_low=ENV.action_low, action_high=ENV.action_high, unroll=unroll
    )
    planner = jaxpets.plan(ROLLOUT, jaxpets.rewards.epistemic, search)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("strict"):
        learner = build()
        state, _ = jax.eval_shape(
            lambda key: learner.step(planner, key, learner.init(key)), key
        )
    kinds = {x.dtype for x in jax.tree.leaves(state)}
    assert kinds == {jnp.dtype(jnp.float32), jnp.dtype(jnp.int32)}


def test_starts_with_nothing_but_a_model(key):
    state = INIT(key)
    assert state.dataset.size == 0
    assert state.dataset.data.obs.shape == (3 * LENGTH, 2)
    np.testing.assert_allclose(state.reward, np.exp(0.5), rtol=1e-6)


def test_a_trial_acts_learns_and_refreshes(key):
    state = INIT(key)
    after, output = trial(0, key, state)
    assert after.dataset.size == LENGTH
    assert output.transitions.obs.shape == (LENGTH, 2)
    assert output.plans.action.shape == (LENGTH, 1)
    np.testing.assert_array_equal(
        after.dataset.data.obs[:LENGTH], output.transitions.obs
    )
    assert output.fit.num_updates == 10 * 3
    np.testing.assert_array_equal(
        after.reward, jaxpets.rewards.max_variance(after.params)
    )
    assert jnp.any(after.reward != state.reward)


def error_of(params):
    """Squared error of the mean model on states all over the cart's space."""
    draw = np.random.default_rng(9).uniform
    obs, action = (draw(-1, 1, (200, size)).astype(np.float32) for size in (2, 1))
    shared = np.broadcast_to(obs, (3, 200, 2))
    mean, _ = jax.jit(MODEL.predict)(params, shared, action)
    return float(np.mean((mean - toys.cart(1.0, None, shared, action)) ** 2))


def test_the_model_gets_better_and_the_planner_uses_it(key):
    state, errors = INIT(key), []
    for number in range(3):
        state, output = trial(number, key, state)
        errors.append(error_of(state.params))
        assert jnp.all(jnp.abs(output.plans.action) <= 1)
    # A random trial stays where it starts; two that seek the unknown do not.
    assert errors[2] < 0.5 * errors[0]
    assert output.plans.value.mean() > 0  # disagreement, summed over the plan


def test_resumed_equals_straight_bitwise(key):
    """State through the host, as a checkpoint takes it, and a new program."""
    state = INIT(key)
    for number in range(3):
        state, output = trial(number, key, state)
    again = INIT(key)
    for number in range(2):
        again, _ = trial(number, key, again)
    saved = jax.tree.map(np.asarray, again)
    loaded = jax.tree.map(jnp.asarray, saved)
    fresh = build()
    step = jax.jit(lambda key, state: fresh.step(EXPLORER, key, state))
    resumed, resumed_output = step(jax.random.fold_in(key, 2), loaded)
    toys.assert_trees_close((resumed, resumed_output), (state, output), rtol=0)


def test_one_trace_and_stable_avals_while_data_grow(key):
    step, state = STEPS[0], INIT(key)
    want = toys.avals(state)
    for number in range(4):  # past the capacity
        state, _ = step(jax.random.fold_in(key, number), state)
        assert toys.avals(state) == want
    assert step._cache_size() == 1
    assert state.dataset.size == 3 * LENGTH


def test_learning_alone_equals_its_half_of_a_trial(key):
    state = INIT(key)
    transitions = toys.transitions(LENGTH)
    after, metrics = jax.jit(LEARNER.learn)(key, state, transitions)
    dataset = jax.jit(jaxpets.datasets.append)(state.dataset, transitions)
    want = jax.jit(FITTER.step)(state.params, key, state.fit, dataset)
    # Two programs, whose sums XLA may order differently.
    toys.assert_trees_close((after.params, after.fit, metrics), want, atol=1e-6)
    toys.assert_trees_close(after.dataset, dataset, rtol=0)


def test_counts_are_rebuilt_once_per_trial(key):
    counter = RewardData(
        init=lambda key: jaxpets.rewards.count_states(
            jaxpets.rewards.simhash(key, 16, 2), jaxpets.datasets.init(3 * LENGTH, 2, 1)
        ),
        refresh=lambda counts, params, dataset: jaxpets.rewards.count_states(
            counts.projection, dataset
        ),
    )
    learner = build(counter)
    state = jax.jit(learner.init)(key)
    assert not state.reward.visits.any()
    planner = jaxpets.plan(ROLLOUT, jaxpets.rewards.pseudo_count, toys.optimizer("cem"))
    step = jax.jit(lambda key, state: learner.step(planner, key, state))
    for number in range(2):
        state, output = step(jax.random.fold_in(key, number), state)
        counted = jnp.sum(state.reward.visits > 0)
        assert counted == state.dataset.size == (number + 1) * LENGTH
        assert jnp.all(output.plans.value > 0)
    visited = jaxpets.rewards.lookup(state.reward, output.transitions.next_obs)
    assert jnp.all(visited >= 1)


def test_bad_settings_fail_when_built(key):
    with pytest.raises(ValueError, match="capacity must be at least 20, got 10"):
        build(capacity=10)
    with pytest.raises(ValueError, match="trial_length must be at least 1, got 0"):
        build(trial_length=0)
    with pytest.raises(TypeError, match="key must be a typed key"):
        LEARNER.init(jax.random.PRNGKey(0))


def test_reward_data_are_of_functions():
    with pytest.raises(
        TypeError, match=r"reward_data.refresh must be a function, got 3"
    ):
        build(jaxpets.RewardData(refresh=3))


def test_reward_data_that_change_shape_fail_when_traced(key):
    """They would retrace every trial, and fail to be restored."""
    growing = RewardData(
        init=lambda key: jnp.zeros(2),
        refresh=lambda data, params, dataset: jnp.concatenate([data, data]),
    )
    learner = build(growing)
    state = jax.eval_shape(learner.init, key)
    with pytest.raises(ValueError, match="refresh's result must be float32"):
        jax.eval_shape(
            lambda: learner.step(
                CHANCE, key, INIT(key)._replace(reward=jnp.zeros(state.reward.shape))
            )
        )


@pytest.mark.parametrize(("names", "other"), [("qw", True), ("qv", False)])
def test_a_model_is_of_the_entries_of_the_environment(names, other):
    """Of those of another robot of the same size it would learn all the same."""

    def rows(names, kind="relative"):
        return tuple(coordinates.Coordinate(name, kind) for name in names)

    env = ENV._replace(coordinates=rows("qv"))
    # In which kind a model sees an entry is its own affair.
    space = coordinates.space(rows(names, "absolute"))
    model = toys.small_ensemble(space=space)
    learner = functools.partial(
        jaxpets.learner, env, model, FITTER, trial_length=3, capacity=3
    )
    if not other:
        learner()
        return
    message = "entries of env.coordinates, but entry 1 is 'v' there and 'w' in its"
    with pytest.raises(ValueError, match=message):
        learner()
