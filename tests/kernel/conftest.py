"""Engines, and compilers that do what a test wants."""

import os
import shlex
import shutil
import subprocess

import jax
import pytest
from rollouts import ENGINES, SOURCES

# In a script: $2 is then where the library goes.
OUTPUT = 'while [ "$1" != -o ]; do shift; done'


@pytest.fixture(params=ENGINES)
def engine(request):
    """A way to compute the kernel's rollout on this machine."""
    return request.param


@pytest.fixture
def compiler(monkeypatch, tmp_path):
    """Makes a shell script the only program on the path, as a compiler.

    It gets what a compiler gets, and runs under the path of the tests. Asked about the
    processor it knows the least that will do, and runs `processor`; asked who it is it
    says `version`. Returns the file.
    """
    folder = tmp_path / "bin"
    path = shlex.quote(os.environ["PATH"])

    def install(script, name="c++", processor=":", version="c++ 1.2"):
        folder.mkdir(exist_ok=True)
        for other in folder.iterdir():
            other.unlink()
        file = folder / name
        least = "echo '#define __FMA__ 1'"
        said = f"printf '%s\\n' {shlex.quote(version)}"
        asked = f"--version) {said}; exit;; *-dM*) {least}; {processor}; exit;;"
        first = f'export PATH={path}; case "$*" in {asked} esac'
        file.write_text(f"#!/bin/sh\n{first}\n{script}\n")
        file.chmod(0o755)
        monkeypatch.setenv("PATH", str(folder))
        return file

    return install


@pytest.fixture
def assert_constants(tmp_path):
    """Asserts that a header of the sources has constants of these values."""

    def check(header, model, values):
        (tmp_path / "model.h").write_text(
            f'#pragma once\n#include "particle.h"\n{model}'
        )
        lines = [f'#include "{header}"']
        lines += [f'static_assert({name} == {n}, "");' for name, n in values.items()]
        (tmp_path / "check.cc").write_text("\n".join(lines))
        command = [shutil.which("c++"), "-std=c++17", "-fsyntax-only"]
        folders = [f"-I{tmp_path}", f"-I{SOURCES}"]
        command += [*folders, tmp_path / "check.cc"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert not done.returncode, done.stderr

    return check


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """The cache folder of this test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "jaxpets"


@pytest.fixture
def registered(monkeypatch):
    """FFI targets that were registered, and their platforms."""
    seen = []

    def register(name, capsule, *, platform):
        seen.append((name, platform))

    monkeypatch.setattr(jax.ffi, "register_ffi_target", register)
    return seen


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """A library with the kernels' symbols, and nothing in it."""
    folder = tmp_path_factory.mktemp("tiny")
    symbols = "rollout", "fit", "physics", "physics_cuda"
    lines = [f"int jaxpets_{symbol}(void) {{ return 0; }}" for symbol in symbols]
    lines.append("char* jaxpets_problem(void) { return 0; }")
    (folder / "tiny.c").write_text("\n".join(lines))
    command = ["cc", "-shared", "-fPIC", "-o", folder / "tiny.so", folder / "tiny.c"]
    subprocess.run(command, check=True)
    return folder / "tiny.so"


class Making:
    """A script for a compiler that makes the same library of everything.

    `commands` are the words of each call, the compiler's own file first.
    """

    def __init__(self, library, log):
        self.script = f'echo "$0 $*" >> {log}; {OUTPUT}; cp {library} "$2"'
        self._log = log
        log.touch()

    @property
    def commands(self):
        return [line.split() for line in self._log.read_text().splitlines()]


@pytest.fixture
def making(tiny, tmp_path):
    """A Making of this test."""
    return Making(tiny, tmp_path / "log")
