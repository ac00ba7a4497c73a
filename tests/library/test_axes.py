"""One planner mapped over environments, tasks and seeds, as experiments map it."""

import jax
import jax.numpy as jnp
import numpy as np
import toys
from cases import ENV, LEARNED, MODELS, NOISY, cart_obs, key_of, keys_of, model

import jaxpets
from jaxpets import PlanParams

CLOSE = dict(rtol=1e-4, atol=1e-5)  # see test_transforms


def at(tree, *index):
    return jax.tree.map(lambda x: np.asarray(np.asarray(x)[index]), tree)


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
    init = jax.vmap(jax.vmap(lambda: plan_state(2), axis_size=3), axis_size=2)
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

    def reward(params, obs, action, next_obs):
        traces.append(1)
        return jaxpets.rewards.epistemic(params, obs, action, next_obs)

    planner = jaxpets.plan(LEARNED, reward, toys.optimizer("cem", horizon=3))
    step, state = jax.jit(planner.step), planner.init()
    step(PlanParams(model(0), jnp.ones(2)), key_of(0), state, cart_obs(0))
    first = len(traces)
    for i in range(1, 3):
        params = PlanParams(model(i), jaxpets.rewards.max_variance(model(i)))
        _, state = step(params, key_of(i), state, cart_obs(i))
    assert len(traces) == first and step._cache_size() == 1


def test_unroll_obeys_the_key_checker():
    planner = jaxpets.plan(NOISY, toys.reach, toys.optimizer("cem", horizon=3))
    params = PlanParams(jnp.float32(1.0), jnp.float32(0.5))

    def trial(reset_key, act_key):
        begin = jaxpets.start_trial(ENV, planner, reset_key)
        return jaxpets.unroll(ENV, planner, params, act_key, begin, length=3)

    with jax.debug_key_reuse(True):
        _, transitions, _ = jax.jit(trial)(key_of(0), key_of(1))
    assert jnp.all(jnp.isfinite(transitions.next_obs))
