"""The rollout kernel, on CPUs and as the GPU's reference: it equals the scan."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from rollouts import (
    CASES,
    CHEETAH,
    FORGETFUL,
    LETTERS,
    SIZES,
    SMALL,
    relative_error,
    scan,
    stacked,
)

import jaxpets
from jaxpets import Precision
from jaxpets._src.chunks import window
from jaxpets._src.types import ModelRolloutFn
from jaxpets.envs import half_cheetah as hc


@pytest.mark.parametrize("name", CASES)
def test_equals_the_scan(engine, name):
    case = CASES[name]
    args = case.args()
    got, want = engine.run(case)(*args), scan(case)(*args)
    assert np.isfinite(want).all()
    assert relative_error(got, want) <= engine.rounding
    np.testing.assert_array_equal(got[:, 0], want[:, 0])


def test_is_closer_than_the_scan_in_bfloat16(engine):
    args = CHEETAH.args()
    want = scan(CHEETAH)(*args)
    got = jax.jit(CHEETAH.scan(Precision.BF16))(*args)
    error = relative_error(engine.run(CHEETAH)(*args), want)
    assert error < relative_error(got, want) / 2


def test_without_data_nothing_is_bounded(engine):
    """A fresh scaler's range is infinite."""
    params, *rest = SMALL.args()
    scaler = params.scaler
    free = scaler._replace(low=scaler.low - jnp.inf, high=scaler.high + jnp.inf)
    params = params._replace(scaler=free)
    got, want = engine.run(SMALL)(params, *rest), scan(SMALL)(params, *rest)
    assert relative_error(got, want) <= engine.rounding


def test_a_bound_that_is_not_asked_for_is_not_applied(engine):
    squash = lambda obs, low, high: low + (high - low) * jax.nn.sigmoid(obs)  # noqa: E731
    space = jaxpets.delta_space()._replace(bound=squash)
    case = dataclasses.replace(SMALL, state_margin=None, space=space)
    got, want = engine.run(case)(*case.args()), scan(case)(*case.args())
    assert relative_error(got, want) <= engine.rounding


# Noise.

LOUD = dataclasses.replace(
    SMALL, num_samples=100, particles=9, horizon=3, state_margin=None, space=FORGETFUL
)


def test_noise_is_that_of_jax_random_number_by_number(engine):
    """Without weights, a path is noise times one deviation. 8100 numbers have tails."""
    params, key, obs, actions = LOUD.args()
    members = jax.tree.map(jnp.zeros_like, params.network.members)
    params = params._replace(network=params.network._replace(members=members))
    path = engine.run(LOUD)(params, key, obs, actions)
    low, high = (
        np.float64(params.network.min_logvar),
        np.float64(params.network.max_logvar),
    )
    std = np.sqrt(np.exp(low) + 1 / (np.exp(-high) + 1))
    shape = (LOUD.num_members, LOUD.num_samples * LOUD.particles, LOUD.obs_size)
    for h, step in enumerate(jax.random.split(key, LOUD.horizon)):
        noise = jax.random.normal(step, shape, jnp.float32)
        noise = noise.reshape(LOUD.num_members, LOUD.num_samples, LOUD.particles, -1)
        assert abs(noise).max() > 3.5
        # The logarithm behind a tail loses digits, otherwise here and there.
        np.testing.assert_allclose(
            path[:, h + 1], noise.swapaxes(0, 1) * std, rtol=1e-5, atol=1e-6
        )


def test_keys_decide(engine):
    params, key, obs, actions = SMALL.args()
    path = engine.run(SMALL)(params, key, obs, actions)
    again = engine.run(SMALL)(params, jax.random.clone(key), obs, actions)
    np.testing.assert_array_equal(path, again)
    other = engine.run(SMALL)(params, jax.random.fold_in(key, 1), obs, actions)
    assert np.mean(path[:, 1:] != other[:, 1:]) > 0.9  # the rest is at its bound


def test_a_key_of_the_old_kind_is_refused(engine):
    params, key, obs, actions = SMALL.args()
    old = jax.random.key_data(key)
    with pytest.raises(TypeError, match=r"key must be a typed key from jax.random.key"):
        engine.run(SMALL)(params, old, obs, actions)


@pytest.mark.parametrize(("first", "count"), [(0, 4), (1, 2), (3, 1)])
def test_a_window_draws_its_share(engine, first, count):
    params, key, obs, actions = SMALL.args()
    part = window(key, jnp.int32(first), count, SMALL.num_samples)
    pick = slice(first, first + count)
    got = engine.run(SMALL)(params, part, obs, actions[pick])
    np.testing.assert_array_equal(
        got, engine.run(SMALL)(params, key, obs, actions)[pick]
    )


def test_no_key_is_used_twice(engine):
    params, key, *rest = SMALL.args()
    fresh = jax.random.clone(key)
    with jax.debug_key_reuse(True):
        jax.jit(functools.partial(engine.fused(SMALL)))(params, fresh, *rest)


