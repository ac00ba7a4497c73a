"""Environments; these modules need the extra `jaxpets[envs]`."""

from jaxpets.envs.adapters import env_rollout, from_brax
from jaxpets.envs.mujoco_env import mujoco_env
from jaxpets.envs.mujoco_robot import mujoco_robot
from jaxpets.envs.named import make, names, registries
from jaxpets.envs.robot import Axis, Robot, Tasks, tasks_of, with_constants

__all__ = [
    "Axis",
    "Robot",
    "Tasks",
    "env_rollout",
    "from_brax",
    "make",
    "mujoco_env",
    "mujoco_robot",
    "names",
    "registries",
    "tasks_of",
    "with_constants",
]
