"""A reward in [0, 1] for being within bounds, as the DeepMind Control Suite has it."""

import math
from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

# `(distance in margins, value at one margin) -> value`.
ShapeFn = Callable[[Array, float], Array]


def gaussian(distance: Array, value: float) -> Array:
    """Falls as a normal density does, and never to zero."""
    return jnp.exp(distance**2 * math.log(value))


def linear(distance: Array, value: float) -> Array:
    """Falls along a line, to zero and no further."""
    return jnp.maximum(1.0 - (1.0 - value) * distance, 0.0)


def quadratic(distance: Array, value: float) -> Array:
    """Falls along a parabola, to zero and no further."""
    return jnp.maximum(1.0 - (1.0 - value) * distance**2, 0.0)


def holds(condition: Array, x: Array) -> Array:
    """Returns 1 where a condition on x holds and 0 elsewhere, but NaN where x is."""
    return jnp.where(jnp.isnan(x), jnp.nan, condition.astype(jnp.float32))


def tolerance(
    x: Array,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    margin: float = 0.0,
    value: float = 0.1,
    shape: ShapeFn = gaussian,
) -> Array:
    """Returns 1 within bounds, and less the further x is from them.

    Section 2 of Tassa et al., "DeepMind Control Suite", 2018.

    Args:
      x: `[...]`, in the unit of the bounds.
      low: the lower bound, which is within.
      high: the upper one.
      margin: the distance from a bound at which the result is `value`; with 0 it is 0
        anywhere outside.
      value: see margin; in [0, 1), and positive for `gaussian`.
      shape: how it falls: `gaussian`, `linear` or `quadratic`.

    Returns:
      `[...]` in [0, 1]; NaN where x is, so that no plan wins by a state that has none.
    """
    outside = jnp.maximum(jnp.maximum(low - x, x - high), 0.0)
    if not margin:
        return holds(outside == 0.0, outside)
    return shape(outside / margin, value)
