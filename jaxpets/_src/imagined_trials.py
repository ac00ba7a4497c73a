"""Trials of a policy that a model imagines, a few steps at a time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_key,
    check_record,
)
from jaxpets._src.filled import filled
from jaxpets._src.returns import of_particles, single_reward
from jaxpets._src.types import (
    Dataset,
    DynamicsFn,
    PlanParams,
    RewardFn,
    Transition,
)

# `(its params, key, rewards [E, B, ...], obs [E, B, D]) -> action [E, B, A]`.
PolicyFn = Callable[[Any, Array, Any, Array], Array]
# `(reward data, key) -> reward data` of one trial.
DrawFn = Callable[[Any, Array], Any]


class Imagined(NamedTuple):
    """Steps `[K, E, B, ...]`, in the order of time.

    Attributes:
      obs: before the step.
      action: taken there.
      reward: earned by it.
      next_obs: after it.
      goes_on: bool, the trial does not end there.
      counts: bool, the trial had not ended before, and the step is finite.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    goes_on: Array
    counts: Array


def imagine(
    dynamics_fn: DynamicsFn,
    reward_fn: RewardFn,
    terminal_fn: Callable[[Any, Array], Array] | None,
    policy_fn: PolicyFn,
    length: int,
) -> Callable[[Any, Any, Array, Any, Array], Imagined]:
    """Builds what imagines `length` steps of many trials.

    A trial keeps its member (TS-infinity, section 3.2 of the paper) and its reward's
    data. Where it has ended, or a step is not finite, it stays where it is.

    Args:
      dynamics_fn: the model; gets actions `[E, B, A]`.
      reward_fn: is asked about single states, `[1, 1, D]`.
      terminal_fn: `(reward data, obs [D]) -> bool []`, or None.
      policy_fn: acts.
      length: K.

    Returns:
      `(params, policy's params, key, rewards [E, B, ...], obs [E, B, D]) -> Imagined`.

    Raises:
      TypeError: if dynamics_fn or terminal_fn is no function; ValueError, when
        traced, if terminal_fn returns something else.
    """
    check_callable("dynamics_fn", dynamics_fn)
    ends = None
    if terminal_fn is not None:
        ends = jax.vmap(jax.vmap(of_particles("terminal_fn", terminal_fn, jnp.bool_)))
    one = single_reward(reward_fn)
    rewards_of = jax.vmap(jax.vmap(one))

    def run(params: Any, policy: Any, key: Array, rewards: Any, obs: Array) -> Imagined:
        def step(
            start: tuple[Array, Array], key: Array
        ) -> tuple[tuple[Array, Array], Imagined]:
            obs, alive = start
            act_key, move_key = jax.random.split(key)
            action = policy_fn(policy, act_key, rewards, obs)
            next_obs = dynamics_fn(params, move_key, obs, action)
            check_array("dynamics_fn's result", next_obs, obs.shape)
            reward = rewards_of(rewards, obs, action, next_obs)
            counts = alive & jnp.isfinite(reward)
            counts &= jnp.all(jnp.isfinite(next_obs), axis=-1)
            next_obs = jnp.where(counts[..., None], next_obs, obs)
            reward = jnp.where(counts, reward, 0.0)
            goes_on = jnp.ones(counts.shape, bool)
            if ends is not None:
                goes_on = ~ends(rewards, next_obs)
            seen = Imagined(obs, action, reward, next_obs, goes_on, counts)
            return (next_obs, counts & goes_on), seen

        alive = jnp.ones(obs.shape[:-1], bool)
        _, steps = jax.lax.scan(step, (obs, alive), jax.random.split(key, length))
        return steps

    return run


def trial_starts(
    draw: DrawFn, rows: tuple[int, int]
) -> Callable[[Any, Array, Dataset], tuple[Array, Any]]:
    """Builds what begins trials `[E, B]` in states of the data, each with its reward.

    Returns:
      `(reward data, key, dataset) -> (obs [E, B, D], reward data [E, B, ...])`.
    """
    draw_all = jax.vmap(jax.vmap(draw, (None, 0)), (None, 0))

    def starts(data: Any, key: Array, dataset: Dataset) -> tuple[Array, Any]:
        row_key, draw_key = jax.random.split(key)
        chosen = jax.random.randint(row_key, rows, 0, jnp.maximum(dataset.size, 1))
        rewards = draw_all(data, jax.random.split(draw_key, rows))
        # Of NumPy, its rows could not be picked by what is traced, outside jit.
        return jnp.asarray(dataset.data.obs)[chosen], rewards

    return starts


def over_trials(
    features: Callable[[Any], Array], rows: tuple[int, int]
) -> Callable[[Any], Array]:
    """Maps what networks see of a task over trials `[E, B]`."""

    def one(data: Any) -> Array:
        goal = features(data)
        check_array("goals.features's result", goal, ["G"])
        return goal

    # Sizes are said, as a reward may have no data to see them by.
    return jax.vmap(jax.vmap(one, axis_size=rows[1]), axis_size=rows[0])


def renewed(again: Array, fresh: Any, old: Any) -> Any:
    """Returns what trials go on from: `fresh` where they begin `again`, `[E, B]`."""

    def one(new: Array, old: Array) -> Array:
        rows = again.reshape(*again.shape, *(1,) * (old.ndim - 2))
        return jnp.where(rows, new, old)

    return jax.tree.map(one, fresh, old)


def reward_range(
    reward_fn: RewardFn, draw: DrawFn, data: Any, key: Array, dataset: Dataset
) -> tuple[Array, Array]:
    """Returns the least and the largest reward of the data, 0 among them."""
    one = single_reward(reward_fn)

    def of_row(key: Array, row: Transition) -> Array:
        return one(draw(data, key), *row)

    capacity = dataset.data.obs.shape[0]
    rewards = jax.vmap(of_row)(jax.random.split(key, capacity), dataset.data)
    used = filled(capacity, dataset.size) & jnp.isfinite(rewards)
    rewards = jnp.where(used, rewards, 0.0)
    return jnp.minimum(jnp.min(rewards), 0.0), jnp.maximum(jnp.max(rewards), 0.0)


def check_imagined(
    params: Any, key: Any, dataset: Any, obs_size: int, action_size: int
) -> None:
    """Raises unless these are what trials can be imagined with."""
    check_record("params", params, PlanParams)
    check_key("key", key)
    check_record("dataset", dataset, Dataset)
    check_array("dataset.data.obs", dataset.data.obs, ["C", obs_size])
    check_array("dataset.data.action", dataset.data.action, ["C", action_size])
