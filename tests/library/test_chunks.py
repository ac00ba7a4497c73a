"""Candidates in chunks: the same values, the same noise, less memory."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from cases import LEARNED, MODELS, NOISY, cart_obs, key_of, keys_of, model
from jax.extend.random import threefry2x32_p

import jaxpets
from jaxpets import PlanParams
from jaxpets._src.chunks import chunked, window

TOTAL = 12
SIZES = [1, 4, 5, 7, 11, 12, 100]  # 1, 4 and 12 divide, 100 is more than there are
ROLLOUTS = {
    "ensemble": (LEARNED, model(0)),
    "toy": (NOISY, jnp.float32(1.0)),
    "no noise": (jaxpets.particle_rollout(toys.cart), jnp.float32(1.0)),
}
# Batches of other lengths add up in another order: float32 rounding over 4 steps.
ROUNDING = dict(rtol=1e-5, atol=1e-6)


def candidates(total=TOTAL, horizon=4):
    """Action sequences `[N, H, 1]`, none like another."""
    return jnp.sin(jnp.arange(float(total * horizon))).reshape(total, horizon, 1)


def step_of(rollout, chunk_size, total=TOTAL):
    """A planner's step whose new state is the value of every candidate."""
    probe = toys.probe(candidates(total))
    planner = jaxpets.plan(rollout, toys.reach, probe, chunk_size=chunk_size)
    return lambda params, key, obs: planner.step(params, key, probe.init(), obs)[1]


@functools.cache
def values_at_once(name):
    rollout, dynamics = ROLLOUTS[name]
    args = PlanParams(dynamics, jnp.float32(0.5)), key_of(0), cart_obs(1)
    return args, np.asarray(jax.jit(step_of(rollout, None))(*args))


@pytest.mark.parametrize("chunk_size", SIZES)
@pytest.mark.parametrize("name", ROLLOUTS)
def test_values_are_those_of_all_at_once(name, chunk_size):
    args, want = values_at_once(name)
    got = jax.jit(step_of(ROLLOUTS[name][0], chunk_size))(*args)
    assert len(np.unique(want)) == TOTAL
    np.testing.assert_allclose(got, want, **ROUNDING)


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
def test_the_plan_is_the_same(name):
    """iCEM's populations shrink, and carry one candidate more at the end."""
    args = PlanParams(jnp.float32(1.0), jnp.float32(0.5)), key_of(0)
    outs = []
    for chunk_size in (None, 7):
        planner = jaxpets.plan(
            NOISY, toys.reach, toys.optimizer(name), chunk_size=chunk_size
        )
        outs.append(jax.jit(planner.step)(*args, planner.init(), cart_obs(0)))
    toys.assert_trees_close(outs[0], outs[1], rtol=1e-4, atol=1e-5)  # test_transforms


@pytest.mark.parametrize("chunk_size", [4, 5])
def test_vmap_over_seeds(chunk_size):
    params = PlanParams(MODELS, jnp.array([0.5, 0.0, -0.5]))
    obs = jnp.stack([cart_obs(i) for i in range(3)])
    steps = [
        jax.jit(jax.vmap(step_of(LEARNED, size), (PlanParams(0, 0), 0, 0)))
        for size in (None, chunk_size)
    ]
    want, got = (step(params, keys_of(3), obs) for step in steps)
    np.testing.assert_allclose(got, want, **ROUNDING)


def test_eager_equals_jit():
    args = PlanParams(jnp.float32(1.0), jnp.float32(0.5)), key_of(0), cart_obs(1)
    step = step_of(NOISY, 5)
    np.testing.assert_allclose(step(*args), jax.jit(step)(*args), **ROUNDING)


def test_no_more_than_a_chunk_at_a_time():
    lengths = []

    def objective(key, actions):
        lengths.append(actions.shape[0])
        return jnp.sum(actions, (1, 2))

    actions = candidates(10)
    got = chunked(objective, 4)(key_of(0), actions)
    assert set(lengths) == {4}  # 4, 4 and 2 of the 4 before
    np.testing.assert_allclose(got, jnp.sum(actions, (1, 2)), rtol=1e-6)
    lengths.clear()
    chunked(objective, 5)(key_of(0), actions)
    assert set(lengths) == {5}


DRAWS = {
    "normal": lambda key, shape: jax.random.normal(key, shape, jnp.float32),
    "uniform": lambda key, shape: jax.random.uniform(key, shape, jnp.float32),
    "16 bits": lambda key, shape: jax.random.bits(key, shape, jnp.uint16),
    "coin": lambda key, shape: jax.random.bernoulli(key, 0.5, shape),
}
KEYS = {
    "key": lambda key: key,
    "split": lambda key: jax.random.split(key, 3)[1],
    "split in a grid": lambda key: jax.random.split(key, (2, 3))[1, 2],
    "fold_in": lambda key: jax.random.fold_in(key, 7),
    "both": lambda key: jax.random.fold_in(jax.random.split(key)[1], 2**31),
}


@pytest.mark.parametrize("draw", DRAWS.values(), ids=DRAWS)
@pytest.mark.parametrize("derive", KEYS.values(), ids=KEYS)
def test_a_window_draws_its_rows(derive, draw):
    """3 rows per candidate, candidates 4 to 8 of 12, bit for bit."""
    whole = draw(derive(key_of(0)), (5, 36, 2))
    part = window(key_of(0), jnp.int32(4), 5, 12)
    np.testing.assert_array_equal(draw(derive(part), (5, 15, 2)), whole[:, 12:27])