# Mapped.


@pytest.mark.parametrize(
    "levels",
    ["p", "k", "o", "a", "pkoa", "p,k,o,a", "a,o,k,p", "po,ka,p", "a,a,ao,o", "k,pkoa"],
)
def test_vmap_equals_the_loop(engine, levels):
    levels = levels.split(",")
    args, axes = stacked(SMALL, levels)
    mapped = engine.fused(SMALL)
    for in_axes in reversed(axes):
        mapped = jax.vmap(mapped, in_axes)
    got = jax.jit(mapped)(*args)
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


def test_vmap_equals_the_scan(engine):
    args, (in_axes,) = stacked(CHEETAH, ["pkoa"])
    got, want = (
        jax.jit(jax.vmap(f, in_axes))(*args)
        for f in (engine.fused(CHEETAH), CHEETAH.scan())
    )
    assert relative_error(got, want) <= engine.rounding


def test_vmap_over_parts_of_params_and_other_axes(engine):
    params, key, obs, actions = SMALL.args()
    networks = jax.tree.map(lambda x: jnp.stack([x, 0.5 * x], -1), params.network)
    stack = jnp.stack([actions, -actions], 1)
    in_axes = (type(params)(-1, None), None, None, 1)
    mapped = jax.vmap(engine.fused(SMALL), in_axes, out_axes=2)
    got = jax.jit(mapped)(params._replace(network=networks), key, obs, stack)
    for i in range(2):
        network = jax.tree.map(lambda x, i=i: x[..., i], networks)
        want = engine.run(SMALL)(
            params._replace(network=network), key, obs, stack[:, i]
        )
        np.testing.assert_array_equal(got[:, :, i], want)


def test_a_fifth_vmap_is_refused(engine):
    params, key, obs, actions = SMALL.args()
    mapped = engine.fused(SMALL)
    for _ in range(5):
        mapped = jax.vmap(mapped, (None, None, 0, None))
    many = jnp.broadcast_to(obs, (1, 2, 1, 2, 1, *obs.shape))
    with pytest.raises(jax.errors.JaxRuntimeError, match="vmap is nested too deeply"):
        jax.block_until_ready(jax.jit(mapped)(params, key, many, actions))


# Inside other programs.


def test_scan_equals_the_loop(engine):
    params, key, obs, actions = SMALL.args()

    def body(obs, key):
        path = engine.fused(SMALL)(params, key, obs, actions)
        return path[0, -1, 0, 0], path

    keys = jax.random.split(key, 3)
    _, got = jax.jit(lambda: jax.lax.scan(body, obs, keys))()
    for path, step in zip(got, keys, strict=True):
        # Params that are known when it is compiled are packed by another program.
        np.testing.assert_allclose(
            path, engine.run(SMALL)(params, step, obs, actions), rtol=1e-4, atol=1e-4
        )
        obs = path[0, -1, 0, 0]


def test_one_trace_for_all_values(engine):
    traces = []

    def counted(*args):
        traces.append(args)
        return engine.fused(SMALL)(*args)

    fn = jax.jit(counted)
    params, key, obs, actions = SMALL.args()
    fn(params, key, obs, actions)
    fn(jax.tree.map(lambda x: 0.5 * x, params), key, -obs, 0.5 * actions)
    assert len(traces) == 1


def test_a_planner_may_bind_it(engine):
    """The call is what the bound one is, to the last bit."""
    params, *rest = SMALL.args()
    fused = engine.fused(SMALL)
    assert isinstance(fused, ModelRolloutFn) and not isinstance(scan, ModelRolloutFn)
    got = jax.jit(lambda params, *rest: fused.bind(params)(*rest))(params, *rest)
    np.testing.assert_array_equal(got, engine.run(SMALL)(params, *rest))


def step_of(rollout, chunk_size=None, name="cem"):
    search = toys.optimizer(name, horizon=3, size=SMALL.action_size)
    planner = jaxpets.plan(rollout, toys.reach, search, chunk_size=chunk_size)
    return lambda params, key, obs: planner.step(params, key, planner.init(), obs)


@functools.cache
def planned(engine, chunk_size=None, name="cem"):
    return jax.jit(step_of(engine.fused(SMALL), chunk_size, name))


def start():
    params, key, obs, _ = SMALL.args()
    return jaxpets.PlanParams(params, jnp.float32(0.5)), key, obs


