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

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.coordinates import index, space
from jaxpets._src.types import Coordinate, Env, EnvState, RewardFn
from jaxpets.envs import dmc_rewards as rewards
from jaxpets.envs import dmc_starts as starts
from jaxpets.envs.dmc_model import load_model
from jaxpets.envs.mujoco_env import ConstantsFn, ResetFn, mujoco_env
from jaxpets.envs.observations import DEFAULT
from jaxpets.envs.robot import Axis, Robot, TrialParams, tasks_of
from jaxpets.envs.tracks import qpos_fn

_SPEED = (*DEFAULT, "sensordata/torso_subtreelinvel.x")
_JOINTS = ("qpos", "qvel")


class Domain(NamedTuple):
    """One domain as data.

    Attributes:
      file: of its MJCF in dm_control, without the suffix.
      control_step: of dm_control, in s.
      action_repeat: for how many of them an action is held.
      observe: as `mujoco_env` takes it.
      rewards: `(model, entry) -> rewards` by task, in [0, 1] per control step.
      start: `(model) -> ResetFn`.
      axes: name, unit, entry, and the ends of a histogram's bins, of two quantities.
      camera: of the model, that follows the robot or sees all of it.
      angle: the entry of which turns are counted, if any.
      settle_time: in s.
      constants: `(model) -> ConstantsFn`, if trials have any.
      task_starts: `(model) -> ResetFn`, and the tasks that start there instead.
    """

    file: str
    control_step: float
    action_repeat: int
    observe: tuple[str, ...]
    rewards: Callable[[Any, rewards.Entry], rewards.Rewards]
    start: Callable[[Any], ResetFn]
    axes: tuple[tuple[str, str, str, float], tuple[str, str, str, float]]
    camera: str
    angle: str | None = None
    settle_time: float = 0.0
    constants: Callable[[Any], ConstantsFn] | None = None
    task_starts: tuple[tuple[Callable[[Any], ResetFn], tuple[str, ...]], ...] = ()


_RUNNING = (
    ("velocity", "m/s", "sensordata/torso_subtreelinvel.x", 8.0),
    ("pitch_rate", "rad/s", "qvel/rooty", 15.0),
)
_SPINNING = (
    ("spinner_rate", "rad/s", "qvel/hinge", 20.0),
    ("proximal_angle", "rad", "qpos/proximal", 2.0),
)

