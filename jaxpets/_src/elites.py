"""The best candidates of a search, and what they say about where to search on."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_count

# The value of a candidate whose return is not finite. Finite itself, so that means
# over elites stay finite, and far below any return a task can give.
WORST_VALUE = -1e30


class Elites(NamedTuple):
    """The best K of N candidates; the statistics leave out what was rejected.

    Attributes:
      actions: `[K, H, A]`, the best first.
      mean: `[H, A]`.
      variance: `[H, A]`.
      value: `[]`, the mean of the elites' values.
    """

    actions: Array
    mean: Array
    variance: Array
    value: Array


def check_elites(num_samples: int, num_elites: int) -> tuple[int, int]:
    """Returns both, or raises: there are two elites at least, and no fewer samples."""
    num_elites = check_count("num_elites", num_elites, minimum=2)
    num_samples = check_count("num_samples", num_samples)
    if num_samples < num_elites:
        raise ValueError(
            f"num_samples must be at least num_elites, {num_elites}, got {num_samples}."
        )
    return num_samples, num_elites


def join_iterations(tried: Any) -> Any:
    """Returns Candidates `[I, N, ...]` as `[I * N, ...]`, and () as it is."""

    def join(x: Array) -> Array:
        return jax.lax.collapse(x, 0, 2)

    return jax.tree.map(join, tried)


def is_valid(values: Array) -> Array:
    """Tells which of `values` `[N]` are above WORST_VALUE; if none is, all pass."""
    return (values > WORST_VALUE) | jnp.all(values <= WORST_VALUE)


def select_elites(values: Array, actions: Array, num_elites: int) -> Elites:
    """Selects the best candidates.

    A candidate whose imagined future is not finite is rejected: it has the worst value.
    It may be an elite where fewer than K are left, but it does not move the search,
    unless all are rejected.

    Args:
      values: `[N]`, finite.
      actions: `[N, H, A]`.
      num_elites: K.

    Returns:
      Elites.
    """
    best, index = jax.lax.top_k(values, num_elites)
    elites = actions[index]
    kept = is_valid(best).astype(jnp.float32)
    share = kept / jnp.sum(kept)
    weight = share[:, None, None]
    mean = jnp.sum(weight * elites, axis=0)
    variance = jnp.sum(weight * (elites - mean) ** 2, axis=0)
    return Elites(elites, mean, variance, jnp.sum(share * best))
