"""A double pendulum whose physics diverges under a strong motor: a user's file."""

from jaxpets import coordinates
from jaxpets.envs import Axis, Robot, mujoco_env, tasks_of

XML = """
<mujoco>
  <option timestep="0.05"/>
  <worldbody>
    <body>
      <joint name="turn" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" size=".05" mass="1"/>
      <body pos="0 0 -1">
        <joint type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -1" size=".05" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="turn" gear="300" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def robot(backend):
    env = mujoco_env(XML, observe=("qpos", "qvel"), backend=backend)

    def steps(constants, obs, action, next_obs):
        return 1.0 + 0.0 * next_obs[..., 0]  # what diverged is worth NaN

    return Robot(
        name="wild",
        env=env,
        space=coordinates.space(env.coordinates),
        tasks=tasks_of({"steps": steps}),
        axes=tuple(
            Axis(name, "rad/s", i, (-10.0, 0.0, 10.0))
            for i, name in ((2, "a"), (3, "b"))
        ),
        angle=0,
    )
