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
        folder = Path(os.path.realpath(home), "jaxpets", "programs")
        # Whatever the umask is: kernels are kept in the one above, if it is private.
        for path in reversed((folder, *folder.parents)):
            path.mkdir(mode=0o700, exist_ok=True)
        is_private = _is_private(folder)
    except (OSError, RuntimeError):  # the latter where there is no home folder
        return
    if is_private:
        config.update("jax_compilation_cache_dir", str(folder))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
        compilation_cache.reset_cache()  # which a first program has found without it


def _is_private(folder: Path) -> bool:
    """Tells whether only we can change what is in a folder and in the one above.

    Where anybody may write further above, another could be put in their place, unless
    that one is sticky, as /tmp is.
    """
    for path in (folder, folder.parent):
        found = path.lstat()
        is_ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
        if not is_ours or found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return False
    modes = [path.stat().st_mode for path in folder.parents]
    return all(not x & stat.S_IWOTH or x & stat.S_ISVTX for x in modes)


def keep_on_gpu() -> None:
    """Does so where programs are for a GPU.

    For some CPUs JAX refuses what it has kept, and says so of every program.
    """
    if jax.default_backend() == "gpu":
        keep()
