"""Settings of a search that are traced: a sweep by vmap is the loop over numbers."""

import jax
import jax.numpy as jnp
import pytest
import toys

import jaxpets
from jaxpets.optimizers import cem, icem, mppi

BOX = dict(horizon=4, action_low=-jnp.ones(1), action_high=jnp.ones(1))
SMALL = dict(num_samples=32, num_iterations=2, **BOX)
# Every number that may be traced, and two values of it.
SWEEPS = {
    ("cem", "momentum"): (0.1, 0.6),
    ("cem", "min_variance"): (1e-3, 0.2),
    ("icem", "momentum"): (0.1, 0.6),
    ("icem", "noise_beta"): (0.0, 2.0),
    ("icem", "init_std"): (0.1, 1.0),
    ("mppi", "std"): (0.1, 1.0),
    ("mppi", "temperature"): (0.05, 5.0),
}
SEARCHES = {
    "cem": lambda **one: cem(num_elites=6, **SMALL, **one),
    "icem": lambda **one: icem(num_elites=6, **SMALL, **one),
    "mppi": lambda **one: mppi(**SMALL, **one),
}


def found(name, **setting):
    search = SEARCHES[name](**setting)

    def objective(key, actions):
        return toys.bumpy(actions)

    return search.step(objective, jax.random.key(0), search.init())


@pytest.mark.parametrize(("name", "argument"), SWEEPS)
def test_a_sweep_is_the_loop(name, argument):
    values = SWEEPS[name, argument]
    sweep = jax.jit(jax.vmap(lambda value: found(name, **{argument: value})))
    got = sweep(jnp.array(values))
    assert len({float(value) for value in got[0].value}) == 2
    for i, value in enumerate(values):
        want = found(name, **{argument: value})
        one = jax.tree.map(lambda x, i=i: x[i], got)
        # Constants round otherwise than what is traced; elites are the same.
        toys.assert_trees_close(one, want, rtol=1e-4, atol=1e-5)


def test_a_plan_is_swept_over_its_search():
    rollout = jaxpets.particle_rollout(toys.cart)
    params = jaxpets.PlanParams(jnp.float32(1.0), jnp.float32(0.5))

    def value(temperature):
        planner = jaxpets.plan(
            rollout, toys.reach, mppi(temperature=temperature, **SMALL)
        )
        step = planner.step(params, jax.random.key(0), planner.init(), jnp.zeros(2))
        return step[0].value

    values = jax.jit(jax.vmap(value))(jnp.array([0.1, 1.0, 10.0]))
    assert values[0] > values[1] > values[2]  # the more is averaged, the worse


@pytest.mark.parametrize(("name", "argument"), SWEEPS)
def test_a_traced_number_must_be_one_float(name, argument):
    with pytest.raises(ValueError, match=rf"{argument} must be float32\[\], got int32"):
        jax.eval_shape(lambda value: found(name, **{argument: value}), jnp.int32(1))


@pytest.mark.parametrize("argument", ["decay", "kept_fraction"])
def test_what_shapes_an_array_is_not_traced(argument):
    with pytest.raises(TypeError, match=f"{argument} must be a Python float"):
        jax.eval_shape(lambda value: found("icem", **{argument: value}), jnp.ones(()))