def test_a_plan_is_that_of_the_scan(engine):
    want = jax.jit(step_of(SMALL.scan()))(*start())
    # Three rounds of a search; elites are the same unless values tie to 1e-4.
    toys.assert_trees_close(planned(engine)(*start()), want, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(("name", "chunk_size"), [("cem", 25), ("icem", 20)])
def test_a_plan_in_chunks_is_the_plan(engine, name, chunk_size):
    got, want = (planned(engine, size, name)(*start()) for size in (chunk_size, None))
    # The values are the same; their means may be added up in another order.
    toys.assert_trees_close(got, want, rtol=1e-5, atol=1e-5)


def test_plans_of_many_seeds_in_chunks(engine):
    params, key, obs = start()
    keys = jax.random.split(key, 3)
    starts = jnp.stack([obs, -obs, 0.5 * obs])
    got = jax.jit(jax.vmap(planned(engine, 25), (None, 0, 0)))(params, keys, starts)
    for i in range(3):
        one = jax.tree.map(lambda x, i=i: x[i], got)
        want = planned(engine)(params, keys[i], starts[i])
        toys.assert_trees_close(one, want, rtol=1e-5, atol=1e-5)


# Numbers that are none.


def test_nan_actions_stay_with_their_candidate(engine):
    params, key, obs, actions = SMALL.args()
    path = engine.run(SMALL)(params, key, obs, actions)
    broken = engine.run(SMALL)(params, key, obs, actions.at[2, 3, 1].set(jnp.nan))
    assert np.isnan(broken[2, 4:]).all()
    np.testing.assert_array_equal(broken[2, :4], path[2, :4])
    np.testing.assert_array_equal(np.delete(broken, 2, 0), np.delete(path, 2, 0))


def test_a_nan_start_stays_with_its_start(engine):
    params, key, obs, actions = SMALL.args()
    starts = jnp.stack([obs, obs.at[1].set(jnp.nan), 2 * obs])
    mapped = jax.vmap(engine.run(SMALL), (None, None, 0, None))(
        params, key, starts, actions
    )
    assert np.isnan(mapped[1, :, 1:]).all()
    for i in (0, 2):
        want = engine.run(SMALL)(params, key, starts[i], actions)
        np.testing.assert_array_equal(mapped[i], want)


@pytest.mark.parametrize("entry", [hc.FORWARD_VELOCITY, hc.PITCH, hc.X_VELOCITY])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_goes_where_it_goes_in_the_scan(engine, entry, number):
    params, key, obs, actions = CHEETAH.args()
    obs = obs.at[entry].set(number)
    got, want = (f(CHEETAH)(params, key, obs, actions) for f in (engine.run, scan))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(want))


def test_a_broken_member_breaks_its_particles_only(engine):
    params, key, obs, actions = SMALL.args()
    path = engine.run(SMALL)(params, key, obs, actions)
    members = jax.tree.map(lambda x: x.at[1].set(jnp.nan), params.network.members)
    params = params._replace(network=params.network._replace(members=members))
    broken = engine.run(SMALL)(params, key, obs, actions)
    assert np.isnan(broken[:, 1:, 1]).all()
    np.testing.assert_array_equal(broken[:, :, ::2], path[:, :, ::2])


# What is wrong is said as the scan says it.


@pytest.mark.parametrize(
    "change", [dict(num_members=2), dict(num_members=4), dict(hidden_sizes=(16, 16))]
)
def test_params_of_another_ensemble_are_refused(engine, change):
    """Also where the kernel could not tell: of fewer members, of narrower layers."""
    params = dataclasses.replace(SMALL, **change).args()[0]
    rest = SMALL.args()[1:]
    said = []
    for fn in (SMALL.scan(), engine.fused(SMALL)):
        with pytest.raises(Exception, match=r"axes|shape") as error:
            jax.eval_shape(fn, params, *rest)
        said.append((error.type, str(error.value)))
    assert said[0] == said[1]


def test_wrong_shapes_are_refused(engine):
    params, key, obs, actions = SMALL.args()
    with pytest.raises(ValueError, match=r"obs must be float32\[3\], got float32\[2\]"):
        jax.eval_shape(engine.fused(SMALL), params, key, obs[:2], actions)
    text = r"actions must be float32\[N, H, 2\], got float32\[4, 5, 1\]"
    with pytest.raises(ValueError, match=text):
        jax.eval_shape(engine.fused(SMALL), params, key, obs, actions[..., :1])
    with pytest.raises(ValueError, match="num_particles must be a multiple"):
        jaxpets.fused_rollout(SMALL.model(), num_particles=4)


def test_a_model_that_is_not_of_jaxpets_is_refused():
    """A kernel is made from config and space, which functions alone do not tell."""
    own = SMALL.model()._replace(config=None, space=None)
    with pytest.raises(ValueError, match="model must be built by jaxpets"):
        jaxpets.fused_rollout(own, num_particles=6)
    text = "model must be an Ensemble of jaxpets.ensemble, got EnsembleConfig"
    with pytest.raises(TypeError, match=text):
        jaxpets.fused_rollout(SMALL.config(), num_particles=6)


def test_it_has_no_gradient(engine):
    params, key, obs, actions = SMALL.args()

    def total(actions):
        return jnp.sum(engine.fused(SMALL)(params, key, obs, actions))

    with pytest.raises(ValueError, match="cannot be differentiated"):
        jax.grad(total)(actions)
