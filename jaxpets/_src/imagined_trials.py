"""Trials of a policy that a model imagines, a few steps at a time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array
from jaxpets._src.returns import single_reward
from jaxpets._src.types import DynamicsFn, RewardFn

# `(its params, key, rewards [E, B, ...], obs [E, B, D]) -> action [E, B, A]`.
PolicyFn = Callable[[Any, Array, Any, Array], Array]


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
    """
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
            if terminal_fn is not None:
                goes_on = ~jax.vmap(jax.vmap(terminal_fn))(rewards, next_obs)
            seen = Imagined(obs, action, reward, next_obs, goes_on, counts)
            return (next_obs, counts & goes_on), seen

        alive = jnp.ones(obs.shape[:-1], bool)
        _, steps = jax.lax.scan(step, (obs, alive), jax.random.split(key, length))
        return steps

    return run
