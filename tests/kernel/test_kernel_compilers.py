"""Which compiler is taken, and what is said of one that fails."""

import os
import re
import select
import shlex
import shutil
import subprocess
import sys

import pytest

from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import BuildError, Kind

pytestmark = pytest.mark.usefixtures("cache", "registered")
# Without a cache in memory: what a process does the first time.
load = build.build_kernel
# In a script: $2 is then where the library goes.
OUTPUT = 'while [ "$1" != -o ]; do shift; done'


def test_a_processor_that_is_not_known_says_so(compiler, making, registered):
    said = "cc1plus: error: bad value ('native') for '-march=' switch"
    compiler(
        making.script, processor=f"echo {shlex.quote(said)} >&2; echo note >&2; exit 1"
    )
    with pytest.raises(BuildError) as error:
        load("// one", Kind.CPU)
    assert str(error.value) == f"c++ failed: {said}"
    assert not making.commands and not registered  # nothing is compiled


def test_a_compiler_that_cannot_be_run_says_so(compiler):
    compiler("").write_text("")
    for kind in (Kind.CPU, Kind.WGMMA_REFERENCE):
        with pytest.raises(BuildError, match=r"^cannot run c\+\+: [^\n]*$"):
            load("// one", kind)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (
            "In file included from a.h\na.h:3: error: first\na.h:4: error: second",
            r"^c\+\+ failed: a.h:3: error: first$",
        ),
        ("killed\nsoon", r"^c\+\+ failed: killed$"),
    ],
)
def test_a_failure_leaves_nothing_behind(cache, compiler, said, words):
    compiler(f'{OUTPUT}; echo half > "$2"; echo {shlex.quote(said)} >&2; exit 1')
    with pytest.raises(BuildError, match=words):
        load("// one", Kind.WGMMA_REFERENCE)
    assert list(cache.iterdir()) == []


@pytest.fixture
def hanging(monkeypatch, tmp_path, compiler):
    """Makes a compiler that never ends; `then` is called when one would wait for it.

    It starts another program. Both hold a pipe, which has an end once they have.
    Returns a function that reads the pipe.
    """
    file = tmp_path / "pipe"
    os.mkfifo(file)
    pipe = os.open(file, os.O_RDONLY | os.O_NONBLOCK)
    communicate = subprocess.Popen.communicate

    def read():
        assert select.select([pipe], [], [], 30)[0], "something still runs"
        return os.read(pipe, 100)

    def install(name, then):
        compiler(f"exec 3> {file}; echo ready >&3; sleep 600 & wait", name=name)

        def called(process, timeout):
            if "-o" not in process.args:  # asked for its version
                return communicate(process, timeout=timeout)
            assert read() == b"ready\n"
            return then(lambda: communicate(process, timeout=0))

        monkeypatch.setattr(subprocess.Popen, "communicate", called)
        return read

    yield install
    os.close(pipe)


@pytest.mark.parametrize(
    ("kind", "name", "limit"),
    [(Kind.WGMMA_REFERENCE, "c++", 120), (Kind.WGMMA, "nvcc", 300)],
)
def test_a_compiler_that_hangs_is_ended(cache, hanging, kind, name, limit):
    read = hanging(name, lambda communicate: communicate())
    words = f"^{re.escape(name)} was not done in {limit} seconds$"
    with pytest.raises(BuildError, match=words):
        load("// one", kind)
    assert read() == b"" and not any(cache.iterdir())


def test_an_interrupt_ends_the_compiler(cache, hanging):
    """It is in another process group, where a terminal's interrupt does not come."""

    def interrupt(_):
        raise KeyboardInterrupt

    read = hanging("c++", interrupt)
    with pytest.raises(KeyboardInterrupt):
        load("// one", Kind.WGMMA_REFERENCE)
    assert read() == b"" and not any(cache.iterdir())


def test_a_broken_library_says_so(compiler, registered):
    compiler(f'{OUTPUT}; echo no library > "$2"')
    with pytest.raises(BuildError, match=r"^cannot load the compiled kernel: .*\.so"):
        load("// one", Kind.WGMMA_REFERENCE)
    assert not registered


NVCC = """nvcc: NVIDIA (R) Cuda compiler driver
Copyright (c) 2005-2025 NVIDIA Corporation
Cuda compilation tools, release 13.0, V13.0.88
Build cuda_13.0.r13.0/compiler.36424714_0"""


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("c++ (Debian 12.2.0-14) 12.2.0\nCopyright (C) 2022", None),
        ("Apple clang version 15.0.0 (clang-1500.3.9.4)", None),
        (NVCC, "Cuda compilation tools, release 13.0, V13.0.88"),
        ("a compiler", "unknown"),
    ],
)
def test_a_kernel_knows_what_built_it(compiler, making, said, words):
    compiler(making.script, version=said)
    kernel = load("// one", Kind.WGMMA_REFERENCE)
    assert kernel.compiler == (words or said.splitlines()[0])


# Compilers that are found.


@pytest.mark.parametrize("names", [["c++"], ["g++", "clang++"], ["clang++"]])
def test_the_first_compiler_that_is_there(compiler, making, names):
    first = compiler(making.script, name=names[0])
    for name in names[1:]:
        shutil.copy(first, first.with_name(name))
    load("// one", Kind.WGMMA_REFERENCE)
    assert making.commands[0][0] == str(first)


def test_without_a_compiler_it_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BuildError, match=r"^no C\+\+ compiler found \(c\+\+, g\+\+"):
        load("// one", Kind.WGMMA_REFERENCE)


def test_nvcc_is_looked_for_in_three_places(monkeypatch, tmp_path, compiler, making):
    """On the path, in CUDA_HOME, in the package that JAX brings."""
    on_path = compiler(making.script, name="nvcc")
    in_home = tmp_path / "home" / "bin" / "nvcc"
    in_wheel = tmp_path / "site" / "nvidia" / "cu13" / "bin" / "nvcc"
    for place in (in_home, in_wheel):
        place.parent.mkdir(parents=True)
        shutil.copy(on_path, place)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site")])
    monkeypatch.delitem(sys.modules, "nvidia", raising=False)

    def used(model):
        load(f"// {model}", Kind.WGMMA, "sm_90a")
        return making.commands[-1]

    name, *flags = used("one")
    assert name == str(on_path)
    assert "-gencode=arch=compute_90a,code=sm_90a" in flags
    on_path.unlink()
    assert used("two")[0] == str(in_home)
    library = f"-L{in_wheel.parents[1] / 'lib'}"
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "elsewhere"))
    name, *flags = used("three")
    assert name == str(in_wheel) and library in flags
    monkeypatch.delenv("CUDA_HOME")
    assert used("four")[0] == str(in_wheel)
    in_wheel.unlink()
    with pytest.raises(BuildError, match=r"^no nvcc found; pip install 'jaxpets"):
        load("// five", Kind.WGMMA)
    monkeypatch.setattr(sys, "path", [os.devnull])
    with pytest.raises(BuildError, match=r"^no nvcc found; pip install 'jaxpets"):
        load("// six", Kind.WGMMA)
