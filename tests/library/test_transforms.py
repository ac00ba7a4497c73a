"""Laws of JAX that every member of a protocol obeys."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from cases import CASES, KEYED, STATEFUL

pytestmark = pytest.mark.slow

# Programs that fuse otherwise round otherwise; a search of a few iterations on values
# that differ by far more than a rounding keeps to 1e-4.
CLOSE = dict(rtol=1e-4, atol=1e-5)
UNROLLED = ("icem", "plan-icem", "plan-prior", "cem-unrolled", "plan-cem-unrolled")


@functools.cache
def case_of(name):
    return CASES[name]()


@functools.cache
def jitted(name):
    return jax.jit(functools.partial(case_of(name).fn))  # with a cache of its own


@functools.cache
def expected(name, i):
    return jitted(name)(*case_of(name).variant(i))


def stacked(name):
    variants = [case_of(name).variant(i) for i in range(3)]
    return jax.tree.map(stack, *variants)


def stack(*leaves):
    """Of arrays or keys; the former without a program."""
    is_key = jnp.issubdtype(leaves[0].dtype, jax.dtypes.prng_key)
    return (jnp if is_key else np).stack(leaves)


def at(tree, *index):
    return jax.tree.map(lambda x: np.asarray(np.asarray(x)[index]), tree)


# Outside of jit each operation of an unrolled search is compiled by itself; those with
# a loop are the same functions.
@pytest.mark.parametrize("name", [x for x in CASES if x not in UNROLLED])
def test_jit_equals_eager(name):
    case = case_of(name)
    args = jax.tree.map(jnp.asarray, case.variant(1))
    toys.assert_trees_close(case.fn(*args), expected(name, 1), **CLOSE)


@pytest.mark.parametrize("name", CASES)
def test_a_scan_of_vmap_equals_the_loop(name):
    def body(carry, args):
        return carry, jax.vmap(case_of(name).fn)(*args)

    twice = jax.tree.map(lambda x: stack(x, x), stacked(name))
    _, got = jax.jit(lambda xs: jax.lax.scan(body, 0, xs))(twice)
    for i in range(3):
        for turn in range(2):
            toys.assert_trees_close(at(got, turn, i), expected(name, i), **CLOSE)


@pytest.mark.parametrize("name", CASES)
def test_one_trace_over_changed_params(name):
    traces = []

    def counted(*args):
        traces.append(name)
        return case_of(name).fn(*args)

    fn = jax.jit(counted)
    results = [fn.eval_shape(*case_of(name).variant(i)) for i in range(3)]
    assert len(traces) == 1
    assert jax.tree.structure(results[0]) == jax.tree.structure(results[2])
    for i in range(3):
        expected(name, i)
    assert jitted(name)._cache_size() == 1


@pytest.mark.parametrize("name", STATEFUL)
def test_state_keeps_its_avals(name):
    case = case_of(name)
    before, after = case.state
    args = case.variant(0)
    result = jax.eval_shape(case.fn, *args)
    assert [
        (x.shape, x.dtype, x.weak_type) for x in jax.tree.leaves(result[after])
    ] == (toys.avals(args[before]))
    assert jax.tree.structure(result[after]) == jax.tree.structure(args[before])


@pytest.mark.parametrize("name", CASES)
def test_results_have_no_weak_types(name):
    result = jax.eval_shape(case_of(name).fn, *case_of(name).variant(0))
    assert not any(leaf.weak_type for leaf in jax.tree.leaves(result))


@pytest.mark.parametrize("name", KEYED)
def test_no_key_is_used_twice(name):
    case = case_of(name)
    with jax.debug_key_reuse(True):
        jax.jit(functools.partial(case.fn)).trace(*case.variant(0))  # as it checks then


def test_the_checker_of_keys_works():
    def twice(key):
        return jax.random.normal(key) + jax.random.normal(key)

    with jax.debug_key_reuse(True), pytest.raises(jax.errors.KeyReuseError):
        jax.jit(twice).trace(jax.random.key(0))
