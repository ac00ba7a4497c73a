"""Mean and standard deviation of the filled part of an array of fixed capacity."""

import jax.numpy as jnp
from jax import Array

from jaxpets._src.filled import filled

# A constant column is not divided by its rounding noise. PETS: 1e-12, in float64.
_MIN_STD = 1e-6


def counted(rows: Array, size: Array) -> Array:
    """Returns which rows of `[C, F]` count, `[C]`: the first `size`, if finite."""
    return filled(rows.shape[0], size) & jnp.all(jnp.isfinite(rows), axis=1)


def moments(rows: Array, size: Array) -> tuple[Array, Array]:
    """Returns mean and std `[F]` of the first `size` rows of `[C, F]`; no std is 0.

    A row that is not finite does not count.
    """
    used = counted(rows, size)[:, None]
    count = jnp.maximum(jnp.sum(used), 1).astype(jnp.float32)
    # From the first that counts, where the mean of a constant column is exact.
    row = jnp.argmax(used[:, 0])
    first = jnp.where(used[row], rows[row], 0.0)
    mean = first + jnp.sum(jnp.where(used, rows - first, 0.0), axis=0) / count
    square = jnp.where(used, (rows - mean) ** 2, 0.0)
    std = jnp.sqrt(jnp.sum(square, axis=0) / count)
    return mean, jnp.where(std < _MIN_STD, 1.0, std)
