"""Compiled programs, kept for the next time."""

import os
import stat
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache


def keep() -> None:
    """Has JAX keep what it compiles in a folder of the user's, unless told where.

    To load a program is to run it: where others may write, nothing is kept.
    """
    config: Any = jax.config
    if config.jax_compilation_cache_dir:
        return
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home, "jaxpets", "programs")
        # Whatever the umask is: kernels are kept in the one above, if it is private.
        for path in reversed((folder, *folder.parents)):
            path.mkdir(mode=0o700, exist_ok=True)
        found = folder.stat()
    except (OSError, RuntimeError):  # the latter where there is no home folder
        return
    others = stat.S_IWGRP | stat.S_IWOTH
    if found.st_uid == os.getuid() and not found.st_mode & others:
        config.update("jax_compilation_cache_dir", str(folder))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
        compilation_cache.reset_cache()  # which a first program has found without it


def keep_on_gpu() -> None:
    """Does so where programs are for a GPU.

    For some CPUs JAX refuses what it has kept, and says so of every program.
    """
    if jax.default_backend() == "gpu":
        keep()
