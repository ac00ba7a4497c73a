"""dm_control itself, beside whose steps and rewards ours are laid.

As a script it does so at length, and prints the largest differences:

    PYTHONPATH=.:tests/library python tests/library/dmc_judge.py [mjx] [name ...]
"""

import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import parity
import pytest

from jaxpets import envs
from jaxpets.envs.dmc import DOMAINS

# dm_control asks for OpenGL when it is imported, and nothing is drawn here. Only then:
# tests of videos are in the same process.
with pytest.MonkeyPatch.context() as _patch:
    _patch.setenv("MUJOCO_GL", "disable")
    from dm_control.mujoco.wrapper.mjbindings import sizes

    # dm_control 1.0.50 lists arrays that MuJoCo 4 no longer has, of flexible bodies.
    _model = mujoco.MjModel.from_xml_string("<mujoco/>")
    for _name, _thing in (("mjmodel", _model), ("mjdata", mujoco.MjData(_model))):
        for _field in list(sizes.array_sizes[_name]):
            if not hasattr(_thing, _field):
                del sizes.array_sizes[_name][_field]

    from dm_control import suite

# Tasks of ours as another sign of one of the judge's, and those that are ours alone.
MIRRORED = {
    "run-backwards": "run",
    "walk-backwards": "walk",
    "hop-backwards": "hop",
}
OURS = ("jump", "front-flip", "back-flip")


class Judge:
    """One domain of dm_control, put into any state."""

    def __init__(self, name, tasks):
        domain = DOMAINS[name]
        self.repeat = domain.action_repeat
        self.envs = {
            task: suite.load(domain.file, task.replace("-", "_"), {"random": 0})
            for task in tasks
            if task not in MIRRORED and task not in OURS
        }
        self.env = next(iter(self.envs.values()))
        for env in self.envs.values():
            env.reset()
        self.physics = self.env.physics
        self.model, self.data = self.physics.model.ptr, self.physics.data.ptr
        assert self.env.control_timestep() == domain.control_step
        self.num_substeps = round(domain.control_step / self.model.opt.timestep)

    def put(self, physics):
        """Puts a state of ours in."""
        data = self.data
        data.qpos[:], data.qvel[:] = physics.qpos, physics.qvel
        data.qacc_warmstart[:] = physics.qacc_warmstart
        if self.model.na:
            data.act[:] = physics.act
        mujoco.mj_step1(self.model, data)

    def step(self, action):
        """Steps as its environment does, as often as an action is held."""
        for _ in range(self.repeat):
            self.env.task.before_step(action, self.physics)
            self.physics.step(self.num_substeps)

    def reward(self, task, constants, action):
        """Returns the reward of the state it is in, mirrored where ours is."""
        del action
        if task in OURS:
            return None
        own = self.envs[MIRRORED.get(task, task)].task
        named = self.physics.named.model
        if task in ("easy", "hard"):
            named.geom_size["target", 0] = own._target_size
            named.geom_pos["target", ["x", "y"]] = constants
        if task.startswith("turn"):
            named.site_size["target", 0] = own._target_radius
            hinge = self.physics.named.data.xanchor["hinge", ["x", "z"]]
            named.site_pos["target", ["x", "z"]] = hinge + np.asarray(constants)
        if isinstance(constants, np.ndarray):
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_sensorPos(self.model, self.data)
        if task not in MIRRORED:
            return own.get_reward(self.physics)
        speed = self.physics.named.data.sensordata["torso_subtreelinvel"]
        speed[0] *= -1
        reward = own.get_reward(self.physics)
        speed[0] *= -1
        return reward


def near_rest(model, key, physics):
    """Returns a state close to the model's own posture, fast or slow.

    That is where most tasks are fulfilled, and random actions hardly ever lead. In two
    domains it is elsewhere: the ball is in the cup, the spinner spins. A free joint
    stays as it is.
    """
    if model.nq != model.nv:
        return physics
    speed_key, scale_key = jax.random.split(key)
    scale = 20 * jax.random.uniform(scale_key, (), jnp.float32) ** 2
    qpos = jnp.asarray(model.qpos0, jnp.float32)
    qpos += 0.02 * (physics.qpos - qpos)
    qvel = scale * jax.random.normal(speed_key, (model.nv,), jnp.float32)
    last = model.joint(model.njnt - 1).name
    if last == "ball_z":
        qpos, qvel = qpos.at[-1].set(0.35), 0.0 * qvel
    if last == "hinge":
        qvel = qvel.at[-1].set(-18.0)
    return physics._replace(qpos=qpos, qvel=qvel)


def differences(robot, num_trials, num_steps):
    """Returns how far a domain of ours is from dm_control's, and the trials of it."""
    judge = Judge(robot.name.removeprefix("dmc/"), robot.tasks.names)
    trials = parity.rolled(robot, num_trials, num_steps, near_rest)
    return parity.differences(robot, judge, trials), trials


def main(argv):
    backend = "mjx" if "mjx" in argv else "mujoco"
    names = [name for name in argv if name != "mjx"] or list(DOMAINS)
    for name in names:
        robot = envs.make(f"dmc/{name}", backend=backend)
        many = 1000 if backend == "mujoco" else 40
        long, _ = differences(robot, 1, many // DOMAINS[name].action_repeat)
        wide, _ = differences(robot, many // 2, 2)
        print(name, long, wide, sep="\n  ", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
