"""Candidates shared out over an axis: the values are those of parts evaluated by hand.

Here the axis is one of `jax.vmap`; tests/test_devices.py has one of devices.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from cases import NOISY, cart_obs, key_of

import jaxpets

SIZE, HORIZON = 4, 3
PARAMS = jaxpets.PlanParams(jnp.float32(1.0), jnp.float32(0.5))
EXACT = jaxpets.particle_rollout(toys.cart, num_members=2, num_particles=4)
# An axis of vmap changes the order of sums; see test_transforms.
CLOSE = dict(rtol=1e-4, atol=1e-5)


def over_axis(planner, obs, key=None, size=SIZE):
    """Plans once over an axis, and returns what all of it agrees on."""

    def step(_):
        return planner.step(PARAMS, key_of(0), planner.init(), obs)

    out = jax.jit(jax.vmap(step, axis_name="device"))(jnp.arange(size))
    for leaf in jax.tree.leaves(out):
        assert np.all(np.asarray(leaf) == np.asarray(leaf)[:1])
    return jax.tree.map(lambda x: x[0], out)


def test_values_are_those_of_the_parts():
    """Part i of the candidates, with `fold_in(key, i)`; in order."""
    actions = jnp.sin(jnp.arange(8.0 * HORIZON)).reshape(8, HORIZON, 1)
    obs = cart_obs(1)
    planner = jaxpets.plan(
        NOISY, toys.reach, jaxpets.optimizers.sharded(toys.probe(actions), "device")
    )
    _, values = over_axis(planner, obs)
    for i in range(SIZE):
        part = slice(2 * i, 2 * i + 2)
        alone = jaxpets.plan(NOISY, toys.reach, toys.probe(actions[part]))
        key = jax.random.fold_in(key_of(0), i)
        _, want = alone.step(PARAMS, key, alone.init(), obs)
        np.testing.assert_allclose(values[part], want, **CLOSE)
    assert len(np.unique(values)) == 8


@pytest.mark.parametrize("name", ["cem", "mppi"])
def test_without_noise_it_is_the_same_plan(name):
    search = toys.optimizer(name, HORIZON)
    obs = cart_obs(2)
    got = over_axis(
        jaxpets.plan(EXACT, toys.reach, jaxpets.optimizers.sharded(search, "device")),
        obs,
    )
    alone = jaxpets.plan(EXACT, toys.reach, search)
    want = jax.jit(alone.step)(PARAMS, key_of(0), alone.init(), obs)
    toys.assert_trees_close(got, want, **CLOSE)


def test_the_size_of_the_axis_changes_the_noise_only():
    search = jaxpets.optimizers.sharded(toys.optimizer("cem", HORIZON), "device")
    got = over_axis(jaxpets.plan(EXACT, toys.reach, search), cart_obs(0), size=1)
    want = over_axis(jaxpets.plan(EXACT, toys.reach, search), cart_obs(0), size=4)
    toys.assert_trees_close(got, want, **CLOSE)


def test_no_key_is_used_twice():
    search = jaxpets.optimizers.sharded(toys.optimizer("cem", HORIZON), "device")
    planner = jaxpets.plan(NOISY, toys.reach, search)
    mesh = jax.sharding.Mesh(jax.devices()[:1], "device")
    spec = jax.sharding.PartitionSpec()
    step = jax.shard_map(
        planner.step, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
    )
    args = PARAMS, key_of(0), planner.init(), cart_obs(0)
    with jax.debug_key_reuse(True):  # which checks what is traced
        out, _ = jax.jit(step).trace(*args).out_info
    assert out.actions.shape == (HORIZON, 1)


@pytest.mark.parametrize("name", ["cem", "icem", "icem-loop"])
def test_candidates_need_not_divide(name):
    """64 on 5 devices, and those of iCEM, which keeps elites and tries the mean."""
    search = toys.optimizer(name, HORIZON)
    planner = jaxpets.plan(
        EXACT, toys.reach, jaxpets.optimizers.sharded(search, "device")
    )
    alone = jaxpets.plan(EXACT, toys.reach, search)
    want = jax.jit(alone.step)(PARAMS, key_of(0), alone.init(), cart_obs(1))
    got = over_axis(planner, cart_obs(1), size=5)
    toys.assert_trees_close(got, want, **CLOSE)


def test_the_axis_must_be_there():
    planner = jaxpets.plan(
        NOISY,
        toys.reach,
        jaxpets.optimizers.sharded(toys.optimizer("cem", HORIZON), "device"),
    )
    with pytest.raises(NameError, match="device"):
        planner.step(PARAMS, key_of(0), planner.init(), cart_obs(0))
