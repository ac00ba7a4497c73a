"""Rewards of what the members predict differently one step from the same state."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_callable, check_record
from jaxpets._src.rewards import check_members
from jaxpets._src.types import RewardFn

PredictFn = Callable[[Any, Array, Array], tuple[Array, Array]]


def one_step_disagreement(predict_fn: PredictFn) -> RewardFn:
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

    def measure(mean: Array, variance: Array) -> Array:
        ratio = jnp.var(mean, axis=0) / jnp.mean(variance, axis=0)
        return jnp.mean(jnp.sqrt(ratio), -1)

    return _one_step(predict_fn, measure)


class Plan2ExploreData(NamedTuple):
    """The data of `plan2explore`.

    Attributes:
      dynamics: what predict_fn reads.
      baseline_variance: `[D]`, of the observations so far, in units of obs squared;
        see `datasets.obs_variance`.
    """

    dynamics: Any
    baseline_variance: Array


def plan2explore(predict_fn: PredictFn) -> RewardFn:
    """Builds the reward of Plan2Explore (Sekar et al., 2020), on observations.

    `r = 1/D * sum_k sqrt(v[k] / w[k])` with v of `one_step_disagreement` and w the
    variance of the data: no noise stands below it. Plan2Explore has the entries of an
    embedding, of a unit scale each, in place of whitened observations, and the mean of
    their variances; the root is that of `epistemic` over the same w, from which this
    differs in that all members predict from one state.

    Args and returns are those of `one_step_disagreement`, as is the cost; the params
    are Plan2ExploreData. It raises TypeError or ValueError for others.
    """
    check_callable("predict_fn", predict_fn)

    def reward(
        params: Plan2ExploreData, obs: Array, action: Array, next_obs: Array
    ) -> Array:
        check_record("params", params, Plan2ExploreData)
        baseline = params.baseline_variance

        def measure(mean: Array, variance: Array) -> Array:
            del variance
            check_array("baseline_variance", baseline, [mean.shape[-1]])
            return jnp.mean(jnp.sqrt(jnp.var(mean, axis=0) / baseline), -1)

        return _one_step(predict_fn, measure)(params.dynamics, obs, action, next_obs)

    return reward


def opax(predict_fn: PredictFn) -> RewardFn:
    """Builds the reward of OPAX (Sukhija et al., 2023), twice an information gain.

    `r = sum_k log(1 + v[k] / s[k])`, with v (epistemic) and s (aleatoric) of
    `one_step_disagreement`: their bound on the information, in nats, that the next
    state holds about the dynamics, without its factor of a half. It differs from
    `information_gain` in that all members predict from one state, the noise is the one
    predicted there, not the largest, and dimensions are summed. OPAX also chooses among
    plausible dynamics (its optimism); here the rollout does not, as in its own
    variants with mean or sampled dynamics.

    Args and returns are those of `one_step_disagreement`, as is the cost.
    """

    def measure(mean: Array, variance: Array) -> Array:
        ratio = jnp.var(mean, axis=0) / jnp.mean(variance, axis=0)
        return jnp.sum(jnp.log1p(ratio), -1)

    return _one_step(predict_fn, measure)


def jensen_renyi(predict_fn: PredictFn) -> RewardFn:
    """Builds the Jensen-Renyi divergence of MAX (Shyam et al., 2019), in nats.

    `r = H(1/E * sum_e p_e) - 1/E * sum_e H(p_e)` with the Renyi entropy of order 2,
    `H(p) = -log integral p^2`, and `p_e` the Gaussian that member e predicts from the
    particle's state. It is exact, by the closed form for mixtures of Gaussians (Wang et
    al., 2009): with `d_ij` the density of `N(mean_i, S_i + S_j)` at `mean_j`,

      `r = -log(1/E^2 * sum_ij d_ij) + 1/E * sum_i log d_ii`.

    With equal variances it lies between 0, where the members agree, and `log E`, where
    no two of them overlap: between states that are both unknown it says little.

    Args and returns are those of `one_step_disagreement`. It costs E times the model of
    the rollout, and compares E^2 pairs of members.
    """

    def measure(mean: Array, variance: Array) -> Array:
        both = variance[:, None] + variance  # [E, E, B, D], never stored if fused
        apart = (mean[:, None] - mean) ** 2 / both
        log_density = -jnp.sum(apart + jnp.log(both), -1) / 2
        # By logarithms: over many dimensions a density leaves the range of float32.
        overlap = jax.nn.logsumexp(log_density, axis=(0, 1)) - 2 * math.log(len(mean))
        alone = jnp.mean(jnp.sum(jnp.log(2 * variance), -1) / 2, 0)
        return -overlap - alone

    return _one_step(predict_fn, measure)


def _one_step(
    predict_fn: PredictFn, measure: Callable[[Array, Array], Array]
) -> RewardFn:
    """Builds the reward that shows every particle to all members.

    Args:
      predict_fn: as `Ensemble.predict`.
      measure: `(mean [E, B, D], variance [E, B, D]) -> [B]`.
    """
    check_callable("predict_fn", predict_fn)

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del next_obs
        check_array("obs", obs, ["E", "P", "D"])
        num_members, per_member, obs_size = obs.shape
        check_members(num_members)
        rows = num_members * per_member
        shared = jnp.broadcast_to(
            obs.reshape(rows, obs_size), (num_members, rows, obs_size)
        )
        actions = jnp.broadcast_to(action, (rows, *action.shape))
        mean, variance = predict_fn(params, shared, actions)
        return measure(mean, variance).reshape(num_members, per_member)

    return reward
