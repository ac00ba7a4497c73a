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

_CPU = 1  # DLPack's number of it


def host_call(
    function: Callable[[np.ndarray], np.ndarray], size: int
) -> Callable[[Array], Array]:
    """Builds a function of JAX that is a function of NumPy on the host.

    `jax.pure_callback` does the same, but it makes arrays of JAX of what NumPy reads,
    which takes longer than a step of MuJoCo. It is used where there is no other way.

    Args:
      function: `[..., I] -> [..., size]`, float32. What it gets may not be written to,
        and is another's memory once it has returned. It must not call JAX, which could
        wait for itself for ever.
      size: of the last axis of what it returns.

    Returns:
      `[I] -> [size]`, float32. A call fails if it gets another number of axes, or if
      `function` returns another shape. Under any nest of `jax.vmap` the host is called
      once for the whole batch; of a program over several devices each calls it, under
      `jax.shard_map` with its own share. It has no gradient.
    """

    def rows_of(inputs: np.ndarray) -> np.ndarray:
        inputs.flags.writeable = False
        rows = np.ascontiguousarray(function(inputs), np.float32)
        wanted = (*inputs.shape[:-1], size)
        if rows.shape != wanted:
            raise ValueError(
                f"the host's function must return {[*wanted]}, got {[*rows.shape]}."
            )
        return rows

    def through(context: Any, out: Any, inputs: Any) -> None:
        # Of the memory and not of the program: JAX takes an eager call's platform to be
        # the default one, wherever its array is.
        if inputs.__dlpack_device__()[0] == _CPU:
            np.asarray(out)[...] = rows_of(np.asarray(inputs))
            return
        cuda, stream = _driver(), context.stream
        rows = np.empty(inputs.shape, np.float32)
        cuda("cuMemcpyDtoHAsync_v2", _here(rows), _there(inputs), rows.nbytes, stream)
        cuda("cuStreamSynchronize", stream)
        rows = rows_of(rows)
        cuda("cuMemcpyHtoDAsync_v2", _there(out), _here(rows), rows.nbytes, stream)
        cuda("cuStreamSynchronize", stream)  # the rows are gone after this

    def elsewhere(inputs: Any) -> np.ndarray:
        return rows_of(np.asarray(inputs))

    shape = jax.ShapeDtypeStruct((size,), jnp.float32)
    vmapped: Any = {"vmap_method": "broadcast_all"}
    direct: Any = cast(Any, buffer_callback)(through, shape, **vmapped)
    default = functools.partial(jax.pure_callback, elsewhere, shape, **vmapped)

    def call(inputs: Array) -> Array:
        if inputs.ndim != 1:  # a GPU would be given as many rows as there are
            raise ValueError(f"inputs must have one axis, [I], got {[*inputs.shape]}.")
        choose: Any = jax.lax.platform_dependent
        return choose(
            inputs.astype(jnp.float32), cpu=direct, cuda=direct, default=default
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
