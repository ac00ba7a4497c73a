"""The kernel is compiled once per model, kept whole, and every failure says why."""

import ctypes
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import BuildError

# Without a cache in memory: what a process does the first time.
load = build.load_kernel.__wrapped__


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """The cache folder of this test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "jaxpets"


@pytest.fixture
def commands(monkeypatch):
    """Command lines, instead of compilers that would run; they make C libraries."""
    run, seen = subprocess.run, []

    def fake(command, **options):
        seen.append(command)
        source = Path(command[-1]).with_name("tiny.c")
        source.write_text("int jaxpets_rollout(void) { return 0; }")
        tiny = ["cc", "-shared", "-fPIC", str(source)]
        return run([*tiny, "-o", command[command.index("-o") + 1]], **options)

    monkeypatch.setattr(subprocess, "run", fake)
    return seen


@pytest.fixture
def registered(monkeypatch):
    """FFI targets that were registered, and their platforms."""
    seen = []

    def register(name, capsule, *, platform):
        seen.append((name, platform))

    monkeypatch.setattr(jax.ffi, "register_ffi_target", register)
    return seen


def test_one_compilation_per_model(cache, commands, registered):
    target = load("// one", cuda=False)
    assert load("// one", cuda=False) == target  # as the next process does
    assert len(commands) == 1
    other = load("// two", cuda=False)
    assert other != target and len(commands) == 2
    assert registered == [(name, "cpu") for name in (target, target, other)]
    assert {path.name for path in cache.iterdir()} == {f"{target}.so", f"{other}.so"}


def test_a_process_asks_once(commands, registered):
    build.load_kernel("// asked twice", cuda=False)
    target = build.load_kernel("// asked twice", cuda=False)
    assert len(commands) == 1 and registered == [(target, "cpu")]
    assert target.startswith("jaxpets_rollout_cpu_")


@pytest.mark.parametrize("change", ["sources", "jax", "compiler"])
def test_another_recipe_is_another_kernel(monkeypatch, commands, registered, change):
    target = load("// one", cuda=False)
    if change == "sources":
        monkeypatch.setattr(build, "_SOURCES", build._SOURCES[:-1])
    if change == "jax":
        monkeypatch.setattr(jax, "__version__", "0.0.1")
    if change == "compiler":
        monkeypatch.setattr(build, "_host_compiler", lambda: ["clang++", "-O3"])
    assert load("// one", cuda=False) != target
    assert len(commands) == 2


def test_all_sources_are_given_to_the_compiler(monkeypatch, registered):
    seen = {}

    def fake(command, **options):
        folder = Path(command[-1]).parent
        seen.update({path.name: path.read_text() for path in folder.iterdir()})
        assert f"-I{folder}" in command and f"-I{jax.ffi.include_dir()}" in command
        return SimpleNamespace(returncode=1, stderr="")

    monkeypatch.setattr(subprocess, "run", fake)
    with pytest.raises(BuildError, match="failed: no message"):
        load("// the model", cuda=False)
    assert set(seen) == {*build._SOURCES, "model.h"}
    assert seen["model.h"] == "// the model"
    folder = Path(build.__file__).parent
    shipped = {p.name for p in folder.iterdir() if p.suffix in (".h", ".cu", ".cc")}
    assert shipped == set(build._SOURCES)
    for name in shipped:
        assert seen[name] == (folder / name).read_text()


def test_without_xdg_the_cache_is_in_the_home_folder(monkeypatch, tmp_path):
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    for value in (None, ""):
        if value is None:
            monkeypatch.delenv("XDG_CACHE_HOME")
        else:
            monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert build._cache_folder() == tmp_path / "home" / ".cache" / "jaxpets"


def test_many_may_build_at_once(cache, commands, registered):
    """Each into a folder of its own; whoever is last replaces a whole by a whole."""
    with ThreadPoolExecutor(4) as pool:
        targets = list(pool.map(lambda _: load("// one", cuda=False), range(8)))
    assert len(set(targets)) == 1
    outputs = [command[command.index("-o") + 1] for command in commands]
    assert len(set(outputs)) == len(outputs)
    assert [path.name for path in cache.iterdir()] == [f"{targets[0]}.so"]


def test_a_failure_leaves_nothing_behind(cache, monkeypatch):
    errors = (
        "In file included from a.h\na.h:3:1: error: first\na.h:4:1: error: second\n"
    )

    def fake(command, **options):
        Path(command[command.index("-o") + 1]).write_text("half a library")
        return SimpleNamespace(returncode=1, stderr=errors)

    monkeypatch.setattr(subprocess, "run", fake)
    with pytest.raises(BuildError, match=r"^\S+ failed: a.h:3:1: error: first$"):
        load("// one", cuda=False)
    assert list(cache.iterdir()) == []
    errors = "killed\nsoon\n"
    with pytest.raises(BuildError, match=r"^\S+ failed: killed$"):
        load("// one", cuda=False)


def test_a_broken_library_says_so(cache, monkeypatch, registered):
    def fake(command, **options):
        Path(command[command.index("-o") + 1]).write_text("no library")
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(subprocess, "run", fake)
    with pytest.raises(BuildError, match=r"cannot load the compiled kernel: .*\.so"):
        load("// one", cuda=False)
    assert not registered


def test_a_cache_that_cannot_be_written_says_so(cache):
    cache.write_text("a file, where a folder should be")
    with pytest.raises(BuildError, match=r"cannot write to the cache folder: .*jax"):
        load("// one", cuda=False)


@pytest.mark.parametrize("names", [["c++"], ["g++", "clang++"], ["clang++"], []])
def test_the_first_compiler_that_is_there(monkeypatch, names):
    there = {name: f"/somewhere/{name}" for name in names}
    monkeypatch.setattr(shutil, "which", there.get)
    if names:
        assert build._host_compiler()[0] == f"/somewhere/{names[0]}"
        return
    with pytest.raises(BuildError, match=r"no C\+\+ compiler found"):
        build._host_compiler()


def program(path):
    path.parent.mkdir(parents=True)
    path.write_text("")
    return str(path)


def test_nvcc_is_looked_for_in_three_places(monkeypatch, tmp_path):
    """On the path, in CUDA_HOME, in the package that JAX brings."""
    wheel = SimpleNamespace(submodule_search_locations=[str(tmp_path / "nvidia")])
    found = {"nvidia": wheel}
    monkeypatch.setattr(build.importlib.util, "find_spec", found.get)
    monkeypatch.setattr(shutil, "which", lambda name: f"/path/{name}")
    in_home = program(tmp_path / "home" / "bin" / "nvcc")
    in_wheel = program(tmp_path / "nvidia" / "cu13" / "bin" / "nvcc")
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "home"))
    command, *flags = build._nvcc()
    assert command == "/path/nvcc"
    assert "-gencode=arch=compute_90a,code=sm_90a" in flags
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert build._nvcc() == [in_home, *flags]
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "elsewhere"))
    library = f"-L{tmp_path / 'nvidia' / 'cu13' / 'lib'}"
    assert build._nvcc() == [in_wheel, *flags, library]
    monkeypatch.delenv("CUDA_HOME")
    assert build._nvcc() == [in_wheel, *flags, library]
    Path(in_wheel).unlink()
    for spec in (wheel, SimpleNamespace(submodule_search_locations=None), None):
        found["nvidia"] = spec
        with pytest.raises(BuildError, match=r"no nvcc found; pip install 'jaxpets"):
            build._nvcc()


def test_the_kernel_is_registered_for_cuda(cache, monkeypatch, commands, registered):
    monkeypatch.setattr(shutil, "which", {"nvcc": "/path/nvcc"}.get)
    target = load("// one", cuda=True)
    ((command, *_, source),) = commands
    assert command == "/path/nvcc" and Path(source).name == "rollout.cu"
    assert registered == [(target, "CUDA")]
    assert target.startswith("jaxpets_rollout_cuda_")
    ctypes.CDLL(str(cache / f"{target}.so"))
