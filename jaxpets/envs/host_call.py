"""A function of NumPy inside JAX programs."""

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.experimental.buffer_callback import buffer_callback


def host_call(
    function: Callable[[np.ndarray], np.ndarray], size: int
) -> Callable[[Array], Array]:
    """Builds a function of JAX that is a function of NumPy on the host.

    On a CPU nothing is between but a copy; `jax.pure_callback`, which is used
    elsewhere, first makes arrays of JAX of what NumPy reads.

    Args:
      function: `[..., I] -> [..., size]`, float32. What it gets may not be written to,
        and is another's memory once it has returned. It must not call JAX, which could
        wait for itself for ever.
      size: of the last axis of what it returns.

    Returns:
      `[I] -> [size]`, float32. A call fails if it gets another number of axes, or if
      `function` returns another shape. Under any nest of `jax.vmap` the host is called
      once for the whole batch; of a program over several devices each calls it, under
      `jax.shard_map` with its own share. What is called eagerly must be on the default
      device. It has no gradient.
    """

    def rows_of(inputs: Any) -> np.ndarray:
        rows = np.asarray(inputs)
        rows.flags.writeable = False
        outputs = np.ascontiguousarray(function(rows), np.float32)
        wanted = (*rows.shape[:-1], size)
        if outputs.shape != wanted:
            raise ValueError(
                f"the host's function must return {[*wanted]}, got {[*outputs.shape]}."
            )
        return outputs

    def here(context: Any, out: Any, inputs: Any) -> None:
        np.asarray(out)[...] = rows_of(inputs)

    shape = jax.ShapeDtypeStruct((size,), jnp.float32)
    vmapped: Any = {"vmap_method": "broadcast_all"}
    direct: Any = cast(Any, buffer_callback)(here, shape, **vmapped)
    default = functools.partial(jax.pure_callback, rows_of, shape, **vmapped)

    def call(inputs: Array) -> Array:
        if inputs.ndim != 1:  # which would be taken for rows
            raise ValueError(f"inputs must have one axis, [I], got {[*inputs.shape]}.")
        choose: Any = jax.lax.platform_dependent
        return choose(inputs.astype(jnp.float32), cpu=direct, default=default)

    return call
