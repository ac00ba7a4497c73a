"""Windows of consecutive transitions of what a run saw: where they are, and a draw."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets


def starts_of(
    data: jaxpets.Transition, first: int, size: int, trial_length: int, num_steps: int
) -> Array:
    """Returns whether a window can begin in a row, `[S, C]` bool.

    It is of one trial, whose rows follow one another, and all its transitions do. They
    do not where a trial ended early and began anew, nor where physics diverged: other
    rows have taken those places.

    Args:
      data: `[S, C, *]`.
      first: row from which on there are windows.
      size: rows that are filled.
      trial_length: rows of a trial.
      num_steps: K.
    """
    capacity = data.obs.shape[1]
    row = jnp.arange(capacity)
    goes_on = jnp.all(data.next_obs == jnp.roll(data.obs, -1, axis=1), axis=-1)
    is_end = (row % trial_length == trial_length - 1) | ~goes_on
    ends = jnp.pad(jnp.cumsum(is_end, axis=1), ((0, 0), (1, 0)))  # before each row
    last = jnp.minimum(row + num_steps - 1, capacity)
    is_whole = ends[:, last] == ends[:, row]
    return is_whole & (row >= first) & (row + num_steps <= size)


def draw(
    data: jaxpets.Transition,
    seeds: Sequence[int],
    starts: Array,
    num_steps: int,
    num_rows: int,
) -> jaxpets.Transition:
    """Draws `[S, B, K, *]` windows, always the same; they may overlap.

    Args:
      data: `[S, C, *]`.
      seeds: S.
      starts: `[S, C]`, where windows can begin, of each seed at least B.
      num_steps: K.
      num_rows: B.
    """

    def one(seed: Array, starts: Array, data: jaxpets.Transition) -> jaxpets.Transition:
        key = jax.random.fold_in(jax.random.key(0), seed)
        order = jnp.where(starts, jax.random.uniform(key, starts.shape), 2.0)
        begins = jnp.argsort(order)[:num_rows]
        rows = begins[:, None] + jnp.arange(num_steps)
        return jax.tree.map(lambda x: x[rows], data)

    return jax.vmap(one)(jnp.array(seeds, jnp.uint32), starts, data)
