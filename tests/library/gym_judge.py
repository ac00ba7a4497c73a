"""Gymnasium itself, beside whose steps and rewards ours are laid.

As a script it does so at length, and prints the largest differences:

    PYTHONPATH=.:tests/library python tests/library/gym_judge.py [mjx] [name ...]
"""

import sys

import gymnasium
import mujoco
import parity

from jaxpets.envs import gym
from jaxpets.envs.recipe import build

# A task of ours; gymnasium's own is the first.
OURS = ("backward", "front-flip", "back-flip")


class Judge:
    """One robot of gymnasium, put into any state."""

    repeat = 1

    def __init__(self, name):
        self.name = name
        self.env = gymnasium.make(name).unwrapped
        self.model, self.data = self.env.model, self.env.data
        recipe = gym.ROBOTS[name]
        assert round(self.env.dt, 6) == recipe.control_step

    def put(self, physics):
        """Puts a state of ours in."""
        data = self.data
        data.qpos[:], data.qvel[:] = physics.qpos, physics.qvel
        data.qacc_warmstart[:] = physics.qacc_warmstart

    def step(self, action):
        """Steps once, and then looks at the state that was reached.

        Gymnasium reads places and contacts one substep before it.
        """
        self.x = self.data.qpos[0]
        _, self.stepped, _, _, _ = self.env.step(action)
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_subtreeVel(self.model, self.data)
        mujoco.mj_rnePostConstraint(self.model, self.data)

    def reward(self, task, constants, action):
        """Returns gymnasium's own reward, less what ours leaves out."""
        env = self.env
        if task in OURS:
            return None
        if task == "reach":
            self.model.body("target").pos[:2] = constants
            self.data.qpos[2:] = self.model.qpos0[2:]
            mujoco.mj_kinematics(self.model, self.data)
        if task in ("reach", "push"):
            return env._get_rew(action)[0]
        if self.name == "Ant-v5":
            velocity = (self.data.qpos[0] - self.x) / env.dt
        elif self.name == "Humanoid-v5":
            velocity = self.data.subtree_linvel[1, 0]
        else:
            return self.stepped
        return env._get_rew(velocity, action)[0] + env.contact_cost


def differences(name, num_trials, num_steps, backend="mujoco"):
    """Returns how far a robot of ours is from gymnasium's, both, and the trials."""
    # Rewards are laid beside each other at every control step.
    recipe = gym.ROBOTS[name]._replace(action_repeat=1)
    robot = build(f"gym/{name}", gym._model(recipe.file), recipe, backend)
    trials = parity.rolled(robot, num_trials, num_steps)
    return parity.differences(robot, Judge(name), trials), robot, trials


def main(argv):
    backend = "mjx" if "mjx" in argv else "mujoco"
    many = 1000 if backend == "mujoco" else 40
    for name in [name for name in argv if name != "mjx"] or gym.ROBOTS:
        long, _, _ = differences(name, 1, many, backend)
        wide, _, _ = differences(name, many // 2, 2, backend)
        print(name, long, wide, sep="\n  ", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
