"""What an imagined candidate is worth: its rewards, until it ends, as one number."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_callable, check_scalar
from jaxpets._src.types import RewardFn

# `(params, path [H+1, E, N, P, D], actions [H, N, A]) -> [N]`: in the order of time.
ReturnsFn = Callable[[Any, Array, Array], Array]


def checked_reward(reward_fn: RewardFn, name: str = "reward_fn") -> RewardFn:
    """Returns reward_fn with a check, when traced, of what it returns."""
    check_callable(name, reward_fn)

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        particles = obs.shape[:-1]
        reward = reward_fn(params, obs, action, next_obs)
        if not hasattr(reward, "dtype") and not isinstance(reward, (int, float)):
            kind = type(reward).__name__
            raise TypeError(f"{name} must return an array, got {kind}.")
        reward = jnp.asarray(reward)
        if reward.dtype != jnp.float32:
            raise TypeError(f"{name} must return float32, got {reward.dtype}.")
        if reward.shape not in ((), particles):
            raise ValueError(
                f"{name} must return shape () or {particles}, got {reward.shape}."
            )
        return reward

    return reward


def single_reward(reward_fn: RewardFn) -> Callable[[Any, Array, Array, Array], Array]:
    """Returns reward_fn of one state: `(data, obs [D], action [A], next_obs [D])`."""
    reward = checked_reward(reward_fn)

    def of_state(data: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        return jnp.mean(reward(data, obs[None, None], action, next_obs[None, None]))

    return of_state


def candidate_returns(
    reward_fn: RewardFn,
    terminal_fn: Callable[[Any, Array], Array] | None,
    discount: float | Array,
    risk_fn: Callable[[Array], Array] | None,
    value_fn: Callable[[Any, Array], Array] | None = None,
) -> ReturnsFn:
    """Builds the values of candidates from their paths; see `plan` for the arguments.

    Without an end, a discount, a risk and a value the particles of a step are averaged
    at once, and no reward of a particle is kept.
    """
    reward = checked_reward(reward_fn)
    discount = check_scalar("discount", discount, 0.0, 1.0)
    undiscounted = not isinstance(discount, Array) and discount == 1
    if terminal_fn is None and risk_fn is None and value_fn is None and undiscounted:
        return _mean_returns(reward)
    ends = value = None
    if terminal_fn is not None:
        ends = of_particles("terminal_fn", terminal_fn, jnp.bool_)
    if value_fn is not None:
        value = of_particles("value_fn", value_fn, jnp.float32)
    risk = jnp.mean if risk_fn is None else _checked_risk(risk_fn)

    def every(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        # A set that is already reduced is worth the same to each of its particles.
        step = reward(params, obs, action, next_obs)
        return jnp.broadcast_to(step, obs.shape[:-1])

    def returns(params: Any, path: Array, actions: Array) -> Array:
        rewards = _over_steps(every)(params, path[:-1], actions, path[1:])
        if value is not None:
            last = jax.vmap(value, (None, 1))(params, path[-1])
            rewards = jnp.concatenate([rewards, last[None]])
        if ends is not None:
            alive = _alive(ends, params, path[1:])
            rewards = jnp.where(alive[: rewards.shape[0]], rewards, 0.0)
        steps = jnp.arange(rewards.shape[0], dtype=jnp.float32)
        weights = jnp.asarray(discount, jnp.float32) ** steps
        return jax.vmap(risk)(jnp.sum(weights[:, None, None, None] * rewards, axis=0))

    return returns


def _over_steps(reward_fn: RewardFn) -> Callable[[Any, Array, Array, Array], Array]:
    """Maps a reward over candidates, then over time: the first two axes returned."""
    candidates = jax.vmap(reward_fn, (None, 1, 0, 1))
    return jax.vmap(candidates, (None, 0, 0, 0))


def _mean_returns(reward_fn: RewardFn) -> ReturnsFn:
    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        return jnp.mean(reward_fn(params, obs, action, next_obs))

    rewards = _over_steps(reward)

    def returns(params: Any, path: Array, actions: Array) -> Array:
        return rewards(params, path[:-1], actions, path[1:]).sum(0)

    return returns


def _alive(ends: Callable[[Any, Array], Array], params: Any, next_obs: Array) -> Array:
    """Tells `[H+1, N, E, P]` which steps earn: those before which nothing has ended.

    The last is what comes after the horizon.
    """
    ended = jax.vmap(jax.vmap(ends, (None, 1)), (None, 0))(params, next_obs)
    ended = jax.lax.cummax(ended.astype(jnp.int32)) > 0
    start = jnp.zeros((1, *ended.shape[1:]), bool)
    return ~jnp.concatenate([start, ended])


def of_particles(
    name: str, function: Callable[[Any, Array], Array], dtype: Any
) -> Callable[[Any, Array], Array]:
    """Returns a function with a check, when traced, of what it says of each particle.

    What it says of all of them at once is said of each.
    """
    check_callable(name, function)

    def of_each(params: Any, obs: Array) -> Array:
        particles = obs.shape[:-1]
        result = jnp.asarray(function(params, obs))
        if result.dtype != dtype or result.shape not in ((), particles):
            shapes = f"() or {particles}" if particles else "()"
            raise ValueError(
                f"{name} must return {jnp.dtype(dtype)} of shape {shapes}, "
                f"got {result.dtype}{list(result.shape)}."
            )
        return jnp.broadcast_to(result, particles)

    return of_each


def _checked_risk(risk_fn: Callable[[Array], Array]) -> Callable[[Array], Array]:
    check_callable("risk_fn", risk_fn)

    def risk(returns: Array) -> Array:
        value = risk_fn(returns)
        check_array("risk_fn's result", value, [])
        return value

    return risk