DOMAINS: Mapping[str, Domain] = {
    "acrobot": Domain(
        "acrobot", 0.01, 4, _JOINTS, rewards.acrobot, starts.joints,
        (
            ("shoulder_rate", "rad/s", "qvel/shoulder", 10.0),
            ("elbow_rate", "rad/s", "qvel/elbow", 20.0),
        ),
        "fixed", "qpos/shoulder",
    ),
    "ball_in_cup": Domain(
        "ball_in_cup", 0.02, 2, _JOINTS, rewards.ball_in_cup, starts.ball_in_cup,
        (
            ("ball_x", "m", "qpos/ball_x", 0.4),
            ("ball_z", "m", "qpos/ball_z", 0.8),
        ),
        "cam0",
    ),
    "cartpole": Domain(
        "cartpole", 0.01, 4, _JOINTS, rewards.cartpole, starts.pole_down,
        (
            ("cart_position", "m", "qpos/slider", 2.0),
            ("pole_rate", "rad/s", "qvel/hinge_1", 15.0),
        ),
        "fixed", "qpos/hinge_1",
        task_starts=((starts.pole_up, ("balance", "balance-sparse")),),
    ),
    "cheetah": Domain(
        "cheetah", 0.01, 4, _SPEED, rewards.cheetah, starts.limited_joints,
        _RUNNING, "side", "qpos/rooty", settle_time=2.0,
    ),
    "finger": Domain(
        "finger", 0.02, 2, _JOINTS, rewards.finger, starts.joints_without_contact,
        _SPINNING, "cam0", "qpos/hinge", constants=starts.finger_target,
    ),
    "finger-spin": Domain(
        "finger", 0.02, 2, _JOINTS, rewards.finger_spin, starts.joints_without_contact,
        _SPINNING, "cam0", "qpos/hinge",
    ),
    "hopper": Domain(
        "hopper", 0.02, 2, (*_SPEED, "xipos/torso.z", "xipos/foot.z"), rewards.hopper,
        starts.joints, _RUNNING, "cam0", "qpos/rooty",
    ),
    "pendulum": Domain(
        "pendulum", 0.02, 2, _JOINTS, rewards.pendulum, starts.joints,
        (
            ("rate", "rad/s", "qvel/hinge", 10.0),
            ("angle", "rad", "qpos/hinge", 10.0),
        ),
        "fixed", "qpos/hinge",
    ),
    "quadruped": Domain(
        "quadruped", 0.02, 2, (*DEFAULT, "sensordata/velocimeter"), rewards.quadruped,
        starts.any_orientation,
        (
            ("velocity", "m/s", "sensordata/velocimeter.x", 5.0),
            ("yaw_rate", "rad/s", "qvel/root.wz", 8.0),
        ),
        "x",
    ),
    "reacher": Domain(
        "reacher", 0.02, 2, _JOINTS, rewards.reacher, starts.joints,
        (
            ("wrist_angle", "rad", "qpos/wrist", 3.0),
            ("shoulder_rate", "rad/s", "qvel/shoulder", 10.0),
        ),
        "fixed", constants=starts.reacher_target,
    ),
    "walker": Domain(
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
    domain = DOMAINS[name]
    model = load_model(domain.file)
    if name == "finger-spin":
        model.dof_damping[model.joint("hinge").dofadr] = 0.03

    def env_of(start: Callable[[Any], ResetFn]) -> Env:
        return mujoco_env(
            model,
            observe=domain.observe,
            control_step=domain.control_step,
            action_repeat=domain.action_repeat,
            reset=start(model),
            settle_time=domain.settle_time,
            constants=domain.constants(model) if domain.constants else None,
            backend=backend,
        )

    env = env_of(domain.start)
    rows = env.coordinates
    found = domain.rewards(model, lambda entry: index(rows, entry))
    elsewhere = [(env_of(start), tasks) for start, tasks in domain.task_starts]

    step_time = domain.control_step * domain.action_repeat
    first, second = (_axis(rows, *axis) for axis in domain.axes)
    return Robot(
        name=f"dmc/{name}",
        env=env,
        space=space(rows),
        tasks=tasks_of(
            {task: _repeated(found[task], domain.action_repeat) for task in found}
        ),
        axes=(first, second),
        angle=index(rows, domain.angle) if domain.angle else None,
        model=model,
        qpos_fn=qpos_fn(model, rows, step_time),
        camera=domain.camera,
        task_reset=_task_reset(env, tuple(found), elsewhere) if elsewhere else None,
    )


def _task_reset(
    env: Env, names: tuple[str, ...], elsewhere: Sequence[tuple[Env, tuple[str, ...]]]
) -> Callable[[Any, Array], EnvState]:
    """Returns how trials of a task start, as `Robot.task_reset`."""

    def task_reset(params: Any, key: Array) -> EnvState:
        task = params.task if isinstance(params, TrialParams) else params
        state = env.reset(key)
        for other, tasks in elsewhere:
            numbers = np.array([names.index(name) for name in tasks], np.int32)
            is_there = jnp.isin(task, numbers)
            state = _where(is_there, other.reset(key), state)
        return state

    return task_reset


def _where(condition: Array, a: EnvState, b: EnvState) -> EnvState:
    def pick(x: Array, y: Array) -> Array:
        return jnp.where(condition, x, y)

    return jax.tree.map(pick, a, b)


def _repeated(reward_fn: RewardFn, action_repeat: int) -> RewardFn:
    """Returns the reward of a step of several control steps."""

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        return action_repeat * reward_fn(params, obs, action, next_obs)

    return reward


def _axis(
    rows: tuple[Coordinate, ...], name: str, unit: str, entry: str, end: float
) -> Axis:
    edges = tuple(end * i / 15 for i in range(-15, 16))
    return Axis(name, unit, index(rows, entry), edges)
