"""Trajectory sampling as one GPU kernel: all steps of all particles in one launch."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_count
from jaxpets._src.ensemble import (
    EnsembleConfig,
    EnsembleParams,
    Precision,
    ensemble,
    imagined_range,
)
from jaxpets._src.kernel.build import BuildError, load_kernel
from jaxpets._src.kernel.row_code import UnsupportedError, row_function
from jaxpets._src.kernel.shape import KernelShape
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
    """Builds the particle rollout of an ensemble as one kernel for Hopper GPUs.

    It computes what `particle_rollout(ensemble(config, space, ...).sample, ...)` does,
    with the same noise for the same key. Products read float16 and add up in float32:
    closer to float32 than the scan in bfloat16. Where there can be no kernel the scan
    runs, and a warning of one line says why:

    - `config.precision` is not BF16, the only precision the kernel has;
    - the first device is no GPU of compute capability 9.0 (H100, H200, GH200);
    - a hidden layer has more than 256 units, an observation more than 128 entries, or
      features and action together more than 256;
    - `space` does more than arithmetic on single entries, moving them and summing;
    - there is no compiler: the kernel is built for the model at the first call, in
      half a minute, and kept in the user's cache folder;
    - keys are not of JAX's default kind, partitionable threefry.

    Any number of members, particles, candidates, steps and hidden layers will do, and
    any nest of up to four `jax.vmap`.

    Args:
      config: of the ensemble.
      space: coordinates of the ensemble.
      obs_size: D.
      action_size: A.
      num_particles: E * P, over all members.
      interpret: run the kernel's arithmetic on the CPU, slowly, for tests.

    Returns:
      A RolloutFn whose params are the ensemble's, and whose start is `[D]`.

    Raises:
      TypeError, ValueError: as `ensemble` and `particle_rollout`.
    """
    model = ensemble(config, space, obs_size=obs_size, action_size=action_size)
    scan = particle_rollout(
        model.sample, num_members=config.num_members, num_particles=num_particles
    )
    check_count("num_particles", num_particles)
    feature_size = space.features(jnp.zeros((obs_size,), jnp.float32)).shape[-1]
    shape = KernelShape(obs_size, action_size, feature_size, config.hidden_sizes)
    try:
        target = _target(config, space, shape, interpret=interpret)
    except (BuildError, UnsupportedError) as error:
        warnings.warn(f"fused_rollout runs as a scan: {error}.", stacklevel=2)
        return scan
    per_member = num_particles // config.num_members

    def rollout(
        params: EnsembleParams, key: Array, obs: Array, actions: Array
    ) -> Array:
        check_array("obs", obs, [obs_size])
        check_array("actions", actions, ["N", "H", action_size])
        if not _is_counted(key):
            warnings.warn(
                "fused_rollout runs as a scan: keys are not partitionable threefry.",
                stacklevel=2,
            )
            return scan(params, key, obs, actions)
        num_samples, horizon, _ = actions.shape
        layers = params.network.members["params"]
        names = [f"layer_{i}" for i in range(len(layers))]
        weights = shape.pack([layers[name] for name in names])
        path = jax.ShapeDtypeStruct(
            (num_samples, horizon + 1, config.num_members, per_member, obs_size),
            jnp.float32,
        )
        call = jax.ffi.ffi_call(target, path, vmap_method="expand_dims")
        keys = jax.random.key_data(jax.random.split(key, horizon))
        return call(weights, _shared(config, params), keys, obs, actions)

    return rollout


def _target(
    config: EnsembleConfig, space: ModelSpace, shape: KernelShape, *, interpret: bool
) -> str:
    """Returns the FFI target of a kernel for this model, built if need be."""
    if config.precision is not Precision.BF16:
        raise UnsupportedError(f"the precision is {config.precision.value}, not bf16")
    if problem := shape.problem():
        raise UnsupportedError(problem)
    if not interpret:
        _check_device(jax.devices()[0])
    rows = {name: shape.obs_size for name in ("obs", "target", "low", "high")}
    functions = {
        "features": (space.features, ("obs",)),
        "next_obs": (space.next_obs, ("obs", "target")),
        "bound": (space.bound, ("obs", "low", "high")),
    }
    code = [
        row_function(name, function, [(row, rows[row]) for row in arguments])
        for name, (function, arguments) in functions.items()
    ]
    products = [] if interpret else [shape.products()]
    model = ['#pragma once\n#include "row.h"', shape.header(), *code, *products]
    return load_kernel("\n".join(model), cuda=not interpret)


def _check_device(device: Any) -> None:
    if device.platform != "gpu":
        raise UnsupportedError(f"the device is a {device.platform}, not a GPU")
    capability = getattr(device, "compute_capability", "unknown")
    if capability != "9.0":
        raise UnsupportedError(f"the GPU's compute capability is {capability}, not 9.0")


def _is_counted(key: Array) -> bool:
    """Whether element i of a draw depends on the key and i alone, as in the kernel."""
    is_threefry = jax.random.key_impl(key) == "threefry2x32"
    return is_threefry and bool(jax.config.jax_threefry_partitionable)  # pyright: ignore


def _shared(config: EnsembleConfig, params: EnsembleParams) -> Array:
    """Returns the numbers that all members read, in the kernel's order."""
    network, scaler = params.network, params.scaler
    low, high = imagined_range(config, scaler)
    parts = [scaler.mean, 1.0 / scaler.std, low, high]
    parts += [jnp.exp(network.min_logvar), jnp.exp(-network.max_logvar)]
    return jnp.concatenate(parts)
