"""A robot from a table: what is observed, earned and drawn of a MuJoCo model."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.types import Env, EnvState, RewardFn
from jaxpets.envs.mujoco_env import ConstantsFn, mujoco_env
from jaxpets.envs.mujoco_robot import Entry, Shown, mujoco_robot
from jaxpets.envs.robot import Robot, TrialParams
from jaxpets.envs.trial_start import ResetFn

Rewards = Mapping[str, RewardFn]


class Recipe(NamedTuple):
    """What makes a robot of a model, as data.

    Attributes:
      file: of its MJCF where that comes from, without the suffix.
      control_step: in s.
      action_repeat: for how many of them an action is held.
      observe: as `mujoco_env` takes it.
      rewards: `(model, entry) -> rewards` by task, of one control step.
      start: `(model) -> ResetFn`.
      axes: as `mujoco_robot` takes them.
      camera: of the model, that follows the robot or sees all of it, if it has one.
      angle: the entry of which turns are counted, if any.
      settle_time: in s.
      constants: `(model) -> ConstantsFn`, if trials have any.
      task_starts: `(model) -> ResetFn`, and the tasks that start there instead.
    """

    file: str
    control_step: float
    action_repeat: int
    observe: tuple[str, ...]
    rewards: Callable[[Any, Entry], Rewards]
    start: Callable[[Any], ResetFn]
    axes: tuple[Shown, Shown]
    camera: str | None = None
    angle: str | None = None
    settle_time: float = 0.0
    constants: Callable[[Any], ConstantsFn] | None = None
    task_starts: tuple[tuple[Callable[[Any], ResetFn], tuple[str, ...]], ...] = ()


def build(name: str, model: Any, recipe: Recipe, backend: str = "mujoco") -> Robot:
    """Builds a robot.

    A step holds its action for `action_repeat` control steps, and earns the reward of
    the state that was reached, times as many.

    Args:
      name: as `envs.make` takes it.
      model: a compiled MuJoCo model.
      recipe: what to make of it.
      backend: as `mujoco_env` takes it.

    Raises:
      ValueError: for a backend that is none, or cannot step the model.
    """
    settings: dict[str, Any] = {
        "observe": recipe.observe,
        "control_step": recipe.control_step,
        "action_repeat": recipe.action_repeat,
        "settle_time": recipe.settle_time,
        "constants": recipe.constants(model) if recipe.constants else None,
        "backend": backend,
    }

    def tasks(entry: Entry) -> Rewards:
        found = recipe.rewards(model, entry)
        return {name: _repeated(found[name], recipe.action_repeat) for name in found}

    robot = mujoco_robot(
        name,
        model,
        tasks,
        axes=recipe.axes,
        angle=recipe.angle,
        camera=recipe.camera,
        reset=recipe.start(model),
        **settings,
    )
    elsewhere = [
        (mujoco_env(model, reset=start(model), **settings), names)
        for start, names in recipe.task_starts
    ]
    if not elsewhere:
        return robot
    task_reset = _task_reset(robot.env, robot.tasks.names, elsewhere)
    return robot._replace(task_reset=task_reset)


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
            chosen = functools.partial(jnp.where, is_there)
            state = jax.tree.map(chosen, other.reset(key), state)
        return state

    return task_reset


def _repeated(reward_fn: RewardFn, action_repeat: int) -> RewardFn:
    """Returns the reward of a step of several control steps."""

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        return action_repeat * reward_fn(params, obs, action, next_obs)

    return reward
