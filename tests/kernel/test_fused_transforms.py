"""The rollout kernel inside other programs: mapped, scanned, bound, planned with."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from rollouts import LETTERS, REFERENCE, SIZES, SMALL, scan, stacked

import jaxpets
from jaxpets._src.types import ModelRolloutFn


@pytest.mark.parametrize(
    "levels",
    ["pkoa", "p,k,o,a", "po,ka,p", "a,a,ao,o"],
)
def test_vmap_equals_the_loop(engine, levels):
    levels = levels.split(",")
    args, axes = stacked(SMALL, levels)
    mapped = engine.fused(SMALL)
    for in_axes in reversed(axes):
        mapped = jax.vmap(mapped, in_axes)
    got = np.asarray(jax.jit(mapped)(*args))
    shape = SIZES[: len(levels)]
    assert got.shape[: len(shape)] == shape
    for index in np.ndindex(shape):
        one = []
        for letter, arg in zip(LETTERS, args, strict=True):
            own = tuple(
                i for i, level in zip(index, levels, strict=True) if letter in level
            )
            one.append(jax.tree.map(lambda x, own=own: x[own], arg))
        np.testing.assert_array_equal(got[index], engine.run(SMALL)(*one), strict=True)


def test_vmap_over_parts_of_params_and_other_axes():
    params, key, obs, actions = SMALL.args()
    half = np.float32(0.5)
    networks = jax.tree.map(lambda x: np.stack([x, half * x], -1), params.network)
    stack = np.stack([actions, -actions], 1)
    in_axes = (type(params)(-1, None), None, None, 1)
    mapped = jax.vmap(REFERENCE.fused(SMALL), in_axes, out_axes=2)
    got = jax.jit(mapped)(params._replace(network=networks), key, obs, stack)
    got = np.asarray(got)
    for i in range(2):
        network = jax.tree.map(lambda x, i=i: x[..., i], networks)
        want = REFERENCE.run(SMALL)(
            params._replace(network=network), key, obs, stack[:, i]
        )
        np.testing.assert_array_equal(got[:, :, i], want)


def test_a_fifth_vmap_is_refused(engine):
    params, key, obs, actions = SMALL.args()
    mapped = engine.fused(SMALL)
    for _ in range(5):
        mapped = jax.vmap(mapped, (None, None, 0, None))
    many = np.broadcast_to(obs, (1, 2, 1, 2, 1, *obs.shape))
    with pytest.raises(jax.errors.JaxRuntimeError, match="vmap is nested too deeply"):
        jax.block_until_ready(jax.jit(mapped)(params, key, many, actions))


def test_scan_equals_the_loop(engine):
    params, key, obs, actions = SMALL.args()

    @jax.jit
    def looped(params, obs, keys):
        def body(obs, key):
            path = engine.fused(SMALL)(params, key, obs, actions)
            return path[0, -1, 0, 0], path

        return jax.lax.scan(body, obs, keys)[1]

    keys = jax.random.split(key, 3)
    for path, step in zip(np.asarray(looped(params, obs, keys)), keys, strict=True):
        want = engine.run(SMALL)(params, step, obs, actions)
        np.testing.assert_array_equal(path, want)
        obs = path[0, -1, 0, 0]


def test_one_trace_for_all_values():
    traces = []

    def counted(*args):
        traces.append(args)
        return REFERENCE.fused(SMALL)(*args)

    fn = jax.jit(counted)
    params, key, obs, actions = SMALL.args()
    fn(params, key, obs, actions)
    half = np.float32(0.5)
    fn(jax.tree.map(lambda x: half * x, params), key, -obs, half * actions)
    assert len(traces) == 1


def test_a_planner_may_bind_it(engine):
    """The call is what the bound one is, to the last bit."""
    params, *rest = SMALL.args()
    fused = engine.fused(SMALL)
    assert isinstance(fused, ModelRolloutFn) and not isinstance(scan, ModelRolloutFn)
    got = jax.jit(lambda params, *rest: fused.bind(params)(*rest))(params, *rest)
    np.testing.assert_array_equal(got, engine.run(SMALL)(params, *rest))


def step_of(rollout, chunk_size=None):
    search = toys.optimizer("cem", horizon=3, size=SMALL.action_size)
    planner = jaxpets.plan(rollout, toys.reach, search, chunk_size=chunk_size)
    return lambda params, key, obs: planner.step(params, key, planner.init(), obs)


@functools.cache
def planned(chunk_size=None):
    return jax.jit(step_of(REFERENCE.fused(SMALL), chunk_size))


def start():
    params, key, obs, _ = SMALL.args()
    return jaxpets.PlanParams(params, jnp.float32(0.5)), key, obs


def test_a_plan_is_that_of_the_scan():
    want = jax.jit(step_of(SMALL.scan()))(*start())
    # Three rounds of a search; elites are the same unless values tie to 1e-4.
    toys.assert_trees_close(planned()(*start()), want, rtol=1e-3, atol=1e-3)


def test_a_plan_that_ends_has_the_values_of_the_scan():
    params, key, obs = start()
    actions = SMALL.args()[-1]

    def values(rollout):
        planner = jaxpets.plan(
            rollout,
            toys.reach,
            toys.probe(actions),
            terminal_fn=lambda params, obs: obs[..., 0] > params,
            discount=0.9,
            risk_fn=jnp.min,
        )
        return jax.jit(planner.step)(params, key, planner.init(), obs)[1]

    # A path is that of the scan to 1e-4, and none comes as near to the end.
    want = values(SMALL.scan())
    np.testing.assert_allclose(
        values(REFERENCE.fused(SMALL)), want, rtol=1e-3, atol=1e-3
    )


def test_plans_of_many_seeds_in_chunks():
    params, key, obs = start()
    keys = jax.random.split(key, 3)
    starts = np.stack([obs, -obs, np.float32(0.5) * obs])
    got = jax.jit(jax.vmap(planned(25), (None, 0, 0)))(params, keys, starts)
    for i in range(3):
        one = jax.tree.map(lambda x, i=i: np.asarray(np.asarray(x)[i]), got)
        want = planned()(params, keys[i], starts[i])
        # The values are the same; their means may be added up in another order.
        toys.assert_trees_close(one, want, rtol=1e-5, atol=1e-5)
