"""C MuJoCo called by XLA itself, without Python: on CPUs and beside NVIDIA's GPUs."""

import ctypes
import functools
import hashlib
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.kernel.build import BuildError, Kernel, Kind, load_kernel
from jaxpets.envs.extra import needs_extra

with needs_extra():
    import mujoco

_C: Any = mujoco


def c_function(
    model: Any,
    size: int,
    *,
    num_threads: int,
    num_substeps: int,
    clock: tuple[float, float],
    places: Sequence[tuple[str, int]] = (),
) -> Callable[[Array], Array] | None:
    """Builds a function of JAX that has C MuJoCo visit every row of a batch.

    A compiled program knows it by a name, which is that of the same model and settings
    in every process. So JAX's compilation cache keeps such programs. Threads and states
    go with the function; a program that is still called after that makes its own, every
    time. Functions of one model and the same settings are one, and called in turn.

    Args:
      model: a compiled MuJoCo model.
      size: R, how many numbers are returned for a row.
      num_threads: at most this many.
      num_substeps: steps of a row; with 0 it is read.
      clock: where it starts, and below which it was set back.
      places: what is read, as `native_readings` takes it.

    Returns:
      `[I] -> [R]`, float32, or None if it cannot be built, as without a compiler. Under
      any nest of `jax.vmap` it is one call. It has no gradient, and runs on CPUs and
      NVIDIA GPUs, where rows are copied to the host and back.
    """
    kernel = _kernel()
    if kernel is None:
        return None
    read = [(str(array), int(place)) for array, place in places]
    settings = (_C.mj_versionString(), num_threads, num_substeps, *clock, read)
    name = hashlib.sha256(_bytes(model) + repr(settings).encode()).hexdigest()
    arrays = (ctypes.c_char_p * len(read))(*(array.encode() for array, _ in read))
    numbers = (ctypes.c_int * len(read))(*(place for _, place in read))
    start, least = map(ctypes.c_double, clock)
    kernel.library.jaxpets_open.restype = ctypes.c_bool
    if not kernel.library.jaxpets_open(
        name.encode(), ctypes.c_void_p(model._address), num_threads, num_substeps,
        start, least, len(read), arrays, numbers,
    ):  # fmt: skip
        raise MemoryError("there is no memory for another model of MuJoCo.")
    shape = jax.ShapeDtypeStruct((size,), jnp.float32)
    visit = jax.ffi.ffi_call(kernel.target, shape, vmap_method="broadcast_all")

    def call(inputs: Array) -> Array:
        return visit(inputs.astype(jnp.float32), name=name)

    weakref.finalize(call, kernel.library.jaxpets_close, name.encode())
    return call


@functools.cache
def _kernel() -> Kernel | None:
    """Returns what XLA calls, or None; a compiler that fails is asked once."""
    try:
        return load_kernel("", Kind.PHYSICS, needs=_flags())
    except BuildError:
        return None


def _bytes(model: Any) -> bytes:
    """Returns all that a compiled model is."""
    buffer = np.empty(_C.mj_sizeModel(model), np.uint8)
    _C.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def _flags() -> tuple[str, ...]:
    """Returns what a compiler needs for MuJoCo, as its Python package brings it.

    Raises:
      BuildError: if it does not.
    """
    folder = Path(mujoco.__file__).resolve().parent
    found = [*folder.glob("libmujoco.so.*"), *folder.glob("libmujoco.*.dylib")]
    if not found or not (folder / "include").is_dir():
        raise BuildError("there is no library of MuJoCo in its package")
    path = ("-Xlinker", "-rpath", "-Xlinker", str(folder))  # may have a comma in it
    return f"-I{folder / 'include'}", str(found[0]), *path
