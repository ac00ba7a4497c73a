import jax
import jax.numpy as jnp
import numpy as np

import jaxpets


def test_worst_value_stays_finite_in_sums_and_below_any_return():
    # As many elites as anyone would take, summed in float32.
    worst = jnp.full((100_000,), jaxpets.optimizers.WORST_VALUE, jnp.float32)
    assert jnp.isfinite(worst.sum())
    assert worst[0] < -1e12


def test_records_are_pytrees_of_their_fields():
    row = jaxpets.Transition(jnp.zeros(2), jnp.zeros(1), jnp.ones(2))
    doubled = jax.tree.map(lambda x: 2 * x, row)
    assert isinstance(doubled, jaxpets.Transition)
    np.testing.assert_array_equal(doubled.next_obs, [2.0, 2.0])


def test_reward_params_are_optional():
    assert jaxpets.PlanParams(dynamics=1.0).reward == ()


def test_protocols_take_plain_functions():
    def dynamics(params, key, obs, action):
        return obs

    fn: jaxpets.typing.DynamicsFn = dynamics
    rollout: jaxpets.typing.RolloutFn = jaxpets.particle_rollout(fn)
    path = rollout((), jax.random.key(0), jnp.zeros(2), jnp.zeros((3, 4, 1)))
    assert path.shape == (3, 5, 1, 1, 2)
