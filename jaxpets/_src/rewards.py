"""Rewards that seek, or shun, what the ensemble does not know."""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_real,
    check_record,
)
from jaxpets._src.returns import checked_reward
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
    return _mean(jnp.sqrt(_relative_variance(baseline_variance, next_obs)))


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
    return _mean(jnp.log1p(_relative_variance(baseline_variance, next_obs)) / 2)


def ensemble_std(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
    """Disagreement in the units of the observation (Sancaktar et al., 2022, CEE-US).

    `r = sum_k sqrt(v[k])`, with `v` of `epistemic`: as there, every member has followed
    the plan from the start. Since no noise stands below it, a dimension of large
    numbers, as the speed of a joint, outweighs the others. It is D times `epistemic`
    over a w_base of ones. CEE-US has no particles, for its networks are deterministic,
    and divides by E - 1 in the variance where this divides by E: a constant factor.

    Args:
      params: unused.
      obs: `[E, P, D]`, unused.
      action: `[A]`, unused.
      next_obs: `[E, P, D]`.

    Returns:
      `[]`, in units of obs.

    Raises:
      ValueError: if the shapes do not fit, or there is only one member.
    """
    del params, obs, action
    return jnp.sum(jnp.sqrt(_variance_of_means(next_obs)))


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
    caution = check_real("caution", caution, 0.0)

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        check_array("next_obs", next_obs, ["E", "P", "D"])
        check_members(next_obs.shape[0])
        rewards = reward_fn(params, obs, action, next_obs)
        check_array("reward", rewards, [*next_obs.shape[:2]])
        by_member = jnp.mean(rewards, axis=1)
        return jnp.mean(by_member) - caution * jnp.std(by_member)

    return reward


class MixtureData(NamedTuple):
    """The data of a `mixture`.

    Attributes:
      extrinsic: of the reward of the task.
      intrinsic: of the reward that explores.
      weight: `[]`, of the second against the first; it may change between calls.
    """

    extrinsic: Any
    intrinsic: Any
    weight: ArrayLike


def mixture(extrinsic_fn: RewardFn, intrinsic_fn: RewardFn) -> RewardFn:
    """Builds the reward of a task that goes on exploring (Bellemare et al., 2016).

    `r = r_extrinsic + weight * r_intrinsic`. With it a model is fine-tuned on a task
    and still seeks what it does not know; weight 0 is the task alone.

    Args:
      extrinsic_fn: the task.
      intrinsic_fn: what explores. Either may return `[]` or `[E, P]`.

    Returns:
      A RewardFn whose params are MixtureData. It returns `[]` if both do, else
      `[E, P]`. It raises TypeError or ValueError for other params, and if a part
      returns anything else.

    Raises:
      TypeError: unless both are functions.
    """
    extrinsic_fn = checked_reward(extrinsic_fn, "extrinsic_fn")
    intrinsic_fn = checked_reward(intrinsic_fn, "intrinsic_fn")

    def reward(
        params: MixtureData, obs: Array, action: Array, next_obs: Array
    ) -> Array:
        check_record("params", params, MixtureData)
        check_array("params.weight", params.weight, [])
        step = (obs, action, next_obs)
        extrinsic = extrinsic_fn(params.extrinsic, *step)
        intrinsic = intrinsic_fn(params.intrinsic, *step)
        # What is already reduced counts for every particle.
        shape = jnp.broadcast_shapes(extrinsic.shape, intrinsic.shape)
        extrinsic, intrinsic = (
            jnp.broadcast_to(x, shape) for x in (extrinsic, intrinsic)
        )
        return extrinsic + params.weight * intrinsic

    return reward


def _relative_variance(baseline_variance: Array, next_obs: Array) -> Array:
    """Returns the variance of the members over another one, `[D]`."""
    variance = _variance_of_means(next_obs)
    check_array("baseline_variance", baseline_variance, [next_obs.shape[-1]])
    return variance / baseline_variance


def _variance_of_means(next_obs: Array) -> Array:
    """Returns the variance over members of each member's mean particle, `[D]`."""
    check_array("next_obs", next_obs, ["E", "P", "D"])
    check_members(next_obs.shape[0])
    # Member by member, so that XLA reads the path once: of jnp.var it makes three GPU
    # programs, which write the means and read them again. The code grows with E.
    means = [jnp.mean(member, axis=0) for member in next_obs]
    center = functools.reduce(jnp.add, means) / len(means)
    squares = [(mean - center) ** 2 for mean in means]
    return functools.reduce(jnp.add, squares) / len(means)


def _mean(x: Array) -> Array:
    # Divided first, so that XLA merges this sum with the planner's sum over time.
    return jnp.sum(x / x.size)


def check_members(num_members: int) -> None:
    """Raises unless there are two members, who may disagree."""
    if num_members < 2:
        raise ValueError(
            "disagreement needs an ensemble of at least 2 members, got "
            f"{num_members}; the variance over one member is always 0."
        )
