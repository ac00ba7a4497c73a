"""The kernel is compiled once per model, kept whole, and every failure says why."""

import ctypes
import importlib.resources
import os
import platform
import re
import shutil
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import pytest
from rollouts import SOURCES

from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import BuildError, Kind

# Without a cache in memory: what a process does the first time.
load = build.build_kernel

pytestmark = pytest.mark.usefixtures("cache", "registered")


def kept(cache):
    """Names of the libraries that are kept, without their digests."""
    return [path.name.partition("-")[0] for path in cache.iterdir()]


def test_one_compilation_per_model(cache, compiler, making, registered):
    compiler(making.script)
    target = load("// one", Kind.WGMMA_REFERENCE).target
    assert (
        load("// one", Kind.WGMMA_REFERENCE).target == target
    )  # as the next process does
    assert len(making.commands) == 1
    other = load("// two", Kind.WGMMA_REFERENCE).target
    assert other != target and len(making.commands) == 2
    assert registered == [(name, "cpu") for name in (target, target, other)]
    assert sorted(kept(cache)) == sorted([target, other])


def test_a_process_asks_once(compiler, making, registered):
    compiler(making.script)
    build.load_kernel("// asked twice", Kind.WGMMA_REFERENCE)
    target = build.load_kernel("// asked twice", Kind.WGMMA_REFERENCE).target
    assert len(making.commands) == 1 and registered == [(target, "cpu")]
    assert target.startswith("jaxpets_rollout_wgmma_reference_")


def test_threads_of_a_process_ask_once(compiler, making, registered):
    """XLA takes a target once: that of another library would be refused."""
    compiler(making.script)
    barrier = threading.Barrier(4)

    def ask(_):
        barrier.wait()
        return build.load_kernel("// asked at once", Kind.WGMMA_REFERENCE)

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(ask, range(4)))) == 1
    assert len(making.commands) == len(registered) == 1


@pytest.mark.parametrize("kind", [Kind.CPU, Kind.WGMMA_REFERENCE])
@pytest.mark.parametrize("change", ["sources", "jax", "compiler", "version"])
def test_another_recipe_is_another_kernel(
    monkeypatch, tmp_path, compiler, making, change, kind
):
    compiler(making.script)
    target = load("// one", kind).target
    if change == "sources":
        edited = Path(shutil.copytree(SOURCES, tmp_path / "edited"))
        with (edited / "sizes.h").open("a") as file:
            file.write("// edited\n")
        monkeypatch.setattr(importlib.resources, "files", lambda _: edited)
    if change == "jax":
        monkeypatch.setattr(jax, "__version__", "0.0.1")
    if change == "compiler":
        compiler(making.script, name="clang++")
    if change == "version":
        compiler(making.script, version="c++ 1.3")
    assert load("// one", kind).target != target
    assert len(making.commands) == 2


@pytest.mark.parametrize(
    ("kind", "program", "source", "platforms"),
    [
        (Kind.WGMMA, "nvcc", "wgmma_rollout.cu", ["CUDA"]),
        (Kind.MMA, "nvcc", "mma_rollout.cu", ["CUDA"]),
        (Kind.WGMMA_REFERENCE, "c++", "gpu_reference.cc", ["cpu"]),
        (Kind.CPU, "c++", "cpu_rollout.cc", ["cpu"]),
        (Kind.FIT, "nvcc", "fit_epoch.cu", ["CUDA"]),
        (Kind.FIT_REFERENCE, "c++", "fit_reference.cc", ["cpu"]),
        (Kind.PHYSICS, "c++", "physics.cc", ["cpu", "CUDA"]),
    ],
)
def test_every_kind_is_a_library_of_its_own(
    cache, compiler, making, registered, kind, program, source, platforms
):
    file = compiler(making.script, name=program)
    target = load("// one", kind).target
    ((name, *_, last),) = making.commands
    assert name == str(file) and Path(last).name == source
    assert target.startswith(f"{kind.symbol}_{kind.name.lower()}_")
    others = (name for name in ("fit", "physics") if name.upper() in kind.name)
    assert kind.symbol == f"jaxpets_{next(others, 'rollout')}"
    assert registered == [(target, platform) for platform in platforms]
    assert kept(cache) == [target]
    (library,) = cache.iterdir()
    ctypes.CDLL(str(library))


