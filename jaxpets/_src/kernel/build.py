"""Compiling the kernel for one model, once, and handing it to XLA."""

import ctypes
import functools
import hashlib
import importlib.resources
import importlib.util
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax

_SOURCES = ("row.h", "rollout.h", "handler.h", "wgmma.h", "rollout.cu", "reference.cc")
_SYMBOL = "jaxpets_rollout"


class BuildError(Exception):
    """No kernel: a compiler is missing or failed. The message is one line."""


@functools.cache
def load_kernel(model: str, *, cuda: bool) -> str:
    """Compiles the rollout for a model and registers it; returns its FFI target.

    The library is kept in the user's cache folder and found there by the next process.

    Args:
      model: the text of `model.h`.
      cuda: the kernel, else the reference for CPUs.

    Raises:
      BuildError: if it cannot be built.
    """
    compiler = _nvcc() if cuda else _host_compiler()
    folder = importlib.resources.files("jaxpets._src.kernel")
    sources = {name: (folder / name).read_text() for name in _SOURCES}
    sources["model.h"] = model
    recipe = [model, *sources.values(), *compiler, jax.__version__]
    digest = hashlib.sha256("\0".join(recipe).encode()).hexdigest()[:16]
    target = f"{_SYMBOL}_{'cuda' if cuda else 'cpu'}_{digest}"
    library = _cache_folder() / f"{target}.so"
    main = "rollout.cu" if cuda else "reference.cc"
    try:
        if not library.exists():
            _compile(compiler, sources, main, library)
    except OSError as error:
        raise BuildError(f"cannot write to the cache folder: {error}") from error
    try:
        handler = getattr(ctypes.CDLL(str(library)), _SYMBOL)
    except OSError as error:
        raise BuildError(f"cannot load the compiled kernel: {error}") from error
    platform = "CUDA" if cuda else "cpu"
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(handler), platform=platform)
    return target


def _compile(
    compiler: list[str], sources: dict[str, str], main: str, library: Path
) -> None:
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(text)
        built = folder / library.name
        include = [f"-I{name}", f"-I{jax.ffi.include_dir()}"]
        command = [*compiler, *include, "-o", str(built), str(folder / main)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "error" in line]
            first = (lines or done.stderr.splitlines() or ["no message"])[0]
            raise BuildError(f"{Path(compiler[0]).name} failed: {first}")
        os.replace(built, library)  # whole or not at all, with others building too


def _cache_folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "jaxpets"


def _host_compiler() -> list[str]:
    for name in ("c++", "g++", "clang++"):
        if path := shutil.which(name):
            return [path, "-std=c++17", "-O2", "-shared", "-fPIC"]
    raise BuildError("no C++ compiler found (c++, g++ or clang++)")


def _nvcc() -> list[str]:
    flags = ["-std=c++17", "-O3", "-shared", "-Xcompiler=-fPIC"]
    # wgmma needs the variant "a" of the architecture.
    flags += ["-gencode=arch=compute_90a,code=sm_90a"]
    if path := shutil.which("nvcc"):
        return [path, *flags]
    if home := os.environ.get("CUDA_HOME"):
        path = Path(home) / "bin" / "nvcc"
        if path.exists():
            return [str(path), *flags]
    # The extra `cuda13` of jax brings a whole compiler.
    spec = importlib.util.find_spec("nvidia")
    for folder in spec.submodule_search_locations or () if spec else ():
        root = Path(folder) / "cu13"
        if (root / "bin" / "nvcc").exists():
            return [str(root / "bin" / "nvcc"), *flags, f"-L{root / 'lib'}"]
    raise BuildError("no nvcc found; pip install 'jaxpets[cuda13]' brings one")
