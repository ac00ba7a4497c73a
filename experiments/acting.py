"""Trials of many planners at once: one program per device, called in chunks."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Robot, with_constants
from jaxpets.policies import Guided

from .parallel import devices
from .parallel.devices import AXES, SEED, TASK, Placement

# Called between chunks with the environment steps done; may raise to stop the run.
Tick = Callable[[int], None]
# `(reward data, constants of a trial) -> reward data` for that trial.
Bind = Callable[[Any, Any], Any]


class Actors(NamedTuple):
    """Jitted functions over the same leading axes.

    start: `(reward data, keys) -> UnrollState`.
    chunk: `(PlanParams, keys, UnrollState) -> (UnrollState, Transition, values)`.
    place: `(keys) -> keys`, takes those of all actors to where each of them acts.
    """

    start: Callable[..., Any]
    chunk: Callable[..., Any]
    place: Callable[[Array], Array]


class Trials(NamedTuple):
    """What happened, with the leading axes of the actors."""

    transitions: jaxpets.Transition  # [..., T, *]
    values: Array  # [..., T], predicted reward per imagined step
    constants: Any = ()  # [...], as in an EnvState


class Score(NamedTuple):
    """What trials were worth until they ended, or physics diverged.

    returns: `[..., K]`.
    turns: `[...]`, or None for a robot of which none are counted.
    num_steps: `[...]` int32, those before physics diverged.
    """

    returns: Array
    turns: Array | None
    num_steps: Array


class Scorer(NamedTuple):
    """What trials were worth.

    names: of the K tasks.
    score: `(transitions [..., T, *], constants [...]) -> Score`.
    """

    names: tuple[str, ...]
    score: Callable[[jaxpets.Transition, Any], Score]


def explorers(
    env: jaxpets.Env, planner: jaxpets.Planner, horizon: float, length: int,
    placement: Placement, bind: Bind = lambda data, constants: data,
) -> Actors:  # fmt: skip
    """Returns actors over seeds `[S]`; params and reward data are per seed."""
    start, chunk = _one(lambda _: env, planner, horizon, length, bind)
    params = jaxpets.PlanParams(P(SEED), P(SEED))
    return _actors(placement, jax.vmap(start), jax.vmap(chunk), params, SEED)


def evaluators(
    robot: Robot,
    planner: jaxpets.Planner,
    horizon: float,
    length: int,
    placement: Placement,
    params: jaxpets.PlanParams,
) -> Actors:
    """Returns actors over seeds, tasks and trials `[S, K, R]`.

    Args:
      robot: that acts.
      planner: not jitted; its reward data are the params of a task, or Guided.
      horizon: steps that the value of a plan is the sum of.
      length: steps of a chunk.
      placement: of the actors.
      params: which of these axes the leaves of PlanParams have, as PartitionSpecs.
    """

    def env_of(data: Any) -> jaxpets.Env:
        return at_start(robot, _task(data))

    def bind(data: Any, constants: Any) -> Any:
        if isinstance(data, Guided):
            return data._replace(reward=with_constants(data.reward, constants))
        return with_constants(data, constants)

    start, chunk = _one(env_of, planner, horizon, length, bind)
    starts, chunks = jax.vmap(start, (None, 0)), jax.vmap(chunk, (None, 0, 0))
    every = P(*AXES)
    for axis in (TASK, SEED):
        starts = over(starts, (params.reward, every), axis)
        chunks = over(chunks, (params, every, every), axis)
    return _actors(placement, starts, chunks, params, *AXES)


def over(function: Callable[..., Any], takes: Any, axis: str) -> Callable[..., Any]:
    """Maps over the leading axis of what has this axis.

    Args:
      function: not jitted.
      takes: a prefix of the arguments' pytree: PartitionSpecs.
      axis: of AXES; those after it are mapped already.
    """
    axes = jax.tree.map(lambda spec: 0 if axis in spec else None, takes)
    return jax.vmap(function, axes)


def run(
    actors: Actors,
    params: jaxpets.PlanParams,
    keys: Array,
    num_chunks: int,
    tick: Tick,
) -> Trials:
    """Runs one trial of every actor.

    Args:
      actors: what to call.
      params: forwarded.
      keys: one per actor, of all hosts; consumed.
      num_chunks: calls that make a trial.
      tick: called after every chunk with the steps of one actor.

    Returns:
      The trials of this host's actors, on its devices.
    """
    reset_keys, act_keys = map(actors.place, split_keys(keys))
    state = actors.start(params.reward, reset_keys)
    drawn = state.env.constants  # until a trial ends and another begins
    chunks = []
    for _ in range(num_chunks):
        state, transitions, values = actors.chunk(params, act_keys, state)
        jax.block_until_ready(values)
        chunks.append((transitions, values))
        tick(values.shape[-1])
    time = keys.ndim
    transitions, values = jax.tree.map(
        lambda *parts: jnp.concatenate(parts, axis=time), *chunks
    )
    return Trials(transitions, values, drawn)


def constants(robot: Robot, tasks: Any, keys: Array) -> Any:
    """Returns what is drawn for trials `[S, K, R]` of tasks `[K]`, as `run` has it."""

    def drawn(task: Any, key: Array) -> Any:
        return at_start(robot, task).reset(key).constants

    of_task = jax.vmap(jax.vmap(drawn, (None, 0)))
    return jax.jit(jax.vmap(of_task, (None, 0)))(tasks, split_keys(keys)[0])


def at_start(robot: Robot, task: Any) -> jaxpets.Env:
    """Returns the environment as it starts trials of one task."""
    if robot.task_reset is None:
        return robot.env
    return robot.env._replace(reset=functools.partial(robot.task_reset, task))


def _task(data: Any) -> Any:
    """Returns the params of the task that reward data are about."""
    return data.reward if isinstance(data, Guided) else data


def split_keys(keys: Array) -> tuple[Array, Array]:
    """Splits every key of `[...]` in two, and returns the firsts and the seconds."""
    pairs = jax.vmap(jax.random.split)(keys.reshape(-1)).reshape(*keys.shape, 2)
    return pairs[..., 0], pairs[..., 1]


def scorer(robot: Robot) -> Scorer:
    """Returns what scores trials of a robot; jitted once for all of a run.

    What comes after the first end of a trial, from a new start, does not count, nor
    what comes after physics diverged.
    """
    tasks, angle, ends = robot.tasks, robot.angle, robot.env.terminal_fn
    every = jax.tree.map(np.asarray, tasks.params)  # constants of the program

    def score(seen: jaxpets.Transition, constants: Any) -> Score:
        def reward(task: Any, obs: Array, action: Array, next_obs: Array) -> Array:
            params = with_constants(task, constants)
            return tasks.reward_fn(params, obs, action, next_obs)

        rewards = jax.vmap(reward, (0, None, None, None), -1)(every, *seen)
        num_steps = jaxpets.datasets.num_stable(seen)
        count = num_steps[..., None]
        if ends is not None:
            count = jnp.minimum(count, _num_until_end(ends, seen.next_obs)[..., None])
        counts = jnp.arange(rewards.shape[-2]) < count
        returns = jnp.sum(jnp.where(counts[..., None], rewards, 0.0), axis=-2)
        turns = None
        if angle is not None:
            path = seen.next_obs[..., angle]
            last = jnp.take_along_axis(path, jnp.maximum(count - 1, 0), axis=-1)
            turns = (last - path[..., :1])[..., 0] / (2 * jnp.pi)
        return Score(returns, turns, num_steps)

    def per_trial(seen: jaxpets.Transition, constants: Any) -> Score:
        program = score
        if jax.tree.leaves(constants):
            for _ in seen.obs.shape[:-2]:
                program = jax.vmap(program)
        return program(seen, constants)

    return Scorer(tasks.names, jax.jit(per_trial))


def _num_until_end(ends: Callable[[Array], Array], next_obs: Array) -> Array:
    """Returns how many steps `[...]` of trials there are up to the first end."""
    ended = ends(next_obs).astype(jnp.int32)
    return jnp.sum(jnp.cumsum(ended, axis=-1) == ended, axis=-1, dtype=jnp.int32)


def _actors(
    placement: Placement, starts: Callable[..., Any], chunks: Callable[..., Any],
    params: jaxpets.PlanParams, *axes: str,
) -> Actors:  # fmt: skip
    """Returns actors over `axes`; params holds the axes of what they read."""
    every = P(*axes)
    start = devices.split(placement, starts, (params.reward, every), every)
    chunk = devices.split(placement, chunks, (params, every, every), every)
    return Actors(
        jax.jit(start),
        jax.jit(chunk),
        lambda keys: devices.place(placement, keys, *axes),
    )


def _one(
    env_of: Callable[[Any], jaxpets.Env], planner: jaxpets.Planner, horizon: float,
    length: int, bind: Bind,
) -> tuple[Callable[..., Any], Callable[..., Any]]:  # fmt: skip
    """Returns `start` and `chunk` of one actor; the reward's data say where it acts."""
    planner = _bound(planner, bind)

    def start(data: Any, key: Array) -> jaxpets.typing.UnrollState:
        return jaxpets.start_trial(env_of(data), planner, key)

    def chunk(
        params: jaxpets.PlanParams, key: Array, state: jaxpets.typing.UnrollState
    ) -> tuple[jaxpets.typing.UnrollState, jaxpets.Transition, Array]:
        env = env_of(params.reward)
        state, transitions, plans = jaxpets.unroll(
            env, planner, params, key, state, length=length, observe_fn=lambda x: x
        )
        return state, transitions, plans.value / horizon

    return start, chunk


def _bound(planner: jaxpets.Planner, bind: Bind) -> jaxpets.Planner:
    """Returns a planner of an EnvState, with whose constants it binds its reward data.

    A trial may end within a chunk, and the next one has constants of its own.
    """

    def step(
        params: jaxpets.PlanParams, key: Array, state: Any, env: jaxpets.EnvState
    ) -> tuple[jaxpets.typing.PlanOutput, Any]:
        data = bind(params.reward, env.constants)
        return planner.step(params._replace(reward=data), key, state, env.obs)

    return planner._replace(step=step)
