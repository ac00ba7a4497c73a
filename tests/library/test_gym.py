"""Gymnasium's robots, beside gymnasium itself."""

import functools

import gym_judge
import numpy as np
import parity
import pytest

from jaxpets import envs
from jaxpets.envs.gym import ROBOTS


@functools.cache
def compared(name):
    """The largest differences to gymnasium, the robot, and the trials."""
    return gym_judge.differences(name, 6, 4)


@pytest.mark.parametrize("name", ROBOTS)
def test_steps_and_rewards_are_those_of_gymnasium(name):
    found, robot, _ = compared(name)
    # Physics is the same to the bit and passes through float32: an error of 6e-8.
    assert max(found.qpos, found.qvel) < 1e-6
    # Velocities over a step divide that by 8 ms.
    assert found.reward < 1e-5 and found.flipped == 0
    low, high = robot.model.actuator_ctrlrange.T
    np.testing.assert_allclose(robot.env.action_low, low)
    np.testing.assert_allclose(robot.env.action_high, high)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_state_that_is_no_number_earns_none(name):
    parity.assert_nothing_is_earned_by_nan(compared(name)[1])


def test_trials_start_near_the_models_own_posture():
    for name, width, speed in (("Hopper-v5", 0.005, 0.005), ("Ant-v5", 0.11, 0.6)):
        _, robot, trials = compared(name)
        physics = trials.before.physics
        away = np.abs(physics.qpos[:, 0] - robot.model.qpos0)
        assert 0.3 * width < away.max() < width
        assert 0.3 * speed < np.abs(physics.qvel[:, 0]).max() < speed


def test_what_is_to_be_reached_is_drawn_for_a_trial():
    _, _, trials = compared("Reacher-v5")
    targets = trials.after.constants
    assert (np.linalg.norm(targets, axis=-1) < 0.2).all()
    np.testing.assert_array_equal(targets, targets[:, :1].repeat(4, axis=1))
    assert np.ptp(targets[:, 0], axis=0).min() > 0.05
    _, robot, trials = compared("Pusher-v5")
    place = robot.model.joint("obj_slidey").qposadr[0]
    objects = trials.before.physics.qpos[:, 0, place : place + 2]
    assert (np.linalg.norm(objects, axis=-1) > 0.17).all()
    assert (objects >= [-0.3, -0.2]).all() and (objects <= [0.0, 0.2]).all()


def test_a_robot_holds_its_action_for_as_long_as_a_plan_can_see():
    robot = envs.make("gym/Hopper-v5")
    assert robot.name == "gym/Hopper-v5" and robot.tasks.names[0] == "forward"
    recipe = ROBOTS["Hopper-v5"]
    assert recipe.control_step * recipe.action_repeat == pytest.approx(0.04)
    with pytest.raises(ValueError, match="MJX lacks what this model uses"):
        envs.make("gym/Humanoid-v5", backend="mjx")
