"""C MuJoCo beside a GPU, where there is none: its driver has memory of the host."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jaxpets
from jaxpets.envs import native_c

# What stands in for libcuda: it says what it is asked for, on stream 7.
DRIVER = """
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
static int done(const char* what, void* stream) {
  std::printf("%s %ld\\n", what, long(reinterpret_cast<intptr_t>(stream)));
  std::fflush(stdout);
  const char* const broken = std::getenv("BROKEN");
  return broken && !std::strcmp(broken, what) ? 201 : 0;
}
extern "C" {
int cuMemcpyDtoHAsync_v2(void* to, uint64_t from, size_t bytes, void* stream) {
  std::memcpy(to, reinterpret_cast<void*>(from), bytes);
  return done("from", stream);
}
int cuMemcpyHtoDAsync_v2(uint64_t to, const void* from, size_t bytes, void* stream) {
  std::memcpy(reinterpret_cast<void*>(to), from, bytes);
  return done("to", stream);
}
int cuStreamSynchronize(void* stream) { return done("wait", stream); }
}
"""
# XLA has no stream on a CPU.
PHYSICS = """
#include "xla_call.h"
namespace {
XLA_FFI_Error* stream_seven(const Call&, void*& stream) {
  stream = reinterpret_cast<void*>(7);
  return nullptr;
}
}  // namespace
#define get_stream stream_seven
#include "physics.cc"
"""
PROGRAM = """
import ctypes, sys
import jax, jax.numpy as jnp, mujoco, numpy as np
from jaxpets._src.kernel.build import Kernel
from jaxpets.envs import half_cheetah, native, native_c

driver, physics = map(ctypes.CDLL, sys.argv[1:])
handler = jax.ffi.pycapsule(physics.jaxpets_physics_cuda)
jax.ffi.register_ffi_target("as_beside_a_gpu", handler, platform="cpu")
model = half_cheetah.load_model()

def step():
    return jax.jit(jax.vmap(native.native_physics(model, num_substeps=5)))

def given(count):
    sizes = model.nq, model.nv, model.nv, model.nu
    qpos, qvel, warmstart, ctrl = (
        jax.random.normal(jax.random.key(i), (count, n)) for i, n in enumerate(sizes)
    )
    return qpos, qvel, warmstart, (), ctrl

want = [step()(*given(count)) for count in (0, 1, 40)]
native_c._kernel = lambda: Kernel("as_beside_a_gpu", "", physics)
for count, other in zip((0, 1, 40), want):
    print(count, flush=True)
    got = jax.block_until_ready(step()(*given(count)))
    jax.tree.map(np.testing.assert_array_equal, got, other)
"""


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    """The driver and what calls it, as files."""
    folder = tmp_path_factory.mktemp("libraries")
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if compiler is None or sys.platform != "linux":
        pytest.skip("needs a C++ compiler, and names of libraries as Linux has them")
    kernels = Path(jaxpets.__file__).parent / "_src" / "kernel"
    include = f"-I{kernels}", f"-I{jax.ffi.include_dir()}"
    for name, text, flags in (
        ("driver", DRIVER, ("-Wl,-soname,libcuda.so.1",)),
        ("beside", PHYSICS, native_c._flags()),
    ):
        (folder / f"{name}.cc").write_text(text)
        files = "-o", folder / f"{name}.so", folder / f"{name}.cc"
        command = [compiler, "-std=c++17", "-shared", "-fPIC", *include, *files]
        subprocess.run([*command, *flags], check=True)
    return folder / "driver.so", folder / "beside.so"


def run(libraries, **settings):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, libraries)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=os.environ
        | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(Path(jaxpets.__file__).parents[1])}
        | settings,
    )


def test_rows_are_copied_there_and_back(libraries):
    result = run(libraries)
    assert result.returncode == 0, result.stderr
    calls = ["from 7", "wait 7", "to 7", "wait 7"]
    assert result.stdout.splitlines() == ["0", "1", *calls, "40", *calls]


@pytest.mark.parametrize(
    ("broken", "named", "count"),
    [
        ("from", "cuMemcpyDtoHAsync_v2", 1),
        ("wait", "cuStreamSynchronize", 2),
        ("to", "cuMemcpyHtoDAsync_v2", 3),
    ],
)
def test_what_the_driver_fails_in_is_told(libraries, broken, named, count):
    result = run(libraries, BROKEN=broken)
    assert f"{named} of the GPU's driver failed with 201" in result.stderr
    assert len(result.stdout.splitlines()) == 2 + count  # what follows is not called
