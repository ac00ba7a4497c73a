"""Gymnasium's robots on MuJoCo, version 5, with their rewards and some tasks of ours.

Models, control steps and starts are those of the installed gymnasium. What differs:

- An action is held for several control steps where these are short, so that a decision
  takes about 0.04 s; a step earns as many rewards of the state that was reached.
- An observation is positions, velocities and what a reward needs.
- Nothing ends a trial; a reward for health is earned while it lasts, and again later.
- The target of Reacher is a constant of the trial, and nothing in its physics.
- Ant and Humanoid have no cost of contacts. A quaternion is made unit at the start.
"""

import importlib.resources
from collections.abc import Mapping
from typing import Any

from jaxpets.envs import gym_rewards as rewards
from jaxpets.envs import gym_starts as starts
from jaxpets.envs import half_cheetah
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.mujoco_env import load_model
from jaxpets.envs.observations import DEFAULT
from jaxpets.envs.recipe import Recipe, build
from jaxpets.envs.robot import Robot

_PLANAR = (
    ("velocity", "m/s", "mean_qvel/rootx", 8.0),
    ("pitch_rate", "rad/s", "qvel/rooty", 15.0),
)
_ARM = ("qpos/joint0", "qpos/joint1", "qvel/joint0", "qvel/joint1")
_WALKING = (
    ("velocity", "m/s", "mean_qvel/root.x", 5.0),
    ("yaw_rate", "rad/s", "qvel/root.wz", 8.0),
)

ROBOTS: Mapping[str, Recipe] = {
    "Ant-v5": Recipe(
        "ant", 0.05, 1, DEFAULT, rewards.ant, starts.noise(0.1, std=0.1), _WALKING,
        "track",
    ),
    "HalfCheetah-v5": Recipe(
        "half_cheetah", 0.05, 1, DEFAULT, rewards.half_cheetah,
        starts.noise(0.1, std=0.1), _PLANAR, "track", "qpos/rooty",
    ),
    "Hopper-v5": Recipe(
        "hopper", 0.008, 5, DEFAULT, rewards.hopper, starts.noise(0.005), _PLANAR,
        "track", "qpos/rooty",
    ),
    "Humanoid-v5": Recipe(
        "humanoid", 0.015, 3, (*DEFAULT, "subtree_linvel/torso.x"), rewards.humanoid,
        starts.noise(0.01), _WALKING, "track",
    ),
    "InvertedPendulum-v5": Recipe(
        "inverted_pendulum", 0.04, 1, DEFAULT, rewards.inverted_pendulum,
        starts.noise(0.01),
        (
            ("cart_position", "m", "qpos/slider", 1.0),
            ("pole_angle", "rad", "qpos/hinge", 1.6),
        ),
    ),
    "Pusher-v5": Recipe(
        "pusher_v5", 0.05, 1, (*starts.PUSHER, "xpos/tips_arm"),
        rewards.pusher, starts.pusher,
        (
            ("object_x", "m", "qpos/obj_slidex", 0.5),
            ("object_y", "m", "qpos/obj_slidey", 0.5),
        ),
    ),
    "Reacher-v5": Recipe(
        "reacher", 0.02, 2, _ARM, rewards.reacher, starts.reacher,
        (
            ("elbow_angle", "rad", "qpos/joint1", 3.0),
            ("shoulder_rate", "rad/s", "qvel/joint0", 15.0),
        ),
        constants=starts.reacher_target,
    ),
    "Swimmer-v5": Recipe(
        "swimmer", 0.04, 1, DEFAULT, rewards.swimmer, starts.noise(0.1),
        (
            ("velocity", "m/s", "mean_qvel/slider1", 2.0),
            ("yaw_rate", "rad/s", "qvel/free_body_rot", 5.0),
        ),
        "track", "qpos/free_body_rot",
    ),
    "Walker2d-v5": Recipe(
        "walker2d_v5", 0.008, 5, DEFAULT, rewards.walker2d, starts.noise(0.005),
        _PLANAR, "track", "qpos/rooty",
    ),
}  # fmt: skip
"""By the name behind `gym/`."""


def gym(name: str, backend: str = "mujoco") -> Robot:
    """Builds one robot.

    Args:
      name: of ROBOTS.
      backend: as `mujoco_env` takes it.

    Raises:
      ImportError: without gymnasium; it names the extra.
      ValueError: for a backend that is none, or cannot step the model.
    """
    recipe = ROBOTS[name]
    return build(f"gym/{name}", _model(recipe.file), recipe, backend)


def _model(file: str) -> Any:
    if file == "half_cheetah":  # whose mass needs care
        return half_cheetah.load_model()
    # By way of the package: its module of MuJoCo environments imports a renderer.
    with needs_extra():
        assets = importlib.resources.files("gymnasium") / "envs/mujoco/assets"
    return load_model((assets / f"{file}.xml").read_text().strip())
