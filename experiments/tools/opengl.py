"""OpenGL that works here: found by children, whom it may crash."""

import os
import subprocess
import sys
from pathlib import Path

from ..errors import RunError
from .renderer import NO_GL

BACKENDS = ("egl", "osmesa")
_GL_HINT = (
    "on Debian or Ubuntu install libegl1 libopengl0 libgl1-mesa-dri"
    " (or libosmesa6, with MUJOCO_GL=osmesa)"
)


def backend() -> str:
    """Returns the backend of OpenGL that videos are drawn by, MUJOCO_GL if it is set.

    Raises:
      RunError: if none works here; one line says why, and what to install.
    """
    return in_child("renderer", [])


def in_child(module: str, words: list[str]) -> str:
    """Runs a module beside this one, and returns the backend with which it worked."""
    command = [sys.executable, "-m", f"{__package__}.{module}", *words]
    chosen = os.environ.get("MUJOCO_GL")
    failures = []
    for backend in (chosen,) if chosen else BACKENDS:
        variables = _child_env(backend)
        child = subprocess.run(command, check=False, env=variables, capture_output=True)
        if child.returncode == 0:
            return backend
        said = child.stderr.decode(errors="replace").strip().splitlines()
        # Destructors may have a word after the error.
        errors = [line for line in said if line.startswith("error: ")] or said
        reason = errors[-1].removeprefix("error: ") if errors else "it said nothing"
        if child.returncode < 0:  # a GL driver that crashes is as good as none
            reason = f"ended by signal {-child.returncode}"
        elif child.returncode != NO_GL:
            raise RunError(reason)
        failures.append(f"{backend}: {reason}")
    raise RunError(f"cannot render a video, {'; '.join(failures)}. {_GL_HINT}")


def _child_env(backend: str) -> dict[str, str]:
    """Returns the environment in which a child renders and leaves the GPU to JAX."""
    here = Path(__file__).resolve().parents[2]
    path = os.pathsep.join(filter(None, [str(here), os.environ.get("PYTHONPATH")]))
    own = {"MUJOCO_GL": backend, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path}
    return os.environ | own
