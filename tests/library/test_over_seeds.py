"""Many seeds of a learner are the learners of the seeds."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import toys

import jaxpets
from jaxpets import FitConfig, RewardData

ENV = toys.cart_env()
MODEL = toys.small_ensemble(num_members=2, hidden_sizes=(4,), weight_decays=1e-4)
LENGTH, CAPACITY = 4, 8
CHANCE = jaxpets.random_planner(ENV.action_low, ENV.action_high)
BASELINE = RewardData(
    init=lambda key: jax.random.uniform(key, (2,), jnp.float32),
    refresh=lambda data, params, dataset: jaxpets.rewards.max_variance(params),
)
# Mapped products round otherwise. Adam would divide that by gradients near zero; plain
# descent leaves it as small as it is.
CLOSE = dict(rtol=1e-4, atol=1e-6)


def build(reward_data=BASELINE):
    config = FitConfig(num_epochs=2, batch_size=4)
    fitter = jaxpets.fitter(MODEL, optax.sgd(1e-2), config)
    return jaxpets.learner(
        ENV, MODEL, fitter, reward_data, trial_length=LENGTH, capacity=CAPACITY
    )


LEARNER = build()


def keys_of(*axes):
    """Four keys for every seed, stage first."""
    return jnp.moveaxis(jax.random.split(jax.random.key(7), (*axes, 4)), -1, 0)


class Programs(NamedTuple):
    """A learner whose functions are compiled once; they take the state for good."""

    init: object
    step: object
    learn: object


@functools.cache
def programs(*num_seeds):
    """Of the learner over seeds, over seeds of seeds, or of one seed."""
    learner = LEARNER
    for number in reversed(num_seeds):
        learner = jaxpets.over_seeds(learner, number)
    step = functools.partial(learner.step, CHANCE)
    taken = dict(donate_argnums=1)
    return Programs(
        jax.jit(learner.init), jax.jit(step, **taken), jax.jit(learner.learn, **taken)
    )


def run(learner, keys):
    """Two trials, and a third part of learning from transitions that were recorded."""
    axes = keys.shape[1:]
    state = learner.init(keys[0])
    state, first = learner.step(keys[1], state)
    state, second = learner.step(keys[2], state)
    rows = toys.transitions(LENGTH)
    rows = jax.tree.map(lambda x: np.broadcast_to(x, (*axes, *x.shape)), rows)
    state, metrics = learner.learn(keys[3], state, rows)
    return jax.tree.map(np.asarray, (state, (first, second, metrics)))


def assert_seed_equals(many, index, one):
    """The seed at `index` of many is that one, in everything that it has to itself."""
    state, outputs = many
    shared = state.dataset.size, state.dataset.cursor
    assert [x.shape for x in shared] == [(), ()]
    size, cursor = one[0].dataset.size, one[0].dataset.cursor
    assert [int(x) for x in shared] == [int(size), int(cursor)]
    own = (state.params, state.fit, state.dataset.data, state.reward, outputs)
    want = (one[0].params, one[0].fit, one[0].dataset.data, one[0].reward, one[1])
    got = jax.tree.map(lambda x: x[index], own)
    toys.assert_trees_close(got, want, **CLOSE)


def test_many_seeds_are_a_loop_over_the_seeds(num_seeds=3):
    keys = keys_of(num_seeds)
    got = run(programs(num_seeds), keys)
    for seed in range(num_seeds):
        assert_seed_equals(got, seed, run(programs(), keys[:, seed]))


def test_seeds_of_seeds_are_a_loop_over_both():
    outer, inner = 2, 1  # within, a single seed
    keys = keys_of(outer, inner)
    got = run(programs(outer, inner), keys)
    for index in np.ndindex(outer, inner):
        assert_seed_equals(got, index, run(programs(), keys[:, *index]))


def test_the_axes_of_a_state_are_the_public_ones():
    seeds = jaxpets.over_seeds(LEARNER, 3)
    many = jax.eval_shape(seeds.init, keys_of(3)[0])
    one = jax.eval_shape(LEARNER.init, jax.random.key(0))
    wanted = jaxpets.SEED_AXES
    axes = jax.tree.broadcast(wanted, one, is_leaf=lambda axis: axis is None)
    leaves = jax.tree.leaves(axes, is_leaf=lambda axis: axis is None)
    every = zip(jax.tree.leaves(many), jax.tree.leaves(one), leaves, strict=True)
    for got, alone, axis in every:
        assert got.shape == (alone.shape if axis is None else (3, *alone.shape))


def test_a_learner_may_have_no_reward_data():
    learner = build(RewardData())
    assert jax.eval_shape(learner.init, jax.random.key(0)).reward == ()
    seeds = jaxpets.over_seeds(learner, 2)
    assert jax.eval_shape(seeds.init, keys_of(2)[0]).reward == ()


@pytest.mark.parametrize("num_seeds", [0, -1])
def test_there_is_at_least_one_seed(num_seeds):
    with pytest.raises(ValueError, match="num_seeds must be at least 1, got"):
        jaxpets.over_seeds(LEARNER, num_seeds)


@pytest.mark.parametrize("num_seeds", [2.0, None, jnp.int32(2), True])
def test_the_number_of_seeds_is_an_integer(num_seeds):
    with pytest.raises(TypeError, match="num_seeds must be a Python int, got"):
        jaxpets.over_seeds(LEARNER, num_seeds)


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_there_are_as_many_keys_as_seeds(num_seeds):
    seeds = jaxpets.over_seeds(LEARNER, num_seeds)
    message = rf"keys must be {num_seeds} keys, got shape \(3,\)"
    with pytest.raises(ValueError, match=message):
        seeds.init(keys_of(3)[0])


@pytest.mark.parametrize("num_seeds", [1, 2])
def test_there_are_as_many_states_and_transitions_as_seeds(num_seeds):
    """Of one seed's programs the first of several would be all that is left."""
    seeds, keys = jaxpets.over_seeds(LEARNER, num_seeds), keys_of(num_seeds)[0]
    state, others = (
        jax.eval_shape(jaxpets.over_seeds(LEARNER, n).init, keys_of(n)[0])
        for n in (num_seeds, 3)
    )
    rows = jax.tree.map(lambda x: np.stack([x] * 3), toys.transitions(LENGTH))
    learn = functools.partial(jax.eval_shape, seeds.learn)
    message = (
        rf"state\.params.* must have a first axis of {num_seeds} seeds, got .*\(3,"
    )
    with pytest.raises(ValueError, match=message):
        learn(keys, others, rows)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(functools.partial(seeds.step, CHANCE), keys, others)
    message = (
        rf"transitions\.obs must have a first axis of {num_seeds} seeds, got .*\(3,"
    )
    with pytest.raises(ValueError, match=message):
        learn(keys, state, rows)
    shared = state._replace(reward=jax.ShapeDtypeStruct((), jnp.float32))
    with pytest.raises(ValueError, match=r"state\.reward must .* got the shape \(\)"):
        learn(keys, shared, rows)
    size = jax.ShapeDtypeStruct((num_seeds,), jnp.int32)  # as jax.vmap would have it
    apart = state._replace(dataset=state.dataset._replace(size=size))
    with pytest.raises(ValueError, match=r"state\.dataset\.size must be \[\], which"):
        learn(keys, apart, rows)


