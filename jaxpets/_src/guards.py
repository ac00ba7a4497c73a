"""What keeps a gradient step that is not finite out of what has been learned."""

import functools
from collections.abc import Callable
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


def guarded_step(
    update_fn: Callable[..., Any], grads: Any, params: Any, opt_state: Any
) -> tuple[Any, Any, Array]:
    """Takes a gradient step, unless it, or what the optimizer keeps, is not finite.

    Args:
      update_fn: of an optimizer of optax.
      grads: of params.
      params: any pytree of floats.
      opt_state: of the optimizer.

    Returns:
      (params, opt_state, whether the step was taken `[]`).
    """
    # Optimizers of optax do not trace under strict promotion, if a caller set it.
    with jax.numpy_dtype_promotion("standard"):
        updates, new_state = update_fn(grads, opt_state, params)
    new = jax.tree.map(jnp.add, params, updates)
    # Of a gradient whose square is not finite, Adam makes a step of 0, and a moment
    # that holds its weight where it is for ever.
    good = is_finite((new, new_state))
    params, opt_state = choose(good, (new, new_state), (params, opt_state))
    return params, opt_state, good
