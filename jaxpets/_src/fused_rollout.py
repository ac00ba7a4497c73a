"""Trajectory sampling as one kernel: all steps of all particles in one call."""

import dataclasses
import functools
import re
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_key, check_record
from jaxpets._src.chunks import WINDOW
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_config import EnsembleConfig
from jaxpets._src.ensemble_params import EnsembleParams, imagined_range
from jaxpets._src.kernel.build import BuildError, Kind, load_kernel
from jaxpets._src.kernel.cpu_layout import CpuLayout
from jaxpets._src.kernel.device import HOPPER, capability, is_hopper
from jaxpets._src.kernel.gpu_layout import GpuLayout
from jaxpets._src.kernel.jaxpr_to_cpp import UnsupportedError, cpp_function
from jaxpets._src.kernel.mma_layout import MmaLayout
from jaxpets._src.kernel.wgmma_layout import WgmmaLayout
from jaxpets._src.network import ACTIVATIONS, Precision
from jaxpets._src.rollout import particle_rollout
from jaxpets._src.types import ModelSpace

_LAYOUTS = {"wgmma": WgmmaLayout, "mma": MmaLayout, "cpu": CpuLayout}


@dataclasses.dataclass(frozen=True)
class FusedRollout:
    """What `fused_rollout` returns: a ModelRolloutFn that may be asked what it runs.

    Attributes:
      bind: `(EnsembleParams) -> (key, obs, actions) -> path`; lays the weights out for
        the kernel, once for many calls.
      reason: why the scan runs and no kernel; empty if the kernel does.
      compiler: name and version of the compiler of the kernel; empty if the scan runs.
        With another one, or on another processor, the last bits may be others.
      arch: of the GPU that the kernel was built for, as nvcc calls it; else empty.
    """

    bind: Callable[[EnsembleParams], Callable[[Array, Array, Array], Array]]
    reason: str = ""
    compiler: str = ""
    arch: str = ""

    @property
    def uses_kernel(self) -> bool:
        """Whether a kernel was built; a call with another kind of key still scans."""
        return not self.reason

    def __call__(
        self, params: EnsembleParams, key: Array, obs: Array, actions: Array, /
    ) -> Array:
        """Imagines, see RolloutFn."""
        return self.bind(params)(key, obs, actions)


def fused_rollout(
    model: Ensemble, *, num_particles: int, arch: str | None = None
) -> FusedRollout:
    """Builds the particle rollout of an ensemble as one kernel, for GPUs and CPUs.

    It computes what `particle_rollout(model.sample, ...)` does, with the same noise for
    the same key. On a CPU products read and add up float32, whatever the precision. On
    a GPU they read float16 and add up in float32: closer to float32 than the scan in
    bfloat16, but an input of the network, or of one of its layers, beyond 65504 is
    infinite and leads to NaN, which a planner counts as the worst. The kernel is for
    the kind of the first device of `jax.devices()`; on another kind a call fails. Where
    there can be none the scan runs, in the precision of the model. The result then
    says why in `reason`, `uses_kernel` is False, and a warning of one line is given:

    - the model's space does more than arithmetic on single entries, moving them and
      summing (the reason names the entries and the line of the code), or makes next
      observations of another size;
    - there is no compiler (nvcc; c++, g++ or clang++): the kernel is built for the
      model here, in seconds, and kept in the user's cache folder;
    - keys are not of JAX's default kind, partitionable threefry (only a call can know:
      it warns);
    - the device is neither a CPU nor a GPU of compute capability 8.0 or later (A100,
      RTX 30 and later). Those of 9.0 (H100, H200, GH200) have a kernel of their own,
      for layers of at most 256 units, observations of at most 128 entries and inputs
      of at most 256; larger models run there as on any other;
    - on a GPU, the precision is not BF16, a hidden layer has more than 512 units, an
      observation more than 256 entries, or features and action together more than 512.

    Any number of members, particles, candidates, steps and hidden layers will do, and
    any nest of up to four `jax.vmap`. A kernel has no gradient; `particle_rollout` has.

    Args:
      model: as `jaxpets.ensemble` built it. The kernel is made from its config and
        space: a `sample` of your own in their place would not be seen.
      num_particles: E * P, over all members.
      arch: for which GPU, as nvcc calls it: `sm_90` is for Hopper without instructions
        of its own, `sm_90a` with them. None for the first device's.

    Returns:
      A FusedRollout whose params are the ensemble's, and whose start is `[D]`.

    Raises:
      TypeError: if model is no Ensemble.
      ValueError: if model was not built by `jaxpets.ensemble`, num_particles is not a
        multiple of the number of members, or arch is not the name of a GPU.
    """
    kind = _kind_for(jax.devices()[0])
    if arch is not None:
        if not re.fullmatch(r"sm_\d+a?", str(arch)):
            raise ValueError(
                f"arch must be the name of a GPU, as sm_90a, got {arch!r}."
            )
        kind = Kind.WGMMA if arch == HOPPER else Kind.MMA
    rollout = rollout_of_kind(model, num_particles, kind, arch)
    if not rollout.uses_kernel and kind is Kind.WGMMA and arch is None:
        larger = rollout_of_kind(model, num_particles, Kind.MMA)
        rollout = larger if larger.uses_kernel else rollout
    if not rollout.uses_kernel:
        warnings.warn(f"fused_rollout runs as a scan: {rollout.reason}.", stacklevel=2)
    return rollout


