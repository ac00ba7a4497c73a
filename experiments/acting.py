"""Trials of many planners at once: one jitted program, called in chunks."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from jaxpets.envs import half_cheetah

# Called between chunks with the environment steps done; may raise to stop the run.
Tick = Callable[[int], None]


class Actors(NamedTuple):
    """Jitted functions over the same leading axes.

    start: `(keys) -> UnrollState`.
    chunk: `(PlanParams, keys, UnrollState) -> (UnrollState, Transition, values)`.
    """

    start: Callable[..., Any]
    chunk: Callable[..., Any]


class Trials(NamedTuple):
    """What happened, with the leading axes of the actors."""

    transitions: jaxpets.Transition  # [..., T, *]
    values: Array  # [..., T], predicted reward per imagined step


def explorers(
    env: jaxpets.Env, planner: jaxpets.Planner, horizon: int, length: int
) -> Actors:
    """Returns actors over seeds `[S]`; params and reward data are per seed."""
    start, chunk = _one(env, planner, horizon, length)
    return Actors(jax.jit(jax.vmap(start)), jax.jit(jax.vmap(chunk)))


def performers(
    env: jaxpets.Env,
    planner: jaxpets.Planner,
    horizon: int,
    length: int,
    *,
    shared_model: bool,
) -> Actors:
    """Returns actors over seeds, tasks and trials `[S, K, R]`.

    The task's weights are `[K]`. The model is `[S]` where all tasks share it, else
    `[S, K]`.
    """
    start, chunk = _one(env, planner, horizon, length)
    model = None if shared_model else 0
    over_trials = jax.vmap(chunk, (None, 0, 0))
    over_tasks = jax.vmap(over_trials, (jaxpets.PlanParams(model, 0), 0, 0))
    over_seeds = jax.vmap(over_tasks, (jaxpets.PlanParams(0, None), 0, 0))
    starts = jax.vmap(jax.vmap(jax.vmap(start)))
    return Actors(jax.jit(starts), jax.jit(over_seeds))


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
      keys: one per actor; consumed.
      num_chunks: calls that make a trial.
      tick: called after every chunk with the steps of one actor.
    """
    reset_keys, act_keys = split_keys(keys)
    state = actors.start(reset_keys)
    chunks = []
    for _ in range(num_chunks):
        state, transitions, values = actors.chunk(params, act_keys, state)
        jax.block_until_ready(values)
        chunks.append(Trials(transitions, values))
        tick(values.shape[-1])
    time = keys.ndim
    return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=time), *chunks)


def split_keys(keys: Array) -> tuple[Array, Array]:
    """Splits every key of `[...]` in two, and returns the firsts and the seconds."""
    pairs = jax.vmap(jax.random.split)(keys.reshape(-1)).reshape(*keys.shape, 2)
    return pairs[..., 0], pairs[..., 1]


@jax.jit
def score(transitions: jaxpets.Transition) -> tuple[Array, Array]:
    """Returns the returns under the four tasks `[..., 4]` and the net turns `[...]`."""
    reward_fn = jax.vmap(half_cheetah.task_reward, (0, None, None, None), -1)
    rewards = reward_fn(half_cheetah.tasks(), *transitions)
    pitch = transitions.next_obs[..., half_cheetah.PITCH]
    turns = (pitch[..., -1] - pitch[..., 0]) / (2 * jnp.pi)
    return jnp.sum(rewards, axis=-2), turns


def _one(
    env: jaxpets.Env, planner: jaxpets.Planner, horizon: int, length: int
) -> Actors:
    def chunk(
        params: jaxpets.PlanParams, key: Array, state: jaxpets.UnrollState
    ) -> tuple[jaxpets.UnrollState, jaxpets.Transition, Array]:
        state, transitions, plans = jaxpets.unroll(
            env, planner, params, key, state, length=length
        )
        return state, transitions, plans.value / horizon

    return Actors(functools.partial(jaxpets.start, env, planner), chunk)