# -- buffers -------------------------------------------------------------------------


def assert_every_leaf_is_a_buffer_of_its_own(tree):
    leaves = [x for x in jax.tree.leaves(tree) if x.size]
    assert len({x.unsafe_buffer_pointer() for x in leaves}) == len(leaves)


@pytest.mark.parametrize("num_seeds", [None, 3])
def test_a_state_made_outside_of_jit_can_be_donated(num_seeds):
    """Leaves that share a buffer fail: 'Attempt to donate the same buffer twice'."""
    learner, keys, step = LEARNER, keys_of(), programs().step
    if num_seeds:
        learner, keys = jaxpets.over_seeds(LEARNER, num_seeds), keys_of(num_seeds)
        step = programs(num_seeds).step
    state = learner.init(keys[0])
    assert_every_leaf_is_a_buffer_of_its_own(state)
    after, _ = step(keys[1], state)
    assert after.dataset.size == LENGTH and state.dataset.size.is_deleted()


@pytest.mark.parametrize("num_seeds", [None, 1, 2])
def test_so_can_one_whose_reward_reads_the_parameters(num_seeds):
    """As the data of opax or plan2explore do."""
    learner, keys = build(RewardData(refresh=lambda _, params, __: params)), keys_of()
    if num_seeds:
        learner, keys = jaxpets.over_seeds(learner, num_seeds), keys_of(num_seeds)
    state = learner.init(keys[0])
    assert_every_leaf_is_a_buffer_of_its_own(state)
    chunk = toys.transitions(LENGTH)
    if num_seeds:
        chunk = jax.tree.map(lambda x: jnp.repeat(x[None], num_seeds, axis=0), chunk)
    state, _ = learner.learn(keys[1], state, chunk)
    assert_every_leaf_is_a_buffer_of_its_own(state)


def test_data_of_a_reward_may_be_numbers_of_python():
    """The weight of a mixture may be one; one seed has no other way than two."""
    mixed = jaxpets.rewards.MixtureData
    reward_data = RewardData(
        refresh=lambda _, params, __: mixed(
            (), jaxpets.rewards.max_variance(params), 0.5
        )
    )
    for num_seeds in (1, 2):
        learner = jaxpets.over_seeds(build(reward_data), num_seeds)
        keys = keys_of(num_seeds)
        step = jax.jit(functools.partial(learner.step, CHANCE))
        state, _ = step(keys[1], jax.jit(learner.init)(keys[0]))
        np.testing.assert_array_equal(state.reward.weight, np.full(num_seeds, 0.5))


def test_a_dataset_made_outside_of_jit_can_be_donated():
    dataset = jaxpets.datasets.init(CAPACITY, 2, 1)
    assert_every_leaf_is_a_buffer_of_its_own(dataset)
    append = jax.jit(jaxpets.datasets.append, donate_argnums=0)
    after = append(dataset, toys.transitions(LENGTH))
    assert after.size == LENGTH and dataset.size.is_deleted()
