"""Trials of many planners at once: one program per device, called in chunks."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from experiments.parallel import devices
from experiments.parallel.devices import AXES, SEED, TASK, Placement
from jaxpets.envs import half_cheetah

# Called between chunks with the environment steps done; may raise to stop the run.
Tick = Callable[[int], None]


class Actors(NamedTuple):
    """Jitted functions over the same leading axes.

    start: `(keys) -> UnrollState`.
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


def explorers(
    env: jaxpets.Env, planner: jaxpets.Planner, horizon: int, length: int,
    placement: Placement,
) -> Actors:  # fmt: skip
    """Returns actors over seeds `[S]`; params and reward data are per seed."""
    start, chunk = _one(env, planner, horizon, length)
    params = jaxpets.PlanParams(P(SEED), P(SEED))
    return _actors(placement, jax.vmap(start), jax.vmap(chunk), params, SEED)


def evaluators(
    env: jaxpets.Env,
    planner: jaxpets.Planner,
    horizon: int,
    length: int,
    placement: Placement,
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
    models = P(SEED) if shared_model else P(SEED, TASK)
    params = jaxpets.PlanParams(models, P(TASK))
    return _actors(placement, starts, over_seeds, params, *AXES)


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


def _actors(
    placement: Placement, starts: Callable[..., Any], chunks: Callable[..., Any],
    params: jaxpets.PlanParams, *axes: str,
) -> Actors:  # fmt: skip
    """Returns actors over `axes`; params holds the axes of what they read."""
    every = P(*axes)
    start = devices.split(placement, starts, every, every)
    chunk = devices.split(placement, chunks, (params, every, every), every)
    return Actors(
        jax.jit(start),
        jax.jit(chunk),
        lambda keys: devices.place(placement, keys, *axes),
    )


def _one(
    env: jaxpets.Env, planner: jaxpets.Planner, horizon: int, length: int
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Returns `start` and `chunk` of one actor."""

    def chunk(
        params: jaxpets.PlanParams, key: Array, state: jaxpets.typing.UnrollState
    ) -> tuple[jaxpets.typing.UnrollState, jaxpets.Transition, Array]:
        state, transitions, plans = jaxpets.unroll(
            env, planner, params, key, state, length=length
        )
        return state, transitions, plans.value / horizon

    return functools.partial(jaxpets.start_trial, env, planner), chunk
