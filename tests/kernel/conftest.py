"""Engines, and compilers that do what a test wants."""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from rollouts import ENGINES

import jaxpets

SOURCES = Path(jaxpets.__file__).parent / "_src" / "kernel"


@pytest.fixture(params=ENGINES)
def engine(request):
    """A way to compute the kernel's rollout on this machine."""
    return request.param


@pytest.fixture
def compiler(monkeypatch, tmp_path):
    """Makes a shell script the only program on the path, as a compiler.

    It gets what a compiler gets, and runs under the path of the tests. Asked about the
    processor it knows the least that will do, and runs `processor`. Returns the file.
    """
    folder = tmp_path / "bin"
    path = shlex.quote(os.environ["PATH"])

    def install(script, name="c++", processor=":"):
        folder.mkdir(exist_ok=True)
        for other in folder.iterdir():
            other.unlink()
        file = folder / name
        least = "echo '#define __FMA__ 1'"
        asked = f'case "$*" in *-dM*) {least}; {processor}; exit;; esac'
        file.write_text(f"#!/bin/sh\nexport PATH={path}\n{asked}\n{script}\n")
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
