import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets.rewards import score

TRIAL = toys.transitions(6)


@pytest.mark.parametrize("reduced", [False, True])
def test_every_step_has_its_reward(reduced):
    def reward(target, obs, action, next_obs):
        assert obs.shape == next_obs.shape == (1, 1, 2) and action.shape == (1,)
        reward = toys.reach(target, obs, action, next_obs) + obs[..., 1]
        return jnp.mean(reward) if reduced else reward

    got = jax.jit(score, static_argnums=0)(reward, jnp.float32(0.5), TRIAL)
    obs, action, next_obs = (np.asarray(x) for x in TRIAL)
    want = -((next_obs[:, 0] - 0.5) ** 2) - 1e-3 * action[:, 0] ** 2 + obs[:, 1]
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, want, rtol=1e-5)  # roundings


def test_a_plan_is_worth_what_its_trial_scores(key):
    """Where the model is the world, without noise."""
    env = toys.cart_env()
    planner = jaxpets.plan(
        jaxpets.particle_rollout(toys.cart), toys.reach, toys.probe(jnp.ones((1, 4, 1)))
    )
    params = jaxpets.PlanParams(jnp.float32(1.0), jnp.float32(0.5))
    state = jaxpets.start_trial(env, planner, key)
    _, trial, plans = jaxpets.unroll(env, planner, params, key, state, length=4)
    rewards = score(toys.reach, params.reward, trial)
    np.testing.assert_allclose(rewards.sum(), plans.value[0], rtol=1e-5)


def test_what_compares_members_cannot_be_scored():
    with pytest.raises(ValueError, match="at least 2 members, got 1"):
        score(jaxpets.rewards.epistemic, jnp.ones(2), TRIAL)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (dict(obs=jnp.zeros(2)), r"transitions.obs must be float32\[T, D\], got"),
        (dict(action=jnp.zeros((5, 1))), r"transitions.action must be float32\[6, A\]"),
        (dict(next_obs=jnp.zeros((6, 3))), r"transitions.next_obs must be .*\[6, 2\]"),
    ],
)
def test_wrong_arrays_fail_when_traced(changes, text):
    with pytest.raises(ValueError, match=text):
        score(toys.reach, jnp.float32(0.5), TRIAL._replace(**changes))


def test_wrong_things_fail():
    with pytest.raises(TypeError, match="transitions must be a Transition, got tuple"):
        score(toys.reach, jnp.float32(0.5), tuple(TRIAL))
    with pytest.raises(TypeError, match="reward_fn must be a function"):
        score(None, (), TRIAL)
    with pytest.raises(ValueError, match=r"reward_fn must return shape \(\) or \(1, 1"):
        score(lambda p, o, a, n: n, (), TRIAL)
