"""The best candidates of a search, and what they say about where to search on."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class Elites(NamedTuple):
    """The best K of N candidates; the statistics leave out what was rejected."""

    actions: Array  # [K, H, A], the best first
    mean: Array  # [H, A]
    variance: Array  # [H, A]
    value: Array  # [] mean


def not_rejected(values: Array, worst: float) -> Array:
    """Tells which of `values` `[N]` are better than the worst; if none is, all pass."""
    return (values > worst) | jnp.all(values <= worst)


def select_elites(
    values: Array, actions: Array, num_elites: int, worst: float
) -> Elites:
    """Selects the best candidates.

    A candidate whose imagined future is not finite is rejected: it has the worst value.
    It may be an elite where fewer than K are left, but it does not move the search,
    unless all are rejected.

    Args:
      values: `[N]`, finite.
      actions: `[N, H, A]`.
      num_elites: K.
      worst: value of what is rejected.

    Returns:
      Elites.
    """
    best, index = jax.lax.top_k(values, num_elites)
    elites = actions[index]
    kept = not_rejected(best, worst).astype(jnp.float32)
    share = kept / jnp.sum(kept)
    weight = share[:, None, None]
    mean = jnp.sum(weight * elites, axis=0)
    variance = jnp.sum(weight * (elites - mean) ** 2, axis=0)
    return Elites(elites, mean, variance, jnp.sum(share * best))
