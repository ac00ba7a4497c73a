"""Rewards that seek, or shun, what the ensemble does not know."""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_callable, check_real
from jaxpets._src.types import RewardFn


def epistemic(
    baseline_variance: Array, obs: Array, action: Array, next_obs: Array
) -> Array:
    """Disagreement of the members about where the particles are (section 3.3).

    `r = 1/D * sum_k sqrt(v[k] / w_base[k])`, where `v` is the variance over members of
    each member's mean particle. It is the spread of the propagated states, not of one
    step from a common state, so plans are rewarded for leading to the unknown later.

    Args:
      baseline_variance: `[D]`, w_base in units of obs squared; the paper takes the
        ensemble's largest aleatoric variance, see `jaxpets.rewards.max_variance`.
      obs: `[E, P, D]`, unused.
      action: `[A]`, unused; exploration has no action cost.
      next_obs: `[E, P, D]`.

    Returns:
      `[]`, without a unit.

    Raises:
      ValueError: if the shapes do not fit, or there is only one member.
    """
    del obs, action
    variance = _variance_of_means(baseline_variance, next_obs)
    return _mean(jnp.sqrt(variance / baseline_variance))


def information_gain(
    baseline_variance: Array, obs: Array, action: Array, next_obs: Array
) -> Array:
    """What seeing where the particles end up would tell about the members, in nats.

    `r = 1/D * sum_k log(1 + v[k] / w_base[k]) / 2`, with `v` and `w_base` of
    `epistemic`: the information that a state, seen through noise of variance w_base,
    holds about which member is right, where the members' means are Gaussian. Its order
    is that of `epistemic` in one dimension. Over several, the logarithm keeps one from
    outweighing the others, as an angle that turns without bound does.

    Args and returns are those of `epistemic`.

    Raises:
      ValueError: if the shapes do not fit, or there is only one member.
    """
    del obs, action
    variance = _variance_of_means(baseline_variance, next_obs)
    return _mean(jnp.log1p(variance / baseline_variance) / 2)


def one_step_disagreement(
    predict_fn: Callable[[Any, Array, Array], tuple[Array, Array]],
) -> RewardFn:
    """Builds the reward of one-step disagreement (the family of Plan2Explore).

    Every particle is shown to all members: `r = 1/D * sum_k sqrt(v[k] / s[k])` with v
    the variance over members of their predicted means and s the mean of their
    predicted variances. Unlike `epistemic` it does not count how far the members'
    paths drifted apart before this step. It costs E times the model of the rollout.

    Args:
      predict_fn: `(params, obs [E, B, D], action [B, A]) -> (mean, variance)`, both
        `[E, B, D]`, as `Ensemble.predict`.

    Returns:
      A RewardFn that returns `[E, P]` and whose params are those of predict_fn.
    """
    check_callable("predict_fn", predict_fn)

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del next_obs
        check_array("obs", obs, ["E", "P", "D"])
        num_members, per_member, obs_size = obs.shape
        _check_members(num_members)
        rows = num_members * per_member
        shared = jnp.broadcast_to(
            obs.reshape(rows, obs_size), (num_members, rows, obs_size)
        )
        actions = jnp.broadcast_to(action, (rows, *action.shape))
        mean, variance = predict_fn(params, shared, actions)
        ratio = jnp.var(mean, axis=0) / jnp.mean(variance, axis=0)
        return jnp.mean(jnp.sqrt(ratio), -1).reshape(num_members, per_member)

    return reward


def pessimistic(reward_fn: RewardFn, caution: float) -> RewardFn:
    """Builds a reward that trusts the members less the less they agree on it.

    `r = mean_e r_e - caution * std_e r_e`, with `r_e` the mean of reward_fn over the
    particles of member e. A search finds where a model errs in its favour; members that
    were trained apart seldom err alike.

    Args:
      reward_fn: returns `[E, P]`, not a set already reduced.
      caution: standard deviations to take off, 0 or more.

    Returns:
      A RewardFn that returns `[]`, with the params and units of reward_fn. It raises
      ValueError if the shapes do not fit, or there is only one member.

    Raises:
      TypeError, ValueError: unless caution is a finite number of at least 0.
    """
    check_callable("reward_fn", reward_fn)
    check_real("caution", caution, 0.0)

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        check_array("next_obs", next_obs, ["E", "P", "D"])
        _check_members(next_obs.shape[0])
        rewards = reward_fn(params, obs, action, next_obs)
        check_array("reward", rewards, [*next_obs.shape[:2]])
        by_member = jnp.mean(rewards, axis=1)
        return jnp.mean(by_member) - caution * jnp.std(by_member)

    return reward


def _variance_of_means(baseline_variance: Array, next_obs: Array) -> Array:
    """Returns the variance over members of each member's mean particle, `[D]`."""
    check_array("next_obs", next_obs, ["E", "P", "D"])
    check_array("baseline_variance", baseline_variance, [next_obs.shape[-1]])
    _check_members(next_obs.shape[0])
    # Member by member, so that XLA reads the path once: of jnp.var it makes three GPU
    # programs, which write the means and read them again. The code grows with E.
    means = [jnp.mean(member, axis=0) for member in next_obs]
    center = functools.reduce(jnp.add, means) / len(means)
    squares = [(mean - center) ** 2 for mean in means]
    return functools.reduce(jnp.add, squares) / len(means)


def _mean(x: Array) -> Array:
    # Divided first, so that XLA merges this sum with the planner's sum over time.
    return jnp.sum(x / x.size)


def _check_members(num_members: int) -> None:
    if num_members < 2:
        raise ValueError(
            "disagreement needs an ensemble of at least 2 members, got "
            f"{num_members}; the variance over one member is always 0."
        )
