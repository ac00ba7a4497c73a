"""What keeps a gradient step that is not finite out of what has been learned."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


def is_finite(tree: Any) -> Array:
    """Tells whether all numbers of a pytree are finite; whole numbers always are."""
    floats = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.inexact)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in floats]))


def choose(condition: Array, new: Any, old: Any) -> Any:
    """Returns one of two pytrees of the same form."""
    return jax.tree.map(functools.partial(jnp.where, condition), new, old)
