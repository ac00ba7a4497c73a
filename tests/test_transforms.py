"""Laws of JAX that every member of a protocol obeys."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxpets
import numpy as np
import pytest
import toys
from jaxpets import PlanParams
from jaxpets.envs import env_rollout
from jaxpets.envs import half_cheetah as hc

MODEL = toys.small_ensemble()
MODELS = jax.jit(jax.vmap(MODEL.init))(jax.random.split(jax.random.key(0), 3))
ENV = toys.cart_env()
NOISY = jaxpets.particle_rollout(toys.noisy_cart, num_members=2, num_particles=4)
LEARNED = jaxpets.particle_rollout(MODEL.sample, num_members=3, num_particles=6)


class Case(NamedTuple):
    """One function and three sets of arguments with equal avals."""

    fn: Callable
    variant: Callable[[int], tuple]
    # Positions of the state among the arguments and the results, if there is one.
    state: tuple[int, int] | None = None


def key_of(i):
    """A fresh key: the checker of keys takes slices of one array for its reuse."""
    return jax.random.key(100 + i)


def keys_of(*shape):
    return jax.random.split(jax.random.key(1), shape)


def model(i):
    return jax.tree.map(lambda x: x[i], MODELS)


def cart_obs(i):
    return jnp.array([0.1 * i - 0.1, 0.2 - 0.3 * i])


def warm(init, i):
    """A state as an earlier call may have left it."""
    return jax.tree.map(lambda x: x + jnp.float32(0.1 * i), init())


def planner_case(name):
    if name == "random":
        planner = jaxpets.random_planner(ENV.action_low, ENV.action_high)
    else:
        planner = jaxpets.plan(NOISY, toys.reach, toys.optimizer(name, horizon=3))

    def variant(i):
        params = PlanParams(jnp.float32(1 + 0.2 * i), jnp.float32(0.5 * i))
        return params, key_of(i), warm(planner.init, i), cart_obs(i)

    return Case(planner.step, variant, (2, 1))


def optimizer_case(name):
    search = toys.optimizer(name, horizon=3, size=2)

    def step(optimum, key, state):
        def objective(key, actions):
            jitter = 1e-3 * jax.random.normal(key, actions.shape[:1], jnp.float32)
            return jitter - jnp.sum((actions - optimum) ** 2, (1, 2))

        return search.step(objective, key, state)

    def variant(i):
        return jnp.float32(0.3 * i), key_of(i), warm(search.init, i)

    return Case(step, variant, (2, 1))


def actions(i):
    return jnp.sin(jnp.arange(20.0) + i).reshape(5, 4, 1)


def particles(i, size=2):
    count = 3 * 4 * size
    return jnp.cos(jnp.arange(float(count)) * (i + 1)).reshape(3, 4, size)


def step_of(i, size=2, action_size=1):
    action = jnp.full((action_size,), 0.1 * i, jnp.float32)
    return particles(i, size), action, particles(i + 3, size)


def counts(i):
    projection = jaxpets.rewards.simhash(jax.random.key(5), 8, 2)
    rows = particles(i).reshape(12, 2)
    data = jaxpets.Transition(rows, rows[:, :1], rows)
    dataset = jaxpets.append(jaxpets.init_dataset(16, 2, 1), data)
    return jaxpets.rewards.count_states(projection, dataset)


def mixture(params, obs, action, next_obs):
    step = (obs, action, next_obs)
    novelty = jaxpets.rewards.epistemic(params[1], *step)
    return toys.reach(params[0], *step) + 0.1 * novelty


CASES = {
    **{f"plan-{n}": functools.partial(planner_case, n) for n in toys.OPTIMIZERS},
    "random_planner": lambda: planner_case("random"),
    **{n: functools.partial(optimizer_case, n) for n in toys.OPTIMIZERS},
    "particle_rollout": lambda: Case(
        NOISY, lambda i: (jnp.float32(1 + i), key_of(i), cart_obs(i), actions(i))
    ),
    "particle_rollout-ensemble": lambda: Case(
        LEARNED, lambda i: (model(i), key_of(i), cart_obs(i), actions(i))
    ),
    "env_rollout": lambda: Case(
        env_rollout(ENV), lambda i: ((), key_of(i), ENV.reset(key_of(i)), actions(i))
    ),
    "epistemic": lambda: Case(
        jaxpets.rewards.epistemic, lambda i: (jnp.full(2, i + 0.5), *step_of(i))
    ),
    "pseudo_count": lambda: Case(
        jaxpets.rewards.pseudo_count, lambda i: (counts(i), *step_of(i))
    ),
    "one_step_disagreement": lambda: Case(
        jaxpets.rewards.one_step_disagreement(MODEL.predict),
        lambda i: (model(i), *step_of(i)),
    ),
    "task_reward": lambda: Case(
        hc.task_reward,
        lambda i: (jax.tree.map(lambda x: x[i], hc.tasks()), *step_of(i, 18, 6)),
    ),
    "user-reward": lambda: Case(toys.reach, lambda i: (jnp.float32(i), *step_of(i))),
    "mixture": lambda: Case(
        mixture, lambda i: ((jnp.float32(i), jnp.ones(2)), *step_of(i))
    ),
}
STATEFUL = [name for name in CASES if "plan" in name or name in toys.OPTIMIZERS]
KEYED = [*STATEFUL, "particle_rollout", "particle_rollout-ensemble"]

# Programs that fuse otherwise round otherwise; a search of a few iterations on values
# that differ by far more than a rounding keeps to 1e-4.
CLOSE = dict(rtol=1e-4, atol=1e-5)


@functools.cache
def case_of(name):
    return CASES[name]()


@functools.cache
def jitted(name):
    fn = case_of(name).fn
    return jax.jit(lambda *args: fn(*args))  # with a cache of its own


@functools.cache
def expected(name, i):
    return jitted(name)(*case_of(name).variant(i))


def stacked(name):
    variants = [case_of(name).variant(i) for i in range(3)]
    return jax.tree.map(lambda *x: jnp.stack(x), *variants)


def at(tree, *index):
    return jax.tree.map(lambda x: x[index], tree)


@pytest.mark.parametrize("name", CASES)
def test_jit_equals_eager(name):
    case = case_of(name)
    toys.assert_trees_close(case.fn(*case.variant(1)), expected(name, 1), **CLOSE)


@pytest.mark.parametrize("name", CASES)
def test_vmap_equals_the_loop(name):
    got = jax.jit(jax.vmap(case_of(name).fn))(*stacked(name))
    for i in range(3):
        toys.assert_trees_close(at(got, i), expected(name, i), **CLOSE)


@pytest.mark.parametrize("name", CASES)
def test_scan_equals_the_loop(name):
    def body(carry, args):
        return carry, case_of(name).fn(*args)

    _, got = jax.jit(lambda xs: jax.lax.scan(body, 0, xs))(stacked(name))
    for i in range(3):
        toys.assert_trees_close(at(got, i), expected(name, i), **CLOSE)


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
        jax.jit(lambda *args: case.fn(*args))(*case.variant(0))


def test_the_checker_of_keys_works():
    def twice(key):
        return jax.random.normal(key) + jax.random.normal(key)

    with jax.debug_key_reuse(True), pytest.raises(jax.errors.KeyReuseError):
        jax.jit(twice)(jax.random.key(0))


# -- the axes of an experiment -------------------------------------------------------

PLANNER = jaxpets.plan(LEARNED, toys.reach, toys.optimizer("cem", horizon=3))
STEP = jax.jit(PLANNER.step)
TARGETS = jnp.array([-0.5, 0.0, 0.8])


def plan_state(count):
    return jax.vmap(PLANNER.init, axis_size=count)()


def test_vmap_over_environments():
    obs = jnp.stack([cart_obs(i) for i in range(3)])
    params = PlanParams(model(0), TARGETS[0])
    keys = keys_of(3)
    step = jax.jit(jax.vmap(PLANNER.step, (None, 0, 0, 0)))
    got = step(params, keys, plan_state(3), obs)
    for i in range(3):
        want = STEP(params, keys[i], PLANNER.init(), obs[i])
        toys.assert_trees_close(at(got, i), want, **CLOSE)


def test_vmap_over_tasks():
    step = jax.jit(jax.vmap(PLANNER.step, (PlanParams(None, 0), 0, 0, None)))
    params, keys = PlanParams(model(0), TARGETS), keys_of(3)
    got = step(params, keys, plan_state(3), cart_obs(0))
    for i in range(3):
        one = PlanParams(model(0), TARGETS[i])
        want = STEP(one, keys[i], PLANNER.init(), cart_obs(0))
        toys.assert_trees_close(at(got, i), want, **CLOSE)


def test_vmap_over_seeds_tasks_and_environments():
    """Three axes at once, as an experiment has them."""
    obs = jnp.stack([cart_obs(i) for i in range(2)])
    keys = keys_of(2, 3, 2)
    envs = jax.vmap(PLANNER.step, (None, 0, 0, 0))
    tasks = jax.vmap(envs, (PlanParams(None, 0), 0, 0, None))
    seeds = jax.vmap(tasks, (PlanParams(0, None), 0, 0, None))
    init = jax.vmap(lambda: jax.vmap(lambda: plan_state(2), axis_size=3)(), axis_size=2)
    params = PlanParams(at(MODELS, slice(0, 2)), TARGETS)
    got = jax.jit(seeds)(params, keys, init(), obs)
    assert got[0].action.shape == (2, 3, 2, 1)
    for seed, task, env in np.ndindex(2, 3, 2):
        want = STEP(
            PlanParams(model(seed), TARGETS[task]),
            keys[seed, task, env],
            PLANNER.init(),
            obs[env],
        )
        toys.assert_trees_close(at(got, seed, task, env), want, **CLOSE)


def test_one_trace_over_many_model_updates():
    traces = []

    def reward(params: Any, obs, action, next_obs):
        traces.append(1)
        return jaxpets.rewards.epistemic(params, obs, action, next_obs)

    planner = jaxpets.plan(LEARNED, reward, toys.optimizer("cem", horizon=3))
    step, state = jax.jit(planner.step), planner.init()
    step(PlanParams(model(0), jnp.ones(2)), key_of(0), state, cart_obs(0))
    first = len(traces)
    for i in range(1, 3):
        params = PlanParams(model(i), jaxpets.max_variance(model(i)))
        _, state = step(params, key_of(i), state, cart_obs(i))
    assert len(traces) == first and step._cache_size() == 1


def test_unroll_obeys_the_key_checker():
    planner = jaxpets.plan(NOISY, toys.reach, toys.optimizer("cem", horizon=3))
    params = PlanParams(jnp.float32(1.0), jnp.float32(0.5))

    def trial(reset_key, act_key):
        begin = jaxpets.start(ENV, planner, reset_key)
        return jaxpets.unroll(ENV, planner, params, act_key, begin, length=3)

    with jax.debug_key_reuse(True):
        _, transitions, _ = jax.jit(trial)(key_of(0), key_of(1))
    assert jnp.all(jnp.isfinite(transitions.next_obs))
