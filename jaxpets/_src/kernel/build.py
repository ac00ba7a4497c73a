"""Compiling the kernel for one model, once, and handing it to XLA."""

import contextlib
import ctypes
import enum
import functools
import hashlib
import importlib.resources
import importlib.util
import os
import platform
import re
import shutil
import signal
import subprocess
import threading
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxpets._src.kernel import cache

# Seconds until a compiler is ended. A kernel takes three, and ten on a GPU.
_LIMIT, _GPU_LIMIT = 120.0, 300.0


class Kind(enum.Enum):
    """What is built: its source file, and whose layout it reads."""

    WGMMA = "wgmma_rollout.cu", "wgmma"  # for Hopper
    MMA = "mma_rollout.cu", "mma"  # for GPUs of compute capability 8.0 and later
    WGMMA_REFERENCE = "gpu_reference.cc", "wgmma"  # a GPU's arithmetic, on a CPU
    MMA_REFERENCE = "gpu_reference.cc", "mma"
    CPU = "cpu_rollout.cc", "cpu"
    FIT = "fit_epoch.cu", "fit"  # training, for Hopper
    FIT_REFERENCE = "fit_reference.cc", "fit"  # the same source, on a CPU
    PHYSICS = "physics.cc", "physics"  # C MuJoCo

    @property
    def source(self) -> str:
        """The file that is compiled."""
        return self.value[0]

    @property
    def layout(self) -> str:
        """Which of the layouts it reads."""
        return self.value[1]

    @property
    def symbol(self) -> str:
        """What a target's name begins with, and but for `symbols` a function's is."""
        known = {"fit": "jaxpets_fit", "physics": "jaxpets_physics"}
        return known.get(self.layout, "jaxpets_rollout")

    @property
    def symbols(self) -> dict[str, str]:
        """The functions that XLA calls, by their platforms."""
        if self is Kind.PHYSICS:  # which is on the host, wherever its operands are
            return {"cpu": self.symbol, "CUDA": f"{self.symbol}_cuda"}
        return {"CUDA" if self.is_for_gpu else "cpu": self.symbol}

    @property
    def is_for_gpu(self) -> bool:
        """Whether it runs on a GPU."""
        return self.source.endswith(".cu")


class BuildError(Exception):
    """No kernel: a compiler is missing or failed. The message is one line."""


class Kernel(NamedTuple):
    """A kernel that XLA may call."""

    target: str  # its name among XLA's FFI targets
    compiler: str  # name and version of what built it
    library: Any = None  # what else it has, as functions of C


def load_kernel(
    model: str, kind: Kind, arch: str = "", needs: tuple[str, ...] = ()
) -> Kernel:
    """Returns what `build_kernel` does, by which it is built once in this process."""
    with _ONE_AT_A_TIME:  # as XLA takes no target twice
        return _built(model, kind, arch, needs)


def build_kernel(
    model: str, kind: Kind, arch: str = "", needs: tuple[str, ...] = ()
) -> Kernel:
    """Compiles a kernel for a model and registers it with XLA.

    The library is kept for the next process, see `cache`.

    Args:
      model: the text of `model.h`.
      kind: what to build.
      arch: of the GPU, as nvcc calls it: sm_90a.
      needs: flags of the compiler for another library.

    Raises:
      BuildError: if it cannot be built.
    """
    if os.name != "posix":
        raise BuildError("kernels are built on Linux and macOS only")
    compiler = _compiler(kind, arch)
    version = _version(compiler[0])
    recipe = [jax.__version__, *compiler, *needs, version]
    if kind is Kind.CPU:
        # A folder that machines share has a library for every kind of processor.
        recipe.append(_processor(compiler))
    sources = {**_shipped_sources(), "model.h": model}
    digest = hashlib.sha256("\0".join([*recipe, *sources.values()]).encode())
    target = f"{kind.symbol}_{kind.name.lower()}_{digest.hexdigest()[:16]}"
    make = functools.partial(_compile, compiler, sources, kind, needs)
    try:
        with cache.library(target, make) as library:
            loaded, handlers = _loaded(library, kind)
    except OSError as error:
        raise BuildError(f"there is no folder to build it in: {error}") from error
    for platform_name, handler in handlers.items():
        capsule = jax.ffi.pycapsule(handler)
        jax.ffi.register_ffi_target(target, capsule, platform=platform_name)
    return Kernel(target, version, loaded)


_built = functools.cache(build_kernel)
_ONE_AT_A_TIME = threading.Lock()


