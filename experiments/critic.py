"""The actor and the critic of a task, as a config has them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from jaxpets.envs import Robot, with_constants
from jaxpets.policies import ActorCritic, ActorCriticConfig, Goals, actor_critic

from .acting import at_start
from .config import Config, part

TerminalFn = Callable[[Any, Array], Array] | None

# Gradient steps of one call of the compiled program; a signal waits for it.
_STEPS = 1000


def make_critic(
    config: Config, robot: Robot, model: jaxpets.Ensemble, terminal_fn: TerminalFn,
    goals: Goals | None = None,
) -> ActorCritic:  # fmt: skip
    """Returns the actor and the critic of a task, which imagine with this model.

    With goals they are of all tasks that these draw.
    """
    settings, env = config.critic, robot.env
    count, steps = calls(config)
    rate = optax.cosine_decay_schedule(
        settings.learning_rate, count * steps, alpha=0.05
    )
    numbers = part(settings, ActorCriticConfig)
    return actor_critic(
        model.sample,
        robot.tasks.reward_fn,
        optax.adam(rate),
        dataclasses.replace(numbers, num_updates=steps),
        robot.space,
        obs_size=model.obs_size,
        action_low=env.action_low,
        action_high=env.action_high,
        num_members=model.num_members,
        goals=goals_of(robot) if goals is None else goals,
        terminal_fn=terminal_fn,
    )


def calls(config: Config) -> tuple[int, int]:
    """Returns in how many calls a critic learns, and the gradient steps of each."""
    count = -(-config.critic.num_updates // _STEPS)
    return count, -(-config.critic.num_updates // count)


def goals_of(robot: Robot) -> Goals:
    """Returns what is drawn for a trial of a task, which its networks have to see."""
    start = jax.eval_shape(robot.env.reset, jax.random.key(0))
    if not jax.tree.leaves(start.constants):
        return Goals()

    def draw(task: Any, key: Array) -> Any:
        return with_constants(task, at_start(robot, task).reset(key).constants)

    def features(task: Any) -> Array:
        leaves = jax.tree.leaves(task.constants)
        return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in leaves])

    return Goals(draw, features)
