"""A function of NumPy inside JAX programs, called with no more between than a copy."""

import ctypes
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

    `jax.pure_callback` does the same, but it makes arrays of JAX of what NumPy reads,
    which takes longer than a step of MuJoCo. It is used where there is no other way.

    Args:
      function: `[..., I] -> [..., size]`, float32. It must not write to what it gets,
        nor call JAX: that could wait for itself for ever.
      size: of the last axis of what it returns.

    Returns:
      `[I] -> [size]`. Under any nest of `jax.vmap` the host is called once for the
      whole batch. It has no gradient.
    """

    def on_cpu(_: Any, out: Any, inputs: Any) -> None:
        np.asarray(out)[...] = function(np.asarray(inputs))

    def on_cuda(context: Any, out: Any, inputs: Any) -> None:
        cuda, stream = _driver(), context.stream
        rows = np.empty(inputs.shape, np.float32)
        cuda("cuMemcpyDtoHAsync_v2", _here(rows), _there(inputs), rows.nbytes, stream)
        cuda("cuStreamSynchronize", stream)
        rows = np.ascontiguousarray(function(rows), np.float32)
        # This returns once the rows have left memory that nobody pinned.
        cuda("cuMemcpyHtoDAsync_v2", _there(out), _here(rows), rows.nbytes, stream)

    shape = jax.ShapeDtypeStruct((size,), jnp.float32)
    method = "broadcast_all"

    def through(callback: Callable[..., None]) -> Callable[..., Any]:
        return cast(Any, buffer_callback)(callback, shape, vmap_method=method)

    def elsewhere(inputs: Array) -> Array:
        def host(rows: Any) -> np.ndarray:
            return function(np.asarray(rows))

        return jax.pure_callback(host, shape, inputs, vmap_method=method)

    def call(inputs: Array) -> Array:
        return cast(Any, jax.lax.platform_dependent)(
            inputs, cpu=through(on_cpu), cuda=through(on_cuda), default=elsewhere
        )

    return call


def _here(rows: np.ndarray) -> int:
    """Returns where an array lies in the memory of the host."""
    return rows.ctypes.data


def _there(buffer: Any) -> int:
    """Returns where a buffer lies in the memory of a GPU."""
    return buffer.__cuda_array_interface__["data"][0]


@functools.cache
def _driver() -> Callable[..., None]:
    """Returns `(name, *arguments)`, which calls the driver of an NVIDIA GPU.

    Its copies need a GPU to be current, as it is in a thread that XLA calls from.
    """
    library = ctypes.CDLL("libcuda.so.1")

    def call(name: str, *arguments: int) -> None:
        error = getattr(library, name)(*map(ctypes.c_void_p, arguments))
        if error:
            raise RuntimeError(f"{name} of the GPU's driver failed with {error}.")

    return call
