import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets import PlanParams

ENV = toys.cart_env()
ROLLOUT = jaxpets.particle_rollout(toys.noisy_cart, num_members=2, num_particles=4)
PLANNER = jaxpets.plan(ROLLOUT, toys.reach, toys.optimizer("cem"))
CHANCE = jaxpets.random_planner(ENV.action_low, ENV.action_high)
PARAMS = PlanParams(jnp.float32(1.0), jnp.float32(0.5))


def run(planner, state, key, length):
    return jax.jit(
        lambda state, key: jaxpets.unroll(
            ENV, planner, PARAMS, key, state, length=length
        )
    )(state, key)


def test_start_resets_both(key):
    state = jaxpets.start_trial(ENV, PLANNER, key)
    toys.assert_trees_close(state.env, ENV.reset(key), rtol=0)
    toys.assert_trees_close(state.planner, PLANNER.init(), rtol=0)
    assert state.step == 0 and state.step.dtype == jnp.int32


@pytest.mark.parametrize("planner", [PLANNER, CHANCE])
def test_parts_equal_the_whole(planner, key):
    begin = jaxpets.start_trial(ENV, planner, jax.random.key(1))
    end, transitions, plans = run(planner, begin, key, 12)
    state, parts = begin, []
    for length in (5, 5, 2):
        state, *part = run(planner, state, key, length)
        parts.append(tuple(part))
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    toys.assert_trees_close(joined, (transitions, plans), rtol=0)
    toys.assert_trees_close(state, end, rtol=0)
    assert end.step == 12 and end.env.physics == 12


def test_transitions_are_what_happened(key):
    begin = jaxpets.start_trial(ENV, PLANNER, jax.random.key(1))
    end, transitions, plans = run(PLANNER, begin, key, 6)
    np.testing.assert_array_equal(transitions.obs[0], begin.env.obs)
    np.testing.assert_array_equal(transitions.obs[1:], transitions.next_obs[:-1])
    np.testing.assert_array_equal(transitions.next_obs[-1], end.env.obs)
    np.testing.assert_array_equal(transitions.action, plans.action)
    assert plans.actions.shape == (6, 5, 1) and plans.value.shape == (6,)
    state = begin.env
    for t in range(6):
        state = ENV.step(state, transitions.action[t])
        np.testing.assert_allclose(transitions.next_obs[t], state.obs, rtol=1e-6)


def test_every_step_plans_anew_from_its_warm_start(key):
    """The loop written out, with the keys that the docstring promises."""
    begin = jaxpets.start_trial(ENV, PLANNER, jax.random.key(1))
    _, transitions, _ = run(PLANNER, begin, key, 4)
    step = jax.jit(PLANNER.step)
    env_state, planner_state = begin.env, begin.planner
    for t in range(4):
        step_key = jax.random.fold_in(key, t)
        out, planner_state = step(PARAMS, step_key, planner_state, env_state.obs)
        np.testing.assert_allclose(transitions.action[t], out.action, rtol=1e-5)
        env_state = ENV.step(env_state, out.action)


def test_random_actions_differ_between_steps_and_keys(key):
    begin = jaxpets.start_trial(ENV, CHANCE, jax.random.key(1))
    first = run(CHANCE, begin, key, 8)[1].action
    other = run(CHANCE, begin, jax.random.key(5), 8)[1].action
    assert len(np.unique(np.concatenate([first, other]))) == 16


def is_far(obs):
    return jnp.abs(obs[..., 0]) > 0.3


def test_a_trial_that_has_ended_begins_anew(key):
    """A cart that is driven to the right, and may not leave the middle."""
    env = ENV._replace(terminal_fn=is_far)
    planner = jaxpets.plan(
        ROLLOUT, toys.reach, toys.optimizer("cem"),
        terminal_fn=lambda params, obs: env.terminal_fn(obs),
    )  # fmt: skip
    params = PARAMS._replace(reward=jnp.float32(9.0))
    begin = jaxpets.start_trial(env, planner, jax.random.key(1))

    def trial(state, key, length):
        return jaxpets.unroll(env, planner, params, key, state, length=length)

    end, transitions, plans = jax.jit(trial, static_argnums=2)(begin, key, 24)
    ends = np.asarray(is_far(transitions.next_obs))
    assert 2 <= ends[:-1].sum() < 12 and end.step == 24
    starts = np.append(True, ends[:-1])
    joined = transitions.obs[1:] == transitions.next_obs[:-1]
    np.testing.assert_array_equal(joined.all(-1), ~ends[:-1])
    # A start is near 0, and each is another one; every transition obeys the cart.
    assert (np.abs(transitions.obs[starts, 0]) < 0.3).all()
    assert len(np.unique(transitions.obs[starts, 0])) == starts.sum()
    moved = toys.cart(jnp.float32(1.0), None, transitions.obs, transitions.action)
    np.testing.assert_allclose(transitions.next_obs, moved, rtol=1e-5, atol=1e-6)
    # The planner begins anew as well: its first plan is that of a search begun there.
    again = int(np.flatnonzero(starts)[1])
    plan_key, _ = jax.random.split(jax.random.fold_in(key, again))
    inputs = params, plan_key, planner.init(), transitions.obs[again]
    first, _ = jax.jit(planner.step)(*inputs)
    np.testing.assert_allclose(plans.actions[again], first.actions, rtol=1e-5)


@pytest.mark.parametrize(
    ("ends", "got"),
    [(lambda obs: obs[..., 0], r"float32\[\]"), (lambda obs: obs > 0, r"bool\[2\]")],
)
def test_an_end_is_one_truth(key, ends, got):
    env = ENV._replace(terminal_fn=ends)
    begin = jaxpets.start_trial(env, CHANCE, jax.random.key(1))
    with pytest.raises(
        ValueError, match=rf"terminal_fn must return bool\[\], got {got}"
    ):
        jaxpets.unroll(env, CHANCE, PARAMS, key, begin, length=2)


def test_bad_arguments_fail_when_traced(key):
    begin = jaxpets.start_trial(ENV, CHANCE, jax.random.key(1))
    with pytest.raises(ValueError, match="length must be at least 1, got 0"):
        jaxpets.unroll(ENV, CHANCE, PARAMS, key, begin, length=0)
    with pytest.raises(TypeError, match="length must be a Python int"):
        jaxpets.unroll(ENV, CHANCE, PARAMS, key, begin, length=jnp.int32(3))
    raw = jax.random.PRNGKey(0)
    with pytest.raises(TypeError, match="key must be a typed key"):
        jaxpets.unroll(ENV, CHANCE, PARAMS, raw, begin, length=3)
