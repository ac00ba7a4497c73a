"""A robot from an MJCF: what it earns, and what it is drawn with."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots

from jaxpets import envs
from jaxpets.envs import mujoco_robot

AXES = ("speed", "m/s", "qvel/slider", 3.0), ("turn", "rad", "qpos/hinge", 1.5)


def tasks(entry):
    speed, hinge = entry("qvel/slider"), entry("qpos/hinge")
    return {
        "fast": lambda constants, obs, action, next_obs: next_obs[..., speed],
        "upright": lambda constants, obs, action, next_obs: -abs(next_obs[..., hinge]),
    }


def test_it_has_what_its_parts_have():
    settings = {"observe": ("qpos", "qvel"), "control_step": 0.02, "action_repeat": 3}
    robot = mujoco_robot(
        "cart", robots.CART_XML, tasks, axes=AXES, angle="qpos/hinge", **settings
    )
    env = envs.mujoco_env(robots.CART_XML, **settings)
    assert robot.env.coordinates == robot.space.coordinates == env.coordinates
    assert (robot.name, robot.tasks.names) == ("cart", ("fast", "upright"))
    assert (robot.step_time, robot.action_repeat) == (pytest.approx(0.06), 3)
    key, action = jax.random.key(0), jnp.ones(1)
    state, want = robot.env.reset(key), env.reset(key)
    np.testing.assert_array_equal(state.obs, want.obs)
    after = robot.env.step(state, action).obs
    np.testing.assert_array_equal(after, env.step(want, action).obs)
    names = [row.name for row in env.coordinates]
    speed, hinge = (names.index(name) for name in ("qvel/slider", "qpos/hinge"))
    for task, earned in enumerate((after[speed], -abs(after[hinge]))):
        got = robot.tasks.reward_fn(jnp.int32(task), state.obs, action, after)
        assert got == earned
    assert robot.angle == hinge
    first, second = robot.axes
    assert first[:3] == ("speed", "m/s", speed) and second.entry == hinge
    np.testing.assert_allclose(first.edges, np.linspace(-3, 3, 31), atol=1e-12)


def test_a_recorded_trial_of_it_can_be_drawn():
    robot = mujoco_robot("cart", robots.CART_XML, tasks, observe=("qpos", "qvel"))
    obs = jnp.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(robot.qpos_fn(obs), obs[:, :2])
    assert robot.model.nq == 2 and robot.step_time == 0.05
    assert (robot.axes, robot.angle) == ((), None)


def test_what_it_passes_on_is_heeded():
    robot = mujoco_robot(
        "cart",
        robots.CART_XML,
        tasks,
        reset=lambda key: (jnp.array([2.0, 0.5]), jnp.zeros(2)),
        terminal_fn=lambda obs: obs[..., 0] > 1e9,
        observe=("qpos", "qvel"),
    )
    obs = robot.env.reset(jax.random.key(0)).obs
    np.testing.assert_allclose(obs[:2], [2.0, 0.5])
    assert not robot.env.terminal_fn(obs)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"tasks": lambda entry: {"fast": entry("qvel/slide")}}, "'qvel/slide'"),
        ({"tasks": lambda entry: {}}, "rewards must have a task"),
        ({"angle": "qpos/hing"}, "qpos/hinge"),
        ({"axes": (("speed", "m/s", "qvel", 1.0),) * 2}, "'qvel'"),
        ({"backend": "other"}, "backend must be"),
        ({"name": 3}, "name must be a text, got 3"),
        ({"tasks": {"fast": 1}}, "tasks must be a function, got {'fast': 1}"),
        ({"axes": AXES[:1]}, "axes must be two of .name, unit, entry, end., got"),
        ({"axes": AXES[0][:2]}, "an axis must be .*, end., got 'speed'"),
        ({"axes": (AXES[0], AXES[1][:3])}, "an axis must be .name, unit, entry, end."),
        ({"axes": (AXES[0], (*AXES[1][:3], "1"))}, "end of an axis must be a P"),
        ({"axes": (AXES[0], (*AXES[1][:3], 0.0))}, "end of an axis must be above"),
        ({"camera": "side"}, "camera must be one of the model, .., got 'side'"),
    ],
)
def test_what_cannot_be_is_refused(wrong, said):
    given = {"name": "cart", "tasks": tasks, **wrong}
    with pytest.raises((TypeError, ValueError), match=said):
        mujoco_robot(model=robots.CART_XML, **given)