def test_a_window_draws_rows_without_columns():
    whole = jax.random.normal(key_of(0), (5, 12), jnp.float32)
    got = jax.random.normal(window(key_of(0), jnp.int32(7), 5, 12), (5, 5), jnp.float32)
    np.testing.assert_array_equal(got, whole[:, 7:])


def test_a_window_counts_to_the_last_of_32_bits():
    """2^32 elements in all; the last member's last row is element 2^32 - 1."""
    size, total = 2**15, 2**16
    part = window(key_of(0), jnp.int32(total - 1), 1, total)
    got = jax.random.bits(part, (2, 1, size), jnp.uint32)
    keys = jax.random.key_data(key_of(0))
    index = jnp.stack([jnp.uint32(2**31 - 1), jnp.uint32(2**32 - 1)])
    high, low = threefry2x32_p.bind(keys[0], keys[1], jnp.zeros_like(index), index)
    np.testing.assert_array_equal(got[:, 0, -1], high ^ low)


def test_chunks_obey_the_key_checker():
    step = step_of(NOISY, 5)
    args = PlanParams(jnp.float32(1.0), jnp.float32(0.5)), key_of(0), cart_obs(1)
    with jax.debug_key_reuse(True):  # which checks what is traced
        assert jax.jit(step).trace(*args).out_info.shape == (TOTAL,)


@pytest.mark.parametrize("vmapped", [False, True])
def test_memory_shrinks_with_the_chunk(vmapped):
    seeds = lambda x: jnp.stack([x] * 4) if vmapped else x  # noqa: E731
    params = jax.tree.map(seeds, PlanParams(model(0), jnp.float32(0.5)))
    args = params, keys_of(4) if vmapped else key_of(0), seeds(cart_obs(0))

    def temporary(chunk_size):
        step = step_of(LEARNED, chunk_size, total=2000)
        step = jax.vmap(step) if vmapped else step
        analysis = jax.jit(step).lower(*args).compile().memory_analysis()
        return analysis.temp_size_in_bytes

    whole = temporary(None)
    # A tenth of the candidates, and room for the values of all and for constants.
    assert temporary(200) < 0.2 * whole
    assert temporary(1000) < 0.6 * whole


@pytest.mark.parametrize("chunk_size", [0, -3])
def test_a_chunk_has_at_least_one_candidate(chunk_size):
    with pytest.raises(ValueError, match=f"chunk_size.*{chunk_size}"):
        step_of(NOISY, chunk_size)


@pytest.mark.parametrize("chunk_size", [2.0, "5", True, jnp.int32(4)])
def test_a_chunk_size_is_a_python_integer(chunk_size):
    with pytest.raises(TypeError, match="chunk_size"):
        step_of(NOISY, chunk_size)


def test_other_kinds_of_keys_are_refused():
    args = PlanParams(jnp.float32(1.0), jnp.float32(0.5)), cart_obs(1)
    for kind in ("rbg", "unsafe_rbg"):
        key = jax.random.key(0, impl=kind)
        with pytest.raises(ValueError, match=f"threefry2x32, got {kind}"):
            step_of(NOISY, 5)(args[0], key, args[1])
        # Nothing is cut into chunks: any key will do.
        assert step_of(NOISY, TOTAL)(args[0], key, args[1]).shape == (TOTAL,)
    with pytest.raises(ValueError, match="got fry_window"):
        window(window(key_of(0), jnp.int32(0), 5, 12), jnp.int32(0), 2, 5)
    with jax.threefry_partitionable(False), pytest.raises(ValueError, match="=False"):
        step_of(NOISY, 5)(args[0], key_of(0), args[1])


@pytest.mark.parametrize("shape", [(), (5,), (3, 4), (3, 7, 2), (5, 3)])
def test_noise_that_has_no_rows_is_refused(shape):
    part = window(key_of(0), jnp.int32(0), 5, 12)
    with pytest.raises(ValueError, match=r"noise for 5 of 12 .*multiple of 5, got 32"):
        jax.random.normal(part, shape, jnp.float32)


def test_noise_of_64_bits_is_refused():
    part = window(key_of(0), jnp.int32(0), 5, 12)
    with jax.enable_x64(True), pytest.raises(ValueError, match=r"got 64 bits and \[3"):
        jax.random.bits(part, (3, 5, 2), jnp.uint64)


def test_noise_beyond_32_bits_of_counting_is_refused():
    def lowered(size):
        part = window(key_of(0), jnp.int32(0), 2, 2**20)
        draw = jax.jit(lambda key: jax.random.bits(key, (2, 2, size), jnp.uint32))
        return draw.lower(part).out_info.shape

    assert lowered(2**11) == (2, 2, 2**11)  # 2^32 elements
    with pytest.raises(ValueError, match=r"at most 2\^32 elements, got 8589934592"):
        lowered(2**12)


def test_a_model_that_draws_otherwise_is_refused_before_it_runs():
    def dynamics(params, key, obs, action):
        return obs + jax.random.normal(key, obs.shape[-1:], jnp.float32)

    step = jax.jit(step_of(jaxpets.particle_rollout(dynamics), 5))
    with pytest.raises(ValueError, match=r"shape \[E, B, \.\.\.\].*32 bits and \[2\]"):
        step.lower(PlanParams((), jnp.float32(0.5)), key_of(0), cart_obs(1))
