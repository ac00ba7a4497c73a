"""Robots by name, and tasks made of functions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets import envs
from jaxpets.envs import half_cheetah


def height(constants, obs, action, next_obs):
    del constants, obs, action
    return next_obs[..., 0]


def nearness(target, obs, action, next_obs):
    del obs, action
    return -jnp.abs(next_obs[..., 0] - target)


def test_the_robot_of_the_paper_has_its_tasks():
    robot = envs.make("pets/half_cheetah")
    assert robot.name in envs.names()
    assert robot.tasks.names == half_cheetah.TASK_NAMES
    assert robot.axes[0].entry == half_cheetah.FORWARD_VELOCITY
    state = robot.env.reset(jax.random.key(0))
    assert state.constants == ()
    params = envs.with_constants(jax.tree.map(lambda x: x[1], robot.tasks.params), ())
    action = jnp.zeros(half_cheetah.ACTION_SIZE)
    got = robot.tasks.reward_fn(params, state.obs, action, state.obs)
    want = half_cheetah.task_reward(
        half_cheetah.task("backward"), state.obs, action, state.obs
    )
    assert got == want


def test_tasks_are_one_reward_with_data():
    tasks = envs.tasks_of({"height": height, "nearness": nearness})
    assert tasks.names == ("height", "nearness")
    obs, action = jnp.array([[1.0, 5.0], [3.0, 5.0]]), jnp.zeros(1)

    def reward(params):
        params = envs.with_constants(params, jnp.float32(2.5))
        return tasks.reward_fn(params, obs, action, obs)

    got = jax.jit(jax.vmap(reward))(tasks.params)
    np.testing.assert_array_equal(got, [[1.0, 3.0], [-1.5, -0.5]])
    alone = envs.tasks_of({"height": height})
    np.testing.assert_array_equal(
        alone.reward_fn(alone.params[0], obs, action, obs), [1.0, 3.0]
    )


def test_a_task_that_returns_nothing_is_named():
    tasks = envs.tasks_of({"height": height, "none": lambda *step: None})
    with pytest.raises(
        TypeError, match=r"rewards\['none'\] must return a reward, got N"
    ):
        tasks.reward_fn(tasks.params[0], jnp.zeros(2), jnp.zeros(1), jnp.zeros(2))


def test_what_is_no_robot_is_refused():
    with pytest.raises(ValueError, match=r"as pets/half_cheetah, .*got 'half_cheeta'"):
        envs.make("half_cheeta")
    with pytest.raises(ValueError, match='backend must be "mujoco" or "mjx", got 3'):
        envs.make("pets/half_cheetah", backend=3)
    with pytest.raises(ValueError, match="rewards must have a task, got none"):
        envs.tasks_of({})
    with pytest.raises(TypeError, match=r"name must be a text, got 3 \(int\)"):
        envs.make(3)
    with pytest.raises(TypeError, match="rewards must be functions by name, got list"):
        envs.tasks_of([height])
    with pytest.raises(TypeError, match="a name of rewards must be a text, got 1"):
        envs.tasks_of({1: height})
    with pytest.raises(ValueError, match="a name of rewards must not be empty"):
        envs.tasks_of({"": height})
    with pytest.raises(TypeError, match=r"rewards\['high'\] must be a function, got 2"):
        envs.tasks_of({"high": 2})
