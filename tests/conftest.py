"""Settings of the whole suite: CPU, strict promotion, a scratch working directory."""

import atexit
import gc
import logging
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import quick_xla

# Before jax is imported. For the tests marked gpu: JAX_PLATFORMS=cuda,cpu.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

# Flags of the user's own come last, and win; processes that tests start inherit these.
if os.environ["JAX_PLATFORMS"] == "cpu":
    _flags = f"{quick_xla.FLAGS} {os.environ.get('XLA_FLAGS', '')}"
    os.environ["XLA_FLAGS"] = _flags.strip()

import jax
import pytest

# Tracing makes millions of small objects, few of them garbage; 700 is Python's own.
gc.set_threshold(50_000, 20, 20)

# Where orbax cannot read, it leaves tasks that have failed, and asyncio logs them when
# they are collected: in whichever test that is. Up to Python 3.11.7 a traceback that is
# formatted while `ast.parse` makes its tree, as here, makes that fail.
logging.getLogger("asyncio").disabled = True

# Strict promotion finds every place where the library leans on implicit casts.
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tests that trace the same program anew share its compilation, over all workers. The
# directory lives as long as the run; JAX_COMPILATION_CACHE_DIR names one that stays.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.mkdtemp(prefix="jaxpets-tests-")
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    jax.config.update("jax_compilation_cache_dir", _cache)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
# Kernels are built for this run too, and not kept in the user's cache folder.
os.environ["XDG_CACHE_HOME"] = os.environ["JAX_COMPILATION_CACHE_DIR"]

# Last on the path, so that an installed wheel is what gets tested; the experiments
# and benchmarks are not in the wheel.
sys.path.append(str(Path(__file__).resolve().parents[1]))


def pytest_configure(config: pytest.Config) -> None:
    """Keeps pytest-xdist from sorting files by their number of tests.

    Processes that tests stop by a signal get it also where the tests run under nohup,
    or in the background of a script.
    """
    config.option.loadscopereorder = False
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts files with slow tests first, and skips what needs a GPU where none is.

    A worker takes whole files: none is to be left alone with a long one at the end.
    """
    slow = {item.path for item in items if "slow" in item.keywords}
    items.sort(key=lambda item: item.path not in slow)
    if any(device.platform == "gpu" for device in jax.devices()):
        # The others stay on the CPU; the marked ones ask for the GPU.
        jax.config.update("jax_default_device", jax.devices("cpu")[0])
        return
    skip = pytest.mark.skip(reason="needs a GPU")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session", autouse=True)
def _working_directory(tmp_path_factory):
    """MuJoCo's C code writes MUJOCO_LOG.TXT where it stands: not in the repository."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("cwd"))
    yield
    os.chdir(before)


@pytest.fixture
def key() -> jax.Array:
    """A typed key."""
    return jax.random.key(0)
