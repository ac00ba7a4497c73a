"""A cart with a pendulum, and a goal that is drawn for every trial: a user's file."""

import jax
import jax.numpy as jnp

from jaxpets import RewardData, coordinates, rewards
from jaxpets.envs import Axis, Robot, mujoco_env, tasks_of

XML = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" limited="true" range="-2 2"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
      <body name="pole">
        <joint name="turn" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass=".2"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="x" ctrllimited="true" ctrlrange="-5 5"/></actuator>
</mujoco>
"""


def robot(backend):
    env = mujoco_env(XML, observe=("qpos", "qvel"), backend=backend)
    place = {row.name: i for i, row in enumerate(env.coordinates)}
    x, turn, rate = (place[f"{name}"] for name in ("qpos/x", "qpos/turn", "qvel/turn"))

    def reset(key):
        goal = jax.random.uniform(key, (), jnp.float32, -1.0, 1.0)
        return env.reset(key)._replace(constants={"goal": goal})

    def step(state, action):
        return env.step(state, action)._replace(constants=state.constants)

    turned = mujoco_env(
        XML, observe=("qpos", "qvel"), backend=backend,
        reset=lambda key: (jnp.array([0.0, 1.0]), jnp.zeros(2)),
    )  # fmt: skip

    def task_reset(task, key):
        spins = turned.reset(key)._replace(constants=reset(key).constants)
        return jax.tree.map(lambda a, b: jnp.where(task == 1, a, b), spins, reset(key))

    def reach(constants, obs, action, next_obs):
        return -jnp.abs(next_obs[..., x] - constants["goal"])

    def spin(constants, obs, action, next_obs):
        return next_obs[..., rate] - 0.1 * jnp.sum(action**2)

    return Robot(
        name="cart",
        env=env._replace(reset=reset, step=step),
        space=coordinates.space(env.coordinates),
        tasks=tasks_of({"reach": reach, "spin": spin}),
        axes=(
            Axis("place", "m", x, (-2.0, -1.0, 0.0, 1.0, 2.0)),
            Axis("rate", "rad/s", rate, (-10.0, 0.0, 10.0)),
        ),
        angle=turn,
        task_reset=task_reset,
    )


def tasks():
    def near(constants, obs, action, next_obs):
        return -jnp.abs(next_obs[..., 0] - constants["goal"])

    return {"near": near}


def novelty(model):
    """The paper's reward over one."""
    one = jnp.ones((model.obs_size,), jnp.float32)
    return rewards.epistemic, RewardData(init=lambda key: one)


def wrong(backend):
    return backend
