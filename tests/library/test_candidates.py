"""What a search tried, as a plan returns it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys

import jaxpets
from jaxpets.optimizers import cem, icem, mppi

BOX = dict(horizon=3, action_low=-jnp.ones(1), action_high=jnp.ones(1))
SMALL = dict(num_samples=16, num_iterations=2, **BOX)
SEARCHES = {
    "cem": lambda **one: cem(num_elites=4, **SMALL, **one),
    "icem": lambda **one: icem(num_elites=4, **SMALL, **one),
    "icem-loop": lambda **one: icem(num_elites=4, unroll=False, **SMALL, **one),
    "mppi": lambda **one: mppi(**SMALL, **one),
}


@pytest.mark.parametrize("name", SEARCHES)
def test_all_that_was_tried_is_kept(name):
    search = SEARCHES[name](keep_candidates=True)
    asked = toys.record(search, toys.bumpy)
    tried = asked.solution.candidates
    np.testing.assert_array_equal(tried.actions, np.concatenate(asked.actions))
    np.testing.assert_array_equal(tried.values, np.concatenate(asked.values))
    plain = toys.record(SEARCHES[name](), toys.bumpy)
    assert plain.solution.candidates == ()
    # Another program may round otherwise.
    same = asked.solution._replace(candidates=())
    toys.assert_trees_close(same, plain.solution, rtol=1e-5, atol=1e-6)


def test_a_plan_passes_them_on(key):
    rollout = jaxpets.particle_rollout(toys.cart)
    search = SEARCHES["cem"](keep_candidates=True)
    planner = jaxpets.plan(rollout, toys.reach, search)
    params = jaxpets.PlanParams(jnp.float32(1.0), jnp.float32(0.5))
    out, _ = jax.jit(planner.step)(params, key, planner.init(), jnp.zeros(2))
    assert isinstance(out.candidates, jaxpets.typing.Candidates)
    path = rollout(params.dynamics, key, jnp.zeros(2), out.candidates.actions)
    rewards = jax.vmap(jax.vmap(toys.reach, (None, 0, 0, 0)), (None, 0, 0, 0))(
        params.reward, path[:, :-1], out.candidates.actions, path[:, 1:]
    )
    want = rewards.mean((2, 3)).sum(1)
    np.testing.assert_allclose(out.candidates.values, want, rtol=1e-5)
