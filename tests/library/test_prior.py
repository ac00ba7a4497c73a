"""A search that begins with what a policy would do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets import PlanParams, policies
from jaxpets.typing import PlanOutput

GAIN, HORIZON = jnp.float32(3.0), 4
ROLLOUT = jaxpets.particle_rollout(toys.cart)
FAR = jnp.array([0.5, 0.0])


def policy_of(action_fn):
    """A policy that keeps no state; its reward data are a target."""

    def step(params, key, state, obs):
        action = action_fn(params.reward, obs)
        return PlanOutput(action, action[None], jnp.zeros(())), state

    return jaxpets.Planner(lambda: (), step)


def push(target, obs):
    return jnp.clip(target - obs[:1] - obs[1:], -1.0, 1.0)


def test_it_is_what_the_policy_would_do():
    propose = policies.prior(policy_of(push), toys.cart, horizon=HORIZON)
    params, obs = PlanParams(GAIN, jnp.float32(0.9)), FAR
    found = jax.jit(propose)(params, jax.random.key(0), obs)
    for action in found:
        wanted = push(params.reward, obs)
        np.testing.assert_allclose(action, wanted, rtol=1e-6)
        obs = toys.cart(GAIN, None, obs[None, None], wanted[None])[0, 0]


def test_members_that_go_apart_share_the_mean_of_their_actions():
    def dynamics(params, key, obs, action):
        return toys.cart(jnp.array([[1.0], [9.0]]), key, obs, action)

    params, key = PlanParams(GAIN, jnp.float32(0.9)), jax.random.key(0)
    propose = policies.prior(policy_of(push), dynamics, horizon=3, num_members=2)
    found = propose(params, key, FAR)
    obs = jnp.broadcast_to(FAR, (2, 2))
    for action in found:
        wanted = jax.vmap(push, (None, 0))(params.reward, obs).mean(0)
        np.testing.assert_allclose(action, wanted, rtol=1e-5)
        obs = dynamics(GAIN, None, obs[:, None], wanted[None])[:, 0]


@pytest.mark.parametrize("name", toys.OPTIMIZERS)
@pytest.mark.parametrize("better", [True, False])
def test_a_search_begins_at_the_better_of_two(name, better):
    """A proposal that promises more is the mean; another changes nothing."""
    search = toys.optimizer(name, horizon=HORIZON)
    proposal = jnp.full((HORIZON, 1), 1.0 if better else -1.0, jnp.float32)
    params = PlanParams(GAIN, jnp.float32(5.0))
    asked = []

    def propose(params, key, obs):
        asked.append(obs.shape)
        return proposal

    plain = jaxpets.plan(ROLLOUT, toys.reach, search)
    planner = jaxpets.plan(ROLLOUT, toys.reach, search, propose_fn=propose)
    key, start = jax.random.key(0), search.init()
    found = jax.jit(planner.step)(params, key, start, FAR)
    begun = start._replace(mean=proposal) if better else start
    wanted = jax.jit(plain.step)(params, jax.random.split(key, 3)[0], begun, FAR)
    toys.assert_trees_close(found, wanted, rtol=1e-5, atol=1e-6)
    assert asked == [(2,)]


def test_a_proposal_is_compared_in_chunks_too():
    sizes = []

    def rollout(params, key, obs, actions):
        sizes.append(len(actions))
        return ROLLOUT(params, key, obs, actions)

    def propose(params, key, obs):
        return jnp.zeros((HORIZON, 1), jnp.float32)

    search = toys.optimizer("cem", horizon=HORIZON)
    params = PlanParams(GAIN, jnp.float32(5.0))
    planner = jaxpets.plan(
        rollout, toys.reach, search, propose_fn=propose, chunk_size=1
    )
    jax.eval_shape(planner.step, params, jax.random.key(0), search.init(), FAR)
    assert set(sizes) == {1}


def test_what_is_not_finite_is_no_beginning():
    def propose(params, key, obs):
        return jnp.full((HORIZON, 1), jnp.nan, jnp.float32)

    search = toys.optimizer("cem", horizon=HORIZON)
    planner = jaxpets.plan(ROLLOUT, toys.reach, search, propose_fn=propose)
    params = PlanParams(GAIN, jnp.float32(5.0))
    plan, _ = planner.step(params, jax.random.key(0), search.init(), FAR)
    assert np.isfinite(plan.actions).all()


def test_wrong_arguments_are_refused():
    search = toys.optimizer("cem", horizon=HORIZON)
    still = jnp.zeros((1, 2, 1), jnp.float32)
    with pytest.raises(TypeError, match="state with a mean for propose_fn, got"):
        jaxpets.plan(ROLLOUT, toys.reach, toys.probe(still), propose_fn=lambda *x: x)
    with pytest.raises(TypeError, match="propose_fn must be a function, got 3"):
        jaxpets.plan(ROLLOUT, toys.reach, search, propose_fn=3)
    short = jaxpets.plan(
        ROLLOUT, toys.reach, search, propose_fn=lambda *_: jnp.zeros((2, 1))
    )
    params = PlanParams(GAIN, jnp.float32(5.0))
    with pytest.raises(ValueError, match=r"result must be float32\[4, 1\]"):
        short.step(params, jax.random.key(0), search.init(), FAR)
    with pytest.raises(TypeError, match="state must be a CEMState, got tuple"):
        short.step(params, jax.random.key(0), (), FAR)
    longer = toys.optimizer("cem", horizon=HORIZON + 1).init()
    message = r"state\.mean must be float32\[4, 1\], got float32\[5, 1\]"
    with pytest.raises(ValueError, match=message):
        short.step(params, jax.random.key(0), longer, FAR)
    with pytest.raises(TypeError, match="policy must be a Planner"):
        policies.prior(None, toys.cart, horizon=2)
    with pytest.raises(ValueError, match="horizon must be at least 1, got 0"):
        policies.prior(policy_of(push), toys.cart, horizon=0)
    with pytest.raises(TypeError, match="dynamics_fn must be a function"):
        policies.prior(policy_of(push), None, horizon=2)