def rollout_of_kind(
    model: Ensemble, num_particles: int, kind: Kind, arch: str | None = None
) -> FusedRollout:
    """Builds a `fused_rollout` with one kind of kernel, and does not warn of a scan."""
    config, space = _origin(model)
    scan = particle_rollout(
        model.sample, num_members=model.num_members, num_particles=num_particles
    )
    try:
        layout = _layout(model, config, space, kind)
        if arch is None:
            arch = _arch(jax.devices()[0], kind) if kind.is_for_gpu else ""
        kernel = load_kernel(_model_header(config, space, layout, kind), kind, arch)
    except (BuildError, UnsupportedError) as error:
        return FusedRollout(lambda params: functools.partial(scan, params), str(error))

    def bind(params: EnsembleParams) -> Callable[[Array, Array, Array], Array]:
        check_record("params", params, EnsembleParams)
        layers = params.network.members["params"]
        weights = layout.pack(
            [layers[f"layer_{i}"] for i in range(len(layers))], config.activation
        )
        shared = _shared(config, params)

        def rollout(key: Array, obs: Array, actions: Array) -> Array:
            check_key("key", key)
            check_array("obs", obs, [model.obs_size])
            check_array("actions", actions, ["N", "H", model.action_size])
            if not _is_counted(key):
                problem = "keys are not partitionable threefry"
                warnings.warn(f"fused_rollout runs as a scan: {problem}.", stacklevel=2)
                return scan(params, key, obs, actions)
            # The scan knows what params must be; the kernel would read past their end.
            path: jax.ShapeDtypeStruct = jax.eval_shape(scan, params, key, obs, actions)
            num_samples, horizon, _ = actions.shape
            call = jax.ffi.ffi_call(kernel.target, path, vmap_method="expand_dims")
            keys = _keys(key, horizon, num_samples)
            return call(weights, shared, keys, obs, actions)

        return rollout

    return FusedRollout(bind, compiler=kernel.compiler, arch=arch)


def _origin(model: Ensemble) -> tuple[EnsembleConfig, ModelSpace]:
    """Returns what a model was built from."""
    check_record("model", model, Ensemble)
    if model.config is None or model.space is None:
        raise ValueError(
            "model must be built by jaxpets.ensemble: a kernel is made from its config "
            f"and space, got {model.config!r} and {model.space!r}. For a model of your "
            "own use particle_rollout."
        )
    return model.config, model.space


def _layout(
    model: Ensemble, config: EnsembleConfig, space: ModelSpace, kind: Kind
) -> GpuLayout | CpuLayout:
    """Returns how the model lies in memory.

    Raises:
      UnsupportedError: if there is no kernel of this kind for it, or for the device.
    """
    features = space.features(jnp.zeros((model.obs_size,), jnp.float32))
    sizes = (model.obs_size, model.action_size, features.shape[-1], config.hidden_sizes)
    layout = _LAYOUTS[kind.layout](*sizes)
    if isinstance(layout, CpuLayout):
        return layout
    if config.precision is not Precision.BF16:
        raise UnsupportedError(f"the precision is {config.precision.value}, not bf16")
    if problem := layout.problem():
        raise UnsupportedError(problem)
    return layout


def _model_header(
    config: EnsembleConfig,
    space: ModelSpace,
    layout: GpuLayout | CpuLayout,
    kind: Kind,
) -> str:
    """Returns the text of model.h: the sizes and the coordinates of this model."""
    is_free = config.state_margin is None
    functions = {
        "features": (space.features, ("obs",)),
        "next_obs": (space.next_obs, ("obs", "target")),
        "bound": (_free if is_free else space.bound, ("obs", "low", "high")),
    }
    for name in ("next_obs", "bound"):
        function, arguments = functions[name]
        _check_result(name, function, len(arguments), layout.obs_size)
    code: list[str] = []
    for name, (function, arguments) in functions.items():
        rows = [(row, layout.obs_size) for row in arguments]
        called = {
            f"{row}[{i}]": entry.name
            for row in arguments
            for i, entry in enumerate(space.coordinates)
        }
        code.append(cpp_function(name, function, rows, called))
    activation = f"constexpr int ACTIVATION = {ACTIVATIONS.index(config.activation)};"
    begin = '#pragma once\n#include "particle.h"'
    header = [begin, layout.header(), activation, *code]
    if kind.is_for_gpu and isinstance(layout, GpuLayout):
        header.append(layout.products())
    return "\n".join(header)


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


def _kind_for(device: Any) -> Kind:
    if device.platform == "cpu":
        return Kind.CPU
    return Kind.WGMMA if is_hopper(device) else Kind.MMA


def _arch(device: Any, kind: Kind) -> str:
    """Returns what nvcc calls a GPU.

    Raises:
      UnsupportedError: if it is none that a kernel was written for.
    """
    if device.platform != "gpu":
        raise UnsupportedError(f"the device is a {device.platform}, not a GPU or CPU")
    major, minor = capability(device)
    if major < 8:
        seen = getattr(device, "compute_capability", "unknown")
        raise UnsupportedError(
            f"the GPU's compute capability is {seen}, not 8.0 or more"
        )
    return HOPPER if kind is Kind.WGMMA else f"sm_{major}{minor}"


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
