"""Which places of an array of fixed capacity are filled."""

import jax.numpy as jnp
from jax import Array


def filled(capacity: int, size: Array | int) -> Array:
    """Returns which places are the first `size`, `[C]`.

    They are counted in int32, as sizes are, so that nothing is promoted under x64.
    """
    return jnp.arange(capacity, dtype=jnp.int32) < size
