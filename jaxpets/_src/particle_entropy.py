"""The entropy of visited states, by the distance to their nearest neighbours."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_count, check_record
from jaxpets._src.filled import filled
from jaxpets._src.moments import moments
from jaxpets._src.types import Dataset, RewardFn


class VisitedStates(NamedTuple):
    """States to compare imagined ones with.

    Attributes:
      states: `[M, D]`, standardised.
      used: `[M]` bool, which of them there are.
      mean: `[D]`, of all states visited.
      std: `[D]`, of all states visited.
    """

    states: Array
    used: Array
    mean: Array
    std: Array


def visited_states(dataset: Dataset, num_states: int) -> VisitedStates:
    """Returns at most M = `num_states` of the states reached, spread over all trials.

    Args:
      dataset: its `next_obs` are the states.
      num_states: M. The reward takes time and memory in proportion to it.

    Returns:
      VisitedStates for `particle_entropy`; no state that is not finite is used.

    Raises:
      TypeError, ValueError: unless dataset is one and num_states a positive int.
    """
    check_record("dataset", dataset, Dataset)
    num_states = check_count("num_states", num_states)
    obs = dataset.data.next_obs
    check_array("dataset.data.next_obs", obs, ["C", "D"])
    mean, std = moments(obs, dataset.size)
    # Every row while they are few, then every so many-th.
    stride = jnp.maximum(dataset.size.astype(jnp.float32) / num_states, 1.0)
    rows = (jnp.arange(num_states, dtype=jnp.float32) * stride).astype(jnp.int32)
    states = (jnp.take(obs, rows, axis=0, mode="clip") - mean) / std
    used = (rows < dataset.size) & jnp.all(jnp.isfinite(states), axis=1)
    return VisitedStates(states, used, mean, std)


def particle_entropy(num_neighbors: int = 12) -> RewardFn:
    """Builds the particle-based entropy of APT (Liu and Abbeel, 2021).

    `r = log(1 + 1/k * sum_j |z - z_j|)` over the k visited states z_j nearest to the
    imagined z: up to constants, the estimate by nearest neighbours of the entropy of
    what is visited, which grows by going where few states are. It is APT's average
    over the neighbours, where RE3 (Seo et al., 2021) takes the k-th alone, and the
    plain distance, as in the code of APT, where its paper has the power D. Instead of
    a learned representation z is the observation, standardised by the data; so an
    angle that turns without bound is new for ever.

    Args:
      num_neighbors: k. With fewer states than that the mean is over all there are, and
        without any the reward is 0.

    Returns:
      A RewardFn that returns `[E, P]`, the leading shape of next_obs, and whose params
      are VisitedStates, `[M, D]`. It compares each particle with M states. It is not
      finite where next_obs is not. It raises TypeError or ValueError if the shapes do
      not fit or M is below k.

    Raises:
      TypeError, ValueError: unless num_neighbors is a positive int.
    """
    num_neighbors = check_count("num_neighbors", num_neighbors)

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del obs, action
        check_record("params", params, VisitedStates)
        num_states, obs_size = params.states.shape
        num_states = check_count("num_states", num_states, minimum=num_neighbors)
        check_array("next_obs", next_obs, ["...", obs_size])
        scaled = (next_obs - params.mean) / params.std
        # By differences, not by products, which lose short distances to rounding.
        square = jnp.sum((scaled[..., None, :] - params.states) ** 2, axis=-1)
        square = jnp.where(params.used, square, jnp.inf)
        nearest, _ = jax.lax.top_k(-square, num_neighbors)
        count = jnp.minimum(jnp.sum(params.used), num_neighbors)
        found = filled(num_neighbors, count)
        total = jnp.sum(jnp.where(found, jnp.sqrt(-nearest), 0.0), axis=-1)
        entropy = jnp.log1p(total / jnp.maximum(count, 1).astype(jnp.float32))
        # Of no neighbours the sum would be 0, whatever there is to compare.
        return jnp.where(jnp.all(jnp.isfinite(next_obs), axis=-1), entropy, jnp.nan)

    return reward
