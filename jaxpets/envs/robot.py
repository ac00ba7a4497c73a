"""A robot with what can be asked of it: environment, model coordinates and tasks."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_callable, check_text
from jaxpets._src.types import Env, EnvState, ModelSpace, RewardFn


class Tasks(NamedTuple):
    """Tasks of one robot, as one reward with data, so that `jax.vmap` maps over them.

    Attributes:
      names: K of them.
      reward_fn: the reward of every task, a RewardFn that also scores recorded trials,
        `[..., D]` and `[..., A]`. Its params are one row of `params`, or, where trials
        have constants, see `with_constants`.
      params: a pytree of arrays `[K, ...]`.
    """

    names: tuple[str, ...]
    reward_fn: RewardFn
    params: Any


class TrialParams(NamedTuple):
    """What a task's reward reads in a trial that has constants.

    Attributes:
      task: one row of `Tasks.params`.
      constants: `EnvState.constants`.
    """

    task: Any
    constants: Any


class Axis(NamedTuple):
    """A quantity that shows where exploration went.

    Attributes:
      name: as `velocity`.
      unit: as `m/s`.
      entry: its place in the observation.
      edges: of the bins of a histogram, increasing; the outermost bins are open.
    """

    name: str
    unit: str
    entry: int
    edges: tuple[float, ...]


class Robot(NamedTuple):
    """A named environment and what goes with it.

    Attributes:
      name: as `envs.make` takes it.
      env: the environment.
      space: coordinates in which a model sees its observations.
      tasks: what it may perform.
      axes: two quantities by which exploration is shown, or none.
      angle: the entry, unwrapped and in rad, of which net turns are counted, if any.
      model: the compiled MuJoCo model to draw it with, or None.
      qpos_fn: `(obs [T, D]) -> [T, Q]`, positions of a recorded trial to draw;
        where they are not observed those of the model at rest, or NaN; or None.
      camera: of the model, to draw it by; None for one that suits it.
      task_reset: `(a row of tasks.params, key) -> EnvState`, where trials of a task
        start; None if all of them start as `env.reset` does.
      action_repeat: control steps of the original in a step of `env`: what is known by
        its return over 1,000 control steps is tried for 1,000 over this.
      step_time: of a step of `env`, in s; videos are in real time by it.
    """

    name: str
    env: Env
    space: ModelSpace
    tasks: Tasks
    axes: tuple[Axis, Axis] | tuple[()] = ()
    angle: int | None = None
    model: Any = None
    qpos_fn: Callable[[Array], Array] | None = None
    camera: str | None = None
    task_reset: Callable[[Any, Array], EnvState] | None = None
    action_repeat: int = 1
    step_time: float = 0.05


def tasks_of(rewards: Mapping[str, RewardFn]) -> Tasks:
    """Returns tasks from a function each.

    Every call computes all of them and picks one, so that a search for any of them is
    the same program.

    Args:
      rewards: by name, `(constants, obs, action, next_obs) -> reward`, with the
        constants of the trial, or ().

    Raises:
      TypeError, ValueError: unless they are functions by name, one at least.
    """
    given: Any = rewards
    if not isinstance(given, Mapping):
        kind = type(given).__name__
        raise TypeError(f"rewards must be functions by name, got {kind}.")
    if not rewards:
        raise ValueError("rewards must have a task, got none.")
    names = tuple(rewards)
    for name in names:
        check_text("a name of rewards", name)
        check_callable(f"rewards[{name!r}]", rewards[name])

    def reward_fn(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        if action.ndim > 1:  # of a recorded trial: its steps are rewarded one by one
            steps = functools.partial(reward_fn, params)
            return jax.vmap(steps)(obs, action, next_obs)
        chosen, constants = params, ()
        if isinstance(params, TrialParams):
            chosen, constants = params
        reward = jnp.zeros((), jnp.float32)
        for i, name in enumerate(names):
            try:
                own: Any = rewards[name](constants, obs, action, next_obs)
            except IndexError as error:
                said = f"rewards[{name!r}] must read entries that there are: {error}"
                # The line that reads is a line of the caller's, which is told of it.
                raise IndexError(said).with_traceback(error.__traceback__) from error
            if own is None:
                raise TypeError(f"rewards[{name!r}] must return a reward, got None.")
            reward = jnp.where(chosen == i, own, reward)
        return reward

    return Tasks(names, reward_fn, jnp.arange(len(names), dtype=jnp.int32))


def with_constants(params: Any, constants: Any) -> Any:
    """Returns a task's params for one trial: with its constants, where it has any."""
    has_none = isinstance(constants, tuple) and not constants
    return params if has_none else TrialParams(params, constants)
