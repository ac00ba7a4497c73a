"""The actor and the critic of a task, as a config has them, and how they learn."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Robot, with_constants
from jaxpets.policies import (
    ActorCritic,
    ActorCriticConfig,
    ActorCriticParams,
    Goals,
    actor_critic,
)

from . import acting
from .acting import at_start
from .config import CriticConfig, part
from .parallel import devices
from .parallel.devices import Placement
from .storage.folder import RunFolder

TerminalFn = Callable[[Any, Array], Array] | None

# Gradient steps of one call of the compiled program; a signal waits for it.
_STEPS = 1000


class Several(NamedTuple):
    """Critics that learn side by side, and what each of them has for itself.

    Attributes:
      name: of one of them, as it is said.
      axes: of all, as `devices.AXES` calls them.
      known: which of these PlanParams have, as PartitionSpecs.
      data: which the data have.
    """

    name: str
    axes: tuple[str, ...]
    known: Any
    data: Any


def make_critic(
    settings: CriticConfig, robot: Robot, model: jaxpets.Ensemble,
    terminal_fn: TerminalFn,
    goals: Goals | None = None,
) -> ActorCritic:  # fmt: skip
    """Returns the actor and the critic of a task, which imagine with this model.

    With goals they are of all tasks that these draw.
    """
    env = robot.env
    count, steps = calls(settings)
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


def over(several: Several, function: Any, takes: tuple[Any, ...]) -> Any:
    """Maps what one critic takes over all of them."""
    for axis in reversed(several.axes):
        function = acting.over(function, takes, axis)
    return function


def learned(
    settings: CriticConfig, critic: ActorCritic, several: Several, placement: Placement,
    params: jaxpets.PlanParams, keys: Array, dataset: jaxpets.typing.Dataset,
    run: RunFolder,
) -> ActorCriticParams:  # fmt: skip
    """Returns the networks of critics that have learned, and tells the run.

    Args:
      settings: of a critic.
      critic: as `make_critic` returns it.
      several: of how many.
      placement: of them; params, keys and data are placed.
      params: models, and the params of tasks.
      keys: of all axes.
      dataset: where imagined trials begin.
      run: that is told.
    """
    every = P(*several.axes)

    def program(function: Any, takes: Any, gives: Any, **options: Any) -> Any:
        split = devices.split(placement, over(several, function, takes), takes, gives)
        return jax.jit(split, **options)

    takes = (several.known, every, several.data)
    init = program(critic.init, takes, every)
    takes = (several.known, every, every, several.data)
    learn = program(critic.step, takes, (every, every), donate_argnums=2)
    begin = time.monotonic()
    keys, now = acting.split_keys(keys)
    state = init(params, now, dataset)
    count, updates = calls(settings)
    skipped: Any = 0
    for _ in range(count):
        keys, now = acting.split_keys(keys)
        state, metrics = learn(params, now, state, dataset)
        jax.block_until_ready(state)
        skipped += metrics.num_skipped
    value, skipped, networks = devices.collect(
        placement, (metrics.value, skipped, state.params), *several.axes
    )
    earned = float(jnp.mean(value)) * (1 - settings.discount)
    run.say(
        f"{several.name}: {count * updates:,} gradient steps; its actor expects "
        f"{earned:.3f} a step  {time.monotonic() - begin:.1f} s"
    )
    if lost := int(jnp.sum(skipped)):
        run.say(
            f"warning: {lost:,} gradient steps of {several.name} were not finite: "
            "left out"
        )
    return networks


def calls(settings: CriticConfig) -> tuple[int, int]:
    """Returns in how many calls a critic learns, and the gradient steps of each."""
    count = -(-settings.num_updates // _STEPS)
    return count, -(-settings.num_updates // count)


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
