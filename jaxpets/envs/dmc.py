"""The DeepMind Control Suite: ten domains as robots, with its tasks and some of ours.

Tassa et al., "DeepMind Control Suite", 2018. The models are those of the installed
dm_control (the extra `jaxpets[dmc]`), stepped with its control steps. What differs:

- An action is held for several control steps, so that a decision takes 0.04 s, of
  walker 0.05 s. A step earns the reward of the state that was reached, times these
  control steps: 1,000 of them earn at most 1,000, as there.
- An observation is positions, velocities and what a reward needs, and not dm_control's.
- The target of a trial is its constant, `EnvState.constants`, and is not observed.
- dm_control gives finger's spinner less damping in `spin` than in its other tasks. So
  these are two robots, `dmc/finger-spin` and `dmc/finger`.
- Cartpole starts with its pole down, and by `Robot.task_reset` upright in `balance`.
- Settling and starting without contact take what was drawn as float32; cheetah settles
  in whole steps of the environment, the same 2 s.
"""

from collections.abc import Mapping

from jaxpets.envs import dmc_rewards as rewards
from jaxpets.envs import dmc_starts as starts
from jaxpets.envs.dmc_model import load_model
from jaxpets.envs.observations import DEFAULT
from jaxpets.envs.recipe import Recipe, build
from jaxpets.envs.robot import Robot

_SPEED = (*DEFAULT, "sensordata/torso_subtreelinvel.x")
_JOINTS = ("qpos", "qvel")
_RUNNING = (
    ("velocity", "m/s", "sensordata/torso_subtreelinvel.x", 8.0),
    ("pitch_rate", "rad/s", "qvel/rooty", 15.0),
)
_SPINNING = (
    ("spinner_rate", "rad/s", "qvel/hinge", 20.0),
    ("proximal_angle", "rad", "qpos/proximal", 2.0),
)

DOMAINS: Mapping[str, Recipe] = {
    "acrobot": Recipe(
        "acrobot", 0.01, 4, _JOINTS, rewards.acrobot, starts.joints,
        (
            ("shoulder_rate", "rad/s", "qvel/shoulder", 10.0),
            ("elbow_rate", "rad/s", "qvel/elbow", 20.0),
        ),
        "fixed", "qpos/shoulder",
    ),
    "ball_in_cup": Recipe(
        "ball_in_cup", 0.02, 2, _JOINTS, rewards.ball_in_cup, starts.ball_in_cup,
        (
            ("ball_x", "m", "qpos/ball_x", 0.4),
            ("ball_z", "m", "qpos/ball_z", 0.8),
        ),
        "cam0",
    ),
    "cartpole": Recipe(
        "cartpole", 0.01, 4, _JOINTS, rewards.cartpole, starts.pole_down,
        (
            ("cart_position", "m", "qpos/slider", 2.0),
            ("pole_rate", "rad/s", "qvel/hinge_1", 15.0),
        ),
        "fixed", "qpos/hinge_1",
        task_starts=((starts.pole_up, ("balance", "balance-sparse")),),
    ),
    "cheetah": Recipe(
        "cheetah", 0.01, 4, _SPEED, rewards.cheetah, starts.limited_joints,
        _RUNNING, "side", "qpos/rooty", settle_time=2.0,
    ),
    "finger": Recipe(
        "finger", 0.02, 2, _JOINTS, rewards.finger, starts.joints_without_contact,
        _SPINNING, "cam0", "qpos/hinge", constants=starts.finger_target,
    ),
    "finger-spin": Recipe(
        "finger", 0.02, 2, _JOINTS, rewards.finger_spin, starts.joints_without_contact,
        _SPINNING, "cam0", "qpos/hinge",
    ),
    "hopper": Recipe(
        "hopper", 0.02, 2, (*_SPEED, "xipos/torso.z", "xipos/foot.z"), rewards.hopper,
        starts.joints, _RUNNING, "cam0", "qpos/rooty",
    ),
    "pendulum": Recipe(
        "pendulum", 0.02, 2, _JOINTS, rewards.pendulum, starts.joints,
        (
            ("rate", "rad/s", "qvel/hinge", 10.0),
            ("angle", "rad", "qpos/hinge", 10.0),
        ),
        "fixed", "qpos/hinge",
    ),
    "quadruped": Recipe(
        "quadruped", 0.02, 2, (*DEFAULT, "sensordata/velocimeter"), rewards.quadruped,
        starts.any_orientation,
        (
            ("velocity", "m/s", "sensordata/velocimeter.x", 5.0),
            ("yaw_rate", "rad/s", "qvel/root.wz", 8.0),
        ),
        "x",
    ),
    "reacher": Recipe(
        "reacher", 0.02, 2, _JOINTS, rewards.reacher, starts.joints,
        (
            ("wrist_angle", "rad", "qpos/wrist", 3.0),
            ("shoulder_rate", "rad/s", "qvel/shoulder", 10.0),
        ),
        "fixed", constants=starts.reacher_target,
    ),
    "walker": Recipe(
        "walker", 0.025, 2, _SPEED, rewards.walker, starts.joints,
        _RUNNING, "side", "qpos/rooty",
    ),
}  # fmt: skip
"""By the name behind `dmc/`."""


def dmc(name: str, backend: str = "mujoco") -> Robot:
    """Builds one domain.

    Args:
      name: of DOMAINS.
      backend: as `mujoco_env` takes it.

    Raises:
      ImportError: without dm_control; it names the extra.
      ValueError: for a backend that is none.
    """
    recipe = DOMAINS[name]
    model = load_model(recipe.file)
    if name == "finger-spin":
        model.dof_damping[model.joint("hinge").dofadr] = 0.03
    return build(f"dmc/{name}", model, recipe, backend)
