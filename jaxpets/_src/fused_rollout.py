"""Trajectory sampling as one kernel: all steps of all particles in one call."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_flag
from jaxpets._src.chunks import WINDOW
from jaxpets._src.ensemble import ensemble
from jaxpets._src.ensemble_config import EnsembleConfig
from jaxpets._src.ensemble_params import EnsembleParams, imagined_range
from jaxpets._src.kernel.build import BuildError, Kind, load_kernel
from jaxpets._src.kernel.row_code import UnsupportedError, row_function
from jaxpets._src.kernel.shape import KernelShape
from jaxpets._src.kernel.tiles import TileShape
from jaxpets._src.network import Precision
from jaxpets._src.rollout import particle_rollout
from jaxpets._src.types import ModelSpace, RolloutFn


def fused_rollout(
    config: EnsembleConfig,
    space: ModelSpace,
    *,
    obs_size: int,
    action_size: int,
    num_particles: int,
    interpret: bool = False,
) -> RolloutFn:
    """Builds the particle rollout of an ensemble as one kernel, for H100s and CPUs.

    It computes what `particle_rollout(ensemble(config, space, ...).sample, ...)` does,
    with the same noise for the same key. On a CPU products read and add up float32,
    whatever the precision. On a GPU they read float16 and add up in float32: closer to
    float32 than the scan in bfloat16, but an input of the network, or of one of its
    layers, beyond 65504 is infinite and leads to NaN, which a planner counts as the
    worst. The kernel is for the kind of the first device of `jax.devices()`; on another
    kind a call fails. Where there can be none the scan runs, in the precision of
    `config`, and a warning of one line says why:

    - `space` does more than arithmetic on single entries, moving them and summing, or
      makes next observations of another size;
    - there is no compiler (nvcc; c++, g++ or clang++): the kernel is built for the
      model at the first call, in half a minute on a GPU and in seconds on a CPU, and
      kept in the user's cache folder;
    - keys are not of JAX's default kind, partitionable threefry;
    - the device is neither a CPU nor a GPU of compute capability 9.0 (H100, H200,
      GH200);
    - on a GPU, `config.precision` is not BF16, a hidden layer has more than 256 units,
      an observation more than 128 entries, or features and action together more than
      256.

    Any number of members, particles, candidates, steps and hidden layers will do, and
    any nest of up to four `jax.vmap`.

    Args:
      config: of the ensemble.
      space: coordinates of the ensemble.
      obs_size: D.
      action_size: A.
      num_particles: E * P, over all members.
      interpret: run the GPU kernel's arithmetic on the CPU, slowly, for tests.

    Returns:
      A RolloutFn whose params are the ensemble's, and whose start is `[D]`.

    Raises:
      TypeError, ValueError: as `ensemble` and `particle_rollout`.
    """
    check_flag("interpret", interpret)
    model = ensemble(config, space, obs_size=obs_size, action_size=action_size)
    scan = particle_rollout(
        model.sample, num_members=config.num_members, num_particles=num_particles
    )
    feature_size = space.features(jnp.zeros((obs_size,), jnp.float32)).shape[-1]
    sizes = (obs_size, action_size, feature_size, config.hidden_sizes)
    device = jax.devices()[0]
    try:
        if device.platform == "cpu" and not interpret:
            kind, shape = Kind.CPU, TileShape(*sizes)
        else:
            kind = Kind.REFERENCE if interpret else Kind.GPU
            shape = KernelShape(*sizes)
            _check_shape(config, shape)
        if kind is Kind.GPU:
            _check_device(device)
        target = _target(config, space, shape, kind)
    except (BuildError, UnsupportedError) as error:
        warnings.warn(f"fused_rollout runs as a scan: {error}.", stacklevel=2)
        return scan

    def bind(params: EnsembleParams) -> Callable[[Array, Array, Array], Array]:
        layers = params.network.members["params"]
        weights = shape.pack([layers[f"layer_{i}"] for i in range(len(layers))])
        shared = _shared(config, params)

        def rollout(key: Array, obs: Array, actions: Array) -> Array:
            check_array("obs", obs, [obs_size])
            check_array("actions", actions, ["N", "H", action_size])
            if not _is_counted(key):
                problem = "keys are not partitionable threefry"
                warnings.warn(f"fused_rollout runs as a scan: {problem}.", stacklevel=2)
                return scan(params, key, obs, actions)
            # The scan knows what params must be; the kernel would read past their end.
            path = jax.eval_shape(scan, params, key, obs, actions)
            num_samples, horizon, _ = actions.shape
            call = jax.ffi.ffi_call(target, path, vmap_method="expand_dims")
            return call(weights, shared, _keys(key, horizon, num_samples), obs, actions)

        return rollout

    return _FusedRollout(bind)


@dataclasses.dataclass(frozen=True)
class _FusedRollout:
    """A RolloutFn; `bind` lays the weights out for the kernel, once for many calls."""

    bind: Callable[[EnsembleParams], Callable[[Array, Array, Array], Array]]

    def __call__(
        self, params: EnsembleParams, key: Array, obs: Array, actions: Array
    ) -> Array:
        return self.bind(params)(key, obs, actions)


def _target(
    config: EnsembleConfig,
    space: ModelSpace,
    shape: KernelShape | TileShape,
    kind: Kind,
) -> str:
    """Returns the FFI target of a kernel for this model, built if need be."""
    rows = {name: shape.obs_size for name in ("obs", "target", "low", "high")}
    is_free = config.state_margin is None
    functions = {
        "features": (space.features, ("obs",)),
        "next_obs": (space.next_obs, ("obs", "target")),
        "bound": (_free if is_free else space.bound, ("obs", "low", "high")),
    }
    for name in ("next_obs", "bound"):
        function, arguments = functions[name]
        _check_result(name, function, len(arguments), shape.obs_size)
    code = [
        row_function(name, function, [(row, rows[row]) for row in arguments])
        for name, (function, arguments) in functions.items()
    ]
    model = ['#pragma once\n#include "row.h"', shape.header(), *code]
    if kind is Kind.GPU and isinstance(shape, KernelShape):
        model.append(shape.products())
    return load_kernel("\n".join(model), kind)


def _free(obs: Array, low: Array, high: Array) -> Array:
    del low, high
    return obs


def _check_result(
    name: str, function: Callable[..., Array], num_arguments: int, obs_size: int
) -> None:
    """Checks that a result is as long as the kernel's room for it."""
    row = jax.ShapeDtypeStruct((obs_size,), jnp.float32)
    shape = jax.eval_shape(function, *[row] * num_arguments).shape
    if shape != row.shape:
        raise UnsupportedError(f"{name} makes {list(shape)} of [{obs_size}]")


