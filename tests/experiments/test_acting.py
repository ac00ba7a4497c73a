"""Trials in chunks: no number depends on how long they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxpets
from experiments import acting
from experiments.parallel import devices
from jaxpets.typing import PlanOutput

LENGTH, END = 12, 3


def world():
    """A trial ends after three steps; its constant is seen as well."""

    def reset(key):
        goal = jax.random.uniform(key, (), jnp.float32)
        return jaxpets.EnvState(jnp.stack([jnp.zeros(()), goal]), (), goal)

    def step(state, action):
        return state._replace(obs=state.obs.at[0].add(1.0))

    force = jnp.ones(1, jnp.float32)
    return jaxpets.Env(
        reset, step, -force, force, terminal_fn=lambda obs: obs[..., 0] >= END
    )


def told():
    """A planner that does what its reward data say."""

    def step(params, key, state, obs):
        action = params.reward[None]
        nothing = jnp.zeros((), jnp.float32)
        return PlanOutput(action, action[None], nothing, nothing), state

    return jaxpets.Planner(lambda: (), step)


@pytest.mark.parametrize("length", [1, 2, LENGTH])
def test_a_trial_that_begins_in_a_chunk_is_planned_with_its_own_constants(length):
    placement = devices.spread(2)
    actors = acting.explorers(
        world(), told(), 1, length, placement, lambda data, constants: constants
    )
    params = jaxpets.PlanParams((), jnp.zeros(2, jnp.float32))
    keys = jax.random.split(jax.random.key(0), 2)
    found = acting.run(actors, params, keys, LENGTH // length, lambda _: None)
    obs, action, _ = found.transitions
    np.testing.assert_array_equal(action[..., 0], obs[..., 1])
    assert len(np.unique(action)) == 2 * LENGTH // END  # each trial has its own
