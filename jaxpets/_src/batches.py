"""Which rows of the data each member is shown, and in what portions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.filled import filled


class Batch(NamedTuple):
    """The rows of one update, a draw of its own for every member."""

    inputs: Array  # [E, batch_size, F + A]
    targets: Array  # [E, batch_size, D]
    weight: Array  # [batch_size], sums to one; 0 past the end of the data
    num_rows: Array  # [] rows that count


def rows_shown(
    key: Array, bootstrap: bool, shape: tuple[int, int], size: Array
) -> Array:
    """Returns which rows each member is shown, `[E, C]`, of which `size` count."""
    if bootstrap:
        return jax.random.randint(key, shape, 0, jnp.maximum(size, 1))
    return jnp.broadcast_to(jnp.arange(shape[1], dtype=jnp.int32), shape)


def shuffle(key: Array, rows: Array, size: Array) -> Array:
    """Returns the rows `[E, C]` in another order; the first `size` stay the first."""
    order = jax.random.uniform(key, rows.shape, jnp.float32)
    order = jnp.where(filled(rows.shape[1], size), order, jnp.inf)
    return jnp.take_along_axis(rows, jnp.argsort(order, axis=1), axis=1)


def minibatch(
    data: tuple[Array, Array], rows: Array, i: Array, batch_size: int, size: Array
) -> Batch:
    """Returns batch i of the data; there may be few rows left for it, or none."""
    position = i * batch_size + jnp.arange(batch_size, dtype=jnp.int32)
    # Past the data lies what need not be finite, which no weight masks.
    within = jnp.minimum(position, size - 1)
    picked = jnp.take(rows, within, axis=1, mode="clip")
    used = (position < size).astype(jnp.float32)
    num_rows = jnp.float32(jnp.clip(size - i * batch_size, 0, batch_size))
    inputs, targets = data
    weight = used / jnp.maximum(num_rows, 1.0)
    return Batch(inputs[picked], targets[picked], weight, num_rows)