def _check_shape(config: EnsembleConfig, shape: KernelShape) -> None:
    """Checks what a GPU's kernel needs and a CPU's does not."""
    if config.precision is not Precision.BF16:
        raise UnsupportedError(f"the precision is {config.precision.value}, not bf16")
    if problem := shape.problem():
        raise UnsupportedError(problem)


def _check_device(device: Any) -> None:
    if device.platform != "gpu":
        raise UnsupportedError(f"the device is a {device.platform}, not a GPU or CPU")
    capability = getattr(device, "compute_capability", "unknown")
    if capability != "9.0":
        raise UnsupportedError(f"the GPU's compute capability is {capability}, not 9.0")


def _is_counted(key: Array) -> bool:
    """Whether element i of a draw depends on the key and i alone, as in the kernel."""
    is_threefry = str(jax.random.key_impl(key)) in ("threefry2x32", WINDOW)
    return is_threefry and bool(jax.config.jax_threefry_partitionable)  # pyright: ignore


def _keys(key: Array, horizon: int, num_samples: int) -> Array:
    """Returns the keys of the steps and which candidates to draw for, `[H, 4]`."""
    data = jax.random.key_data(jax.random.split(key, horizon))
    if data.shape[-1] == 4:
        return data  # a window of more candidates
    all_here = jnp.array([0, num_samples], jnp.uint32)
    return jnp.concatenate([data, jnp.broadcast_to(all_here, data.shape)], axis=-1)


def _shared(config: EnsembleConfig, params: EnsembleParams) -> Array:
    """Returns the numbers that all members read, in the kernel's order."""
    network, scaler = params.network, params.scaler
    low, high = imagined_range(config, scaler)
    parts = [scaler.mean, 1.0 / scaler.std, low, high]
    parts += [jnp.exp(network.min_logvar), jnp.exp(-network.max_logvar)]
    return jnp.concatenate([jnp.pad(part, (0, -part.size % 4)) for part in parts])
