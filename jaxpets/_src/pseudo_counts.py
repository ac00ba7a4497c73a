"""Pseudo-counts of states by static hashing: the count-based baseline (section 4.1)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_count, check_key, check_record
from jaxpets._src.moments import counted, moments
from jaxpets._src.types import Dataset

# A code is one uint32. Sorting codes and searching them counts exactly for every k up
# to here, where a table would need 2^k cells.
_MAX_BITS = 32


class PseudoCounts(NamedTuple):
    """The hash and every code seen so far.

    Attributes:
      projection: `[k, D]`.
      mean: `[D]`, of the states counted.
      std: `[D]`, of the states counted.
      codes: `[C]` uint32, sorted, padding among them.
      visits: `[C]` int32, how many states have the code.
    """

    projection: Array
    mean: Array
    std: Array
    codes: Array
    visits: Array


def simhash(key: Array, num_bits: int, obs_size: int) -> Array:
    """Draws the projection `[k, D]` of a SimHash with k = `num_bits` bits.

    Args:
      key: consumed.
      num_bits: k, 1 to 32.
      obs_size: D.

    Raises:
      TypeError, ValueError: unless `1 <= num_bits <= 32`.
    """
    check_key("key", key)
    num_bits = check_count("num_bits", num_bits, maximum=_MAX_BITS)
    obs_size = check_count("obs_size", obs_size)
    return jax.random.normal(key, (num_bits, obs_size), jnp.float32)


def count_states(projection: Array, dataset: Dataset) -> PseudoCounts:
    """Counts the codes of all states reached so far.

    `g` standardises by the statistics of the dataset, so the codes of old states
    change with every trial and all of them are hashed anew, as in the paper.

    Args:
      projection: `[k, D]` from `simhash`.
      dataset: its `next_obs` are the states.

    Returns:
      PseudoCounts for `pseudo_count`; no state that is not finite is counted.

    Raises:
      TypeError, ValueError: unless dataset is one, or if the projection does not fit
        its observations or has over 32 rows.
    """
    check_record("dataset", dataset, Dataset)
    obs = dataset.data.next_obs
    check_array("dataset.data.next_obs", obs, ["C", "D"])
    check_array("projection", projection, ["k", obs.shape[1]])
    if projection.shape[0] > _MAX_BITS:
        raise ValueError(
            f"projection must have at most {_MAX_BITS} rows, got {projection.shape[0]}."
        )
    mean, std = moments(obs, dataset.size)
    used = counted(obs, dataset.size)
    num_used = jnp.sum(used, dtype=jnp.int32)
    codes = _hash(projection, mean, std, obs)
    # Padding sorts behind or among equal real codes, and is cut off when counting.
    codes = jnp.sort(jnp.where(used, codes, jnp.uint32(0xFFFFFFFF)))
    first, last = (
        jnp.minimum(jnp.searchsorted(codes, codes, side=side), num_used)
        for side in ("left", "right")
    )
    return PseudoCounts(projection, mean, std, codes, last - first)


def lookup(counts: PseudoCounts, obs: Array) -> Array:
    """Returns n(s), how many counted states share the code of obs.

    Args:
      counts: from `count_states`.
      obs: `[..., D]`.

    Returns:
      `[...]` int32.
    """
    check_record("counts", counts, PseudoCounts)
    check_array("obs", obs, ["...", counts.mean.shape[0]])
    code = _hash(counts.projection, counts.mean, counts.std, obs)
    # Unrolled, the steps of the search can be one program. Every particle of every
    # candidate comes through here.
    at = jnp.searchsorted(counts.codes, code, method="scan_unrolled")
    at = jnp.minimum(at, counts.codes.size - 1)
    return jnp.where(counts.codes[at] == code, counts.visits[at], 0)


def pseudo_count(
    counts: PseudoCounts, obs: Array, action: Array, next_obs: Array
) -> Array:
    """Rewards rarely seen states: `1 / sqrt(1 + n(sgn(A g(s))))` (section 4.1).

    Args:
      counts: from `count_states`.
      obs: `[E, P, D]`, unused.
      action: `[A]`, unused.
      next_obs: `[E, P, D]`, or any leading shape.

    Returns:
      `[E, P]`, the leading shape of next_obs. It is NaN where next_obs is not finite: a
      state that blew up has no code, and should not count as one never seen.
    """
    del obs, action
    novelty = jax.lax.rsqrt(1.0 + lookup(counts, next_obs).astype(jnp.float32))
    return jnp.where(jnp.all(jnp.isfinite(next_obs), axis=-1), novelty, jnp.nan)


def _hash(projection: Array, mean: Array, std: Array, obs: Array) -> Array:
    # At full precision: a sign must not depend on where it is computed.
    scaled = (obs - mean) / std
    products = jnp.matmul(scaled, projection.T, precision=jax.lax.Precision.HIGHEST)
    bits = (products > 0).astype(jnp.uint32)
    weights = jnp.left_shift(
        jnp.uint32(1), jnp.arange(bits.shape[-1], dtype=jnp.uint32)
    )
    return jnp.sum(bits * weights, axis=-1, dtype=jnp.uint32)
