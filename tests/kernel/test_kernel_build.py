"""The kernel is compiled once per model, kept whole, and every failure says why."""

import ctypes
import importlib.resources
import os
import platform
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import pytest

from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import BuildError, Kind

# Without a cache in memory: what a process does the first time.
load = build.load_kernel.__wrapped__

SOURCES = Path(build.__file__).parent
OUTPUT = 'while [ "$1" != -o ]; do shift; done'  # $2 is where the library goes


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """The cache folder of this test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "jaxpets"


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """FFI targets that were registered, and their platforms."""
    seen = []

    def register(name, capsule, *, platform):
        seen.append((name, platform))

    monkeypatch.setattr(jax.ffi, "register_ffi_target", register)
    return seen


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A library with the kernel's symbol, and nothing in it."""
    folder = tmp_path_factory.mktemp("tiny")
    (folder / "tiny.c").write_text("int jaxpets_rollout(void) { return 0; }")
    command = ["cc", "-shared", "-fPIC", "-o", folder / "tiny.so", folder / "tiny.c"]
    subprocess.run(command, check=True)
    return folder / "tiny.so"


@pytest.fixture
def log(tmp_path):
    """What `making` writes: a line for every library that was asked for."""
    file = tmp_path / "log"
    file.touch()
    return file


@pytest.fixture
def making(tiny, log):
    """The script of a compiler that makes the same library of everything."""
    return f'echo "$0 $*" >> {log}; {OUTPUT}; cp {tiny} "$2"'


def commands(log):
    return [line.split() for line in log.read_text().splitlines()]


def test_one_compilation_per_model(cache, compiler, making, log, registered):
    compiler(making)
    target = load("// one", Kind.GPU_REFERENCE)
    assert load("// one", Kind.GPU_REFERENCE) == target  # as the next process does
    assert len(commands(log)) == 1
    other = load("// two", Kind.GPU_REFERENCE)
    assert other != target and len(commands(log)) == 2
    assert registered == [(name, "cpu") for name in (target, target, other)]
    assert {path.name for path in cache.iterdir()} == {f"{target}.so", f"{other}.so"}


def test_a_process_asks_once(compiler, making, log, registered):
    compiler(making)
    build.load_kernel("// asked twice", Kind.GPU_REFERENCE)
    target = build.load_kernel("// asked twice", Kind.GPU_REFERENCE)
    assert len(commands(log)) == 1 and registered == [(target, "cpu")]
    assert target.startswith("jaxpets_rollout_gpu_reference_")


@pytest.mark.parametrize("kind", [Kind.CPU, Kind.GPU_REFERENCE])
@pytest.mark.parametrize("change", ["sources", "jax", "compiler"])
def test_another_recipe_is_another_kernel(
    monkeypatch, tmp_path, compiler, making, log, change, kind
):
    compiler(making)
    target = load("// one", kind)
    if change == "sources":
        edited = Path(shutil.copytree(SOURCES, tmp_path / "edited"))
        with (edited / "sizes.h").open("a") as file:
            file.write("// edited\n")
        monkeypatch.setattr(importlib.resources, "files", lambda _: edited)
    if change == "jax":
        monkeypatch.setattr(jax, "__version__", "0.0.1")
    if change == "compiler":
        compiler(making, name="clang++")
    assert load("// one", kind) != target
    assert len(commands(log)) == 2


@pytest.mark.parametrize(
    ("kind", "program", "source", "registry"),
    [
        (Kind.GPU, "nvcc", "gpu_rollout.cu", "CUDA"),
        (Kind.GPU_REFERENCE, "c++", "gpu_reference.cc", "cpu"),
        (Kind.CPU, "c++", "cpu_rollout.cc", "cpu"),
    ],
)
def test_every_kind_is_a_library_of_its_own(
    cache, compiler, making, log, registered, kind, program, source, registry
):
    file = compiler(making, name=program)
    target = load("// one", kind)
    ((name, *_, last),) = commands(log)
    assert name == str(file) and Path(last).name == source
    assert target.startswith(f"jaxpets_rollout_{kind.name.lower()}_")
    assert registered == [(target, registry)]
    assert [path.name for path in cache.iterdir()] == [f"{target}.so"]
    ctypes.CDLL(str(cache / f"{target}.so"))


def test_a_processor_has_a_library_of_its_own(compiler, making, log):
    """Where machines share a folder; the reference is for all of them."""
    compiler(making)
    target, shared = load("// one", Kind.CPU), load("// one", Kind.GPU_REFERENCE)
    compiler(making, processor="echo '#define __MORE__ 1'")
    assert load("// one", Kind.CPU) != target
    assert load("// one", Kind.GPU_REFERENCE) == shared
    assert len(commands(log)) == 3


