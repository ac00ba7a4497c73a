"""A model of one state as a model of particles."""

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_callable, check_key
from jaxpets._src.types import DynamicsFn


def per_state(step_fn: Callable[[Any, Array, Array, Array], Array]) -> DynamicsFn:
    """Lifts a model of one state to the contract of `particle_rollout`.

    Every particle is moved by a call of its own, mapped by `jax.vmap`, with a key of
    its own. All members are this one model, with the same parameters.

    Args:
      step_fn: `(params, key, obs [D], action [A]) -> next_obs [D]`.

    Returns:
      A DynamicsFn. Its noise is that of the whole batch also where `plan` imagines in
      chunks. The keys that step_fn gets are of JAX's default kind.

    Raises:
      TypeError: if step_fn is no function.
      ValueError: from the model, when traced, if an argument or what step_fn returns
        has another shape or dtype.

    >>> import jax.numpy as jnp
    >>> drift = per_state(lambda dt, key, obs, action: obs.at[0].add(dt * action[0]))
    >>> obs, action = jnp.zeros((1, 3, 2)), jnp.ones((3, 1))
    >>> drift(0.5, jax.random.key(0), obs, action)[0, 2].tolist()
    [0.5, 0.0]
    """
    check_callable("step_fn", step_fn)

    def move(params: Any, key: Array, obs: Array, action: Array) -> Array:
        next_obs = step_fn(params, key, obs, action)
        check_array("step_fn's result", next_obs, obs.shape)
        return next_obs

    rows = jax.vmap(move, (None, 0, 0, 0))

    def dynamics(params: Any, key: Array, obs: Array, action: Array) -> Array:
        check_key("key", key)
        check_array("obs", obs, ["E", "B", "D"])
        check_array("action", action, ["...", obs.shape[1], "A"])
        # Drawn and not split: a draw of rows is what a key for some of them can share.
        data = jax.random.bits(key, (*obs.shape[:2], 2), jnp.uint32)
        keys = cast(Array, jax.random.wrap_key_data(data, impl="threefry2x32"))
        of_member = None if action.ndim == 2 else 0
        return jax.vmap(rows, (None, 0, 0, of_member))(params, keys, obs, action)

    return dynamics
