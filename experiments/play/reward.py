"""The reward that plans are made for, as data: a change of it acts on the next plan.

One compiled program plans for the robot's own tasks, for typed formulas, and for the
disagreement that exploration seeks.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from jaxpets import formulas, rewards
from jaxpets.envs import Robot, with_constants

TASK, FORMULA, EXPLORE = 0, 1, 2


class RewardChoice(NamedTuple):
    """The params of `reward_of`.

    Attributes:
      kind: `[]` int32, TASK, FORMULA or EXPLORE.
      task: a row of the robot's `Tasks.params`; with the constants of the trial, where
        it has any.
      formula: a `jaxpets.formulas.Formula`.
      base: `[D]`, the variance that disagreement is measured in.
    """

    kind: Array
    task: Any
    formula: formulas.Formula
    base: Array


def reward_of(
    robot: Robot, explore: jaxpets.typing.RewardFn = rewards.epistemic
) -> jaxpets.typing.RewardFn:
    """Returns the reward that plans are made for; its params are a RewardChoice.

    Args:
      robot: whose tasks may be chosen.
      explore: what exploration seeks; its params are `RewardChoice.base`.
    """

    def reward(
        choice: RewardChoice, obs: Array, action: Array, next_obs: Array
    ) -> Array:
        step, shape = (obs, action, next_obs), next_obs.shape[:-1]
        branches = (
            lambda: robot.tasks.reward_fn(choice.task, *step),
            lambda: formulas.reward(choice.formula, *step),
            lambda: explore(choice.base, *step),
        )
        spread = [lambda f=f: jnp.broadcast_to(f(), shape) for f in branches]
        return jax.lax.switch(choice.kind, spread)

    return reward


def earned_of(robot: Robot) -> jaxpets.typing.RewardFn:
    """Returns what a real step `[D]` earns; NaN where disagreement is sought."""
    return reward_of(robot, lambda *_: jnp.float32(jnp.nan))


def bound(choice: RewardChoice, constants: Any) -> RewardChoice:
    """Returns a choice for one trial, whose constants a task may read."""
    return choice._replace(task=with_constants(choice.task, constants))
