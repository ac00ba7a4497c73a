"""A logarithm of both signs, for values of which some are far larger than others."""

import jax.numpy as jnp
from jax import Array

# A critic's error is a power here: two that are infinite would differ by NaN.
_LARGEST_POWER = 60.0


def symlog(value: Array, squash: Array) -> Array:
    """Returns `sign(v) log(1 + squash |v|) / log(1 + squash)`: -1, 0 and 1 stay.

    DreamerV3 (Hafner et al., 2023) has it with a squash of 1, of values in units of
    the reward.

    Args:
      value: `[...]`.
      squash: `[]`, how many times steeper it is at 0 than at 1, less one; 0: the value.
    """
    rate, is_on = _rate(squash)
    found = jnp.sign(value) * jnp.log1p(rate * jnp.abs(value)) / jnp.log1p(rate)
    return jnp.where(is_on, found, value)


def symexp(value: Array, squash: Array) -> Array:
    """Returns what `symlog` makes this value of; what is too large stays finite."""
    rate, is_on = _rate(squash)
    power = jnp.minimum(jnp.abs(value) * jnp.log1p(rate), _LARGEST_POWER)
    found = jnp.sign(value) * jnp.expm1(power) / rate
    return jnp.where(is_on, found, value)


def _rate(squash: Array) -> tuple[Array, Array]:
    # Without a squash both functions are 0 over 0, and so are their gradients.
    is_on = squash > 0.0
    return jnp.where(is_on, squash, 1.0), is_on