@pytest.mark.parametrize(
    ("machine", "flag"),
    [
        ("x86_64", "-march=native"),
        ("AMD64", "-march=native"),
        ("aarch64", "-mcpu=native"),
        ("arm64", "-mcpu=native"),
    ],
)
def test_a_cpu_is_built_for_by_its_name(
    monkeypatch, compiler, making, log, machine, flag
):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    compiler(making)
    load("// one", Kind.CPU)
    load("// one", Kind.GPU_REFERENCE)
    command, reference = commands(log)
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
        load("// the model", Kind.GPU_REFERENCE)
    command = (given / "command").read_text().split()
    folder = Path(command[-1]).parent
    assert f"-I{folder}" in command and f"-I{jax.ffi.include_dir()}" in command
    (given / "command").unlink()
    texts = {path.name: path.read_text() for path in given.iterdir()}
    assert texts.pop("model.h") == "// the model"
    suffixes = (".h", ".cu", ".cc")
    shipped = [path for path in SOURCES.iterdir() if path.suffix in suffixes]
    assert texts == {path.name: path.read_text() for path in shipped}


# Where it is kept.


@pytest.mark.parametrize("value", [None, ""])
def test_without_xdg_the_cache_is_in_the_home_folder(
    monkeypatch, tmp_path, compiler, making, value
):
    compiler(making)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    if value is None:
        monkeypatch.delenv("XDG_CACHE_HOME")
    else:
        monkeypatch.setenv("XDG_CACHE_HOME", value)
    target = load("// one", Kind.GPU_REFERENCE)
    assert (tmp_path / "home" / ".cache" / "jaxpets" / f"{target}.so").exists()


def test_without_a_home_folder_it_says_so(monkeypatch, compiler, making):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    compiler(making)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", nobody)
    with pytest.raises(BuildError, match="no home folder; set XDG_CACHE_HOME"):
        load("// one", Kind.GPU_REFERENCE)


def test_many_may_build_at_once(cache, compiler, making, log):
    """Each into a folder of its own; whoever is last replaces a whole by a whole."""
    compiler(making)
    with ThreadPoolExecutor(4) as pool:
        targets = list(pool.map(lambda _: load("// one", Kind.GPU_REFERENCE), range(8)))
    assert len(set(targets)) == 1
    outputs = [command[command.index("-o") + 1] for command in commands(log)]
    assert len(set(outputs)) == len(outputs)
    assert [path.name for path in cache.iterdir()] == [f"{targets[0]}.so"]


def test_a_cache_that_cannot_be_written_says_so(cache, compiler, making):
    compiler(making)
    cache.parent.mkdir()
    cache.write_text("a file, where a folder should be")
    with pytest.raises(BuildError, match=r"^cannot write to the cache folder: .*jax"):
        load("// one", Kind.GPU_REFERENCE)


# Compilers that fail.


def test_a_processor_that_is_not_known_says_so(compiler, making, log, registered):
    said = "cc1plus: error: bad value ('native') for '-march=' switch"
    compiler(making, processor=f"echo {shlex.quote(said)} >&2; echo note >&2; exit 1")
    with pytest.raises(BuildError) as error:
        load("// one", Kind.CPU)
    assert str(error.value) == f"c++ failed: {said}"
    assert not commands(log) and not registered  # nothing is compiled


def test_a_compiler_that_cannot_be_run_says_so(compiler):
    compiler("").write_text("")
    for kind in (Kind.CPU, Kind.GPU_REFERENCE):
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
        load("// one", Kind.GPU_REFERENCE)
    assert list(cache.iterdir()) == []


def test_a_broken_library_says_so(compiler, registered):
    compiler(f'{OUTPUT}; echo no library > "$2"')
    with pytest.raises(BuildError, match=r"^cannot load the compiled kernel: .*\.so"):
        load("// one", Kind.GPU_REFERENCE)
    assert not registered


# Compilers that are found.


@pytest.mark.parametrize("names", [["c++"], ["g++", "clang++"], ["clang++"]])
def test_the_first_compiler_that_is_there(compiler, making, log, names):
    first = compiler(making, name=names[0])
    for name in names[1:]:
        shutil.copy(first, first.with_name(name))
    load("// one", Kind.GPU_REFERENCE)
    assert commands(log)[0][0] == str(first)


def test_without_a_compiler_it_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BuildError, match=r"^no C\+\+ compiler found \(c\+\+, g\+\+"):
        load("// one", Kind.GPU_REFERENCE)


def test_nvcc_is_looked_for_in_three_places(
    monkeypatch, tmp_path, compiler, making, log
):
    """On the path, in CUDA_HOME, in the package that JAX brings."""
    on_path = compiler(making, name="nvcc")
    in_home = tmp_path / "home" / "bin" / "nvcc"
    in_wheel = tmp_path / "site" / "nvidia" / "cu13" / "bin" / "nvcc"
    for place in (in_home, in_wheel):
        place.parent.mkdir(parents=True)
        shutil.copy(on_path, place)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site")])
    monkeypatch.delitem(sys.modules, "nvidia", raising=False)

    def used(model):
        load(f"// {model}", Kind.GPU)
        return commands(log)[-1]

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
        load("// five", Kind.GPU)
    monkeypatch.setattr(sys, "path", [os.devnull])
    with pytest.raises(BuildError, match=r"^no nvcc found; pip install 'jaxpets"):
        load("// six", Kind.GPU)