def _shipped_sources() -> dict[str, str]:
    """Returns the C++ and CUDA files beside this one, by name."""
    files = importlib.resources.files("jaxpets._src.kernel").iterdir()
    texts = {
        file.name: file.read_text()
        for file in files
        if file.name.endswith((".h", ".cc", ".cu"))
    }
    return dict(sorted(texts.items()))


def _compile(
    compiler: list[str], sources: dict[str, str], kind: Kind, needs: tuple[str, ...],
    folder: Path,
) -> Path:  # fmt: skip
    """Compiles in an empty folder and returns the library's file."""
    for file, text in sources.items():
        (folder / file).write_text(text)
    library = folder / "library.so"
    include = [f"-I{folder}", f"-I{jax.ffi.include_dir()}"]
    command = [*compiler, *include, "-o", str(library), str(folder / kind.source)]
    command += needs
    _run(command, _GPU_LIMIT if kind.is_for_gpu else _LIMIT)
    return library


def _loaded(library: Path, kind: Kind) -> tuple[Any, dict[str, Any]]:
    """Returns a library, and what it has for each platform as functions of C."""
    try:
        loaded = ctypes.CDLL(str(library))
        handlers = {name: getattr(loaded, x) for name, x in kind.symbols.items()}
    except (OSError, AttributeError) as error:
        raise BuildError(f"cannot load the compiled kernel: {error}") from error
    if kind is Kind.FIT:
        loaded.jaxpets_problem.restype = ctypes.c_char_p
        if problem := loaded.jaxpets_problem():
            raise BuildError(problem.decode())
    return loaded, handlers


def _run(command: list[str], limit: float) -> str:
    """Returns what a compiler prints.

    Raises:
      BuildError: if it cannot be run, fails, or takes more than `limit` seconds.
    """
    name = Path(command[0]).name
    try:
        # In a process group of its own: what the compiler starts ends with it.
        with subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            process_group=0,
        ) as process:
            try:
                output, said = process.communicate(timeout=limit)
            except BaseException:  # the user's interrupt too: it reaches us alone
                with contextlib.suppress(OSError):
                    os.killpg(process.pid, signal.SIGKILL)
                raise
    except subprocess.TimeoutExpired as error:
        raise BuildError(f"{name} was not done in {limit:g} seconds") from error
    except OSError as error:
        raise BuildError(f"cannot run {name}: {error}") from error
    if process.returncode:
        lines = [line for line in said.splitlines() if "error" in line]
        first = (lines or said.splitlines() or ["no message"])[0]
        raise BuildError(f"{name} failed: {first}")
    return output


def _compiler(kind: Kind, arch: str = "") -> list[str]:
    """Returns the command that builds a library, without the files."""
    if kind.is_for_gpu:
        return _nvcc(arch)
    if kind is not Kind.CPU:
        return _host_compiler()
    is_x86 = platform.machine().lower() in ("x86_64", "amd64")
    flags = ["-O3", "-march=native" if is_x86 else "-mcpu=native"]
    # Loops that might set errno or trap do not become vector instructions.
    return [*_host_compiler(), *flags, "-fno-math-errno", "-fno-trapping-math"]


def _host_compiler() -> list[str]:
    for name in ("c++", "g++", "clang++"):
        if path := shutil.which(name):
            return [path, "-std=c++17", "-O2", "-shared", "-fPIC"]
    raise BuildError("no C++ compiler found (c++, g++ or clang++)")


def _version(compiler: str) -> str:
    """Returns a compiler's name and version, as it says them."""
    lines = _run([compiler, "--version"], _LIMIT).splitlines()
    named = (line.strip() for line in lines if re.search(r"\d\.\d", line))
    return next(named, "unknown")


def _processor(compiler: list[str]) -> str:
    """Returns what the compiler defines for this processor.

    Raises:
      BuildError: if it does not know the processor, or that cannot multiply and add at
        once, without which every step of a polynomial is a call.
    """
    defined = _run([*compiler, "-E", "-dM", "-x", "c++", os.devnull], _LIMIT)
    if not re.search(r"\b(__FMA__|__ARM_FEATURE_FMA)\b", defined):
        raise BuildError("the processor has no fused multiply-add")
    return defined


def _nvcc(arch: str) -> list[str]:
    flags = ["-std=c++17", "-O3", "-shared", "-Xcompiler=-fPIC"]
    flags += [f"-gencode=arch={arch.replace('sm', 'compute')},code={arch}"]
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