def test_a_processor_has_a_library_of_its_own(compiler, making):
    """Where machines share a folder; the reference is for all of them."""
    compiler(making.script)
    kinds = Kind.CPU, Kind.WGMMA_REFERENCE
    own, shared = (load("// one", kind)[:2] for kind in kinds)
    compiler(making.script, processor="echo '#define __MORE__ 1'")
    assert load("// one", Kind.CPU)[:2] != own
    assert load("// one", Kind.WGMMA_REFERENCE)[:2] == shared
    assert len(making.commands) == 3


@pytest.mark.parametrize(
    ("machine", "flag"),
    [
        ("x86_64", "-march=native"),
        ("AMD64", "-march=native"),
        ("aarch64", "-mcpu=native"),
        ("arm64", "-mcpu=native"),
    ],
)
def test_a_cpu_is_built_for_by_its_name(monkeypatch, compiler, making, machine, flag):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    compiler(making.script)
    load("// one", Kind.CPU)
    load("// one", Kind.WGMMA_REFERENCE)
    command, reference = making.commands
    assert flag in command and "-O3" in command
    assert command.index("-O3") > command.index("-O2")  # the last one counts
    assert not any("native" in word for word in reference)


def test_all_sources_are_given_to_the_compiler(tmp_path, compiler):
    given = tmp_path / "given"
    compiler(
        f'for last; do :; done; cp -r "$(dirname "$last")" {given}; '
        f'echo "$*" > {given}/command; exit 1'
    )
    with pytest.raises(BuildError, match="failed: no message"):
        load("// the model", Kind.WGMMA_REFERENCE)
    command = (given / "command").read_text().split()
    folder = Path(command[-1]).parent
    assert f"-I{folder}" in command and f"-I{jax.ffi.include_dir()}" in command
    (given / "command").unlink()
    texts = {path.name: path.read_text() for path in given.iterdir()}
    assert texts.pop("model.h") == "// the model"
    suffixes = (".h", ".cu", ".cc")
    shipped = [path for path in SOURCES.iterdir() if path.suffix in suffixes]
    assert texts == {path.name: path.read_text() for path in shipped}


def test_on_windows_there_is_none(monkeypatch):
    monkeypatch.setattr(os, "name", "nt")
    with pytest.raises(BuildError, match="on Linux and macOS only"):
        load("// one", Kind.CPU)


def test_without_any_folder_it_says_so(monkeypatch, cache, compiler, making):
    compiler(making.script)
    cache.parent.mkdir()
    cache.write_text("a file, where a folder should be")
    monkeypatch.setattr(tempfile, "tempdir", str(cache))
    words = f"^there is no folder to build it in: .*{re.escape(str(cache))}"
    with (
        pytest.warns(UserWarning, match="^cannot keep a compiled kernel"),
        pytest.raises(BuildError, match=words),
    ):
        load("// one", Kind.WGMMA_REFERENCE)


def test_a_temporary_library_is_gone_when_it_is_loaded(
    monkeypatch, tmp_path, cache, compiler, making, registered
):
    compiler(making.script)
    cache.mkdir(parents=True)
    cache.chmod(0o777)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = set(tmp_path.iterdir())
    with pytest.warns(UserWarning, match=f"others may write to {cache}") as caught:
        target = load("// one", Kind.WGMMA_REFERENCE).target
    assert len(caught) == 1 and caught[0].filename == build.__file__
    assert registered == [(target, "cpu")]
    assert set(tmp_path.iterdir()) == before and not any(cache.iterdir())
