"""What besides the config decides a run's numbers: versions, device, flags of jax."""

import contextlib
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

import jaxpets

from ..errors import CheckpointError
from . import rundir

_PACKAGES = (
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "orbax-checkpoint",
    "mujoco",
    "mujoco-mjx",
    "numpy",
)
_FLAGS = {
    "x64": "jax_enable_x64",
    "prng_impl": "jax_default_prng_impl",
    "threefry_partitionable": "jax_threefry_partitionable",
    "matmul_precision": "jax_default_matmul_precision",
}
# A state continues differently, or not at all, where one of these has changed.
_MUST_MATCH = ("x64", "prng_impl")


def environment() -> dict[str, Any]:
    """Returns the environment of this process as JSON values."""
    device = jax.devices()[0]
    return {
        "jaxpets": jaxpets.__version__,
        "git": _git_commit(),
        "python": platform.python_version(),
        **{name: _version(name) for name in _PACKAGES},
        "backend": jax.default_backend(),
        "device_kind": device.device_kind,
        "device_count": jax.device_count(),
        "processor": _processor(),
        **{name: getattr(jax.config, flag) for name, flag in _FLAGS.items()},
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


def remember(path: Path, now: Mapping[str, Any]) -> list[str]:
    """Keeps the environment that a run began in, and says what is another one now.

    Args:
      path: of its file; what it lacks is added, what it has stays.
      now: entries of the environment.

    Returns:
      A line per difference.

    Raises:
      CheckpointError: as `compare_environment`, or if the file cannot be read.
      StorageError: if it cannot be written.
    """
    began = rundir.read_json(path) if path.exists() else {}
    if not isinstance(began, dict):
        raise CheckpointError(f"{path} is not an object. Restore or remove it.")
    lines = compare_environment(began, now)
    if now.keys() - began.keys():
        rundir.write_json(path, {**now, **began})
    return lines


def compare_environment(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Returns one line per difference that may change a resumed run's numbers.

    Args:
      old: `environment()` when the run began.
      new: `environment()` now.

    Raises:
      CheckpointError: x64 or the PRNG differs, so the run cannot go on.
    """
    changed = [name for name in new if name in old and old[name] != new[name]]
    lines = [f"{name} was {old[name]} and is now {new[name]}" for name in changed]
    fatal = [
        line for name, line in zip(changed, lines, strict=True) if name in _MUST_MATCH
    ]
    if fatal:
        raise CheckpointError(
            f"this run cannot go on here: {'; '.join(fatal)}. Set JAX_ENABLE_X64 and "
            "JAX_DEFAULT_PRNG_IMPL as they were, or use another run directory."
        )
    return lines


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    """Returns the model of the processor; results in float32 may depend on it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def _git_commit() -> str | None:
    """Returns the commit of the checkout this file is in, `-dirty` if it was edited."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():  # Installed, perhaps inside another repository.
        return None
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(
            command, cwd=root, capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
