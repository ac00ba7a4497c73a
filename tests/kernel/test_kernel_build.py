"""The kernel is compiled once per model, kept whole, and every failure says why."""

import ctypes
import platform
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import BuildError, Kind

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
        if "-dM" in command:  # asks about the processor, and makes nothing
            return run(command, **options)
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
    target = load("// one", Kind.REFERENCE)
    assert load("// one", Kind.REFERENCE) == target  # as the next process does
    assert len(commands) == 1
    other = load("// two", Kind.REFERENCE)
    assert other != target and len(commands) == 2
    assert registered == [(name, "cpu") for name in (target, target, other)]
    assert {path.name for path in cache.iterdir()} == {f"{target}.so", f"{other}.so"}


def test_a_process_asks_once(commands, registered):
    build.load_kernel("// asked twice", Kind.REFERENCE)
    target = build.load_kernel("// asked twice", Kind.REFERENCE)
    assert len(commands) == 1 and registered == [(target, "cpu")]
    assert target.startswith("jaxpets_rollout_reference_")


@pytest.mark.parametrize("kind", [Kind.CPU, Kind.REFERENCE])
@pytest.mark.parametrize("change", ["sources", "jax", "compiler"])
def test_another_recipe_is_another_kernel(
    monkeypatch, commands, registered, change, kind
):
    target = load("// one", kind)
    if change == "sources":
        monkeypatch.setattr(build, "_SOURCES", build._SOURCES[:-1])
    if change == "jax":
        monkeypatch.setattr(jax, "__version__", "0.0.1")
    if change == "compiler":
        flags = build._host_compiler()
        monkeypatch.setattr(build, "_host_compiler", lambda: [*flags, "-g"])
    assert load("// one", kind) != target
    assert len(commands) == 2


def test_every_kind_is_a_library_of_its_own(cache, monkeypatch, commands, registered):
    there = shutil.which("c++")
    monkeypatch.setattr(shutil, "which", {"c++": there, "nvcc": "/path/nvcc"}.get)
    targets = [load("// one", kind) for kind in Kind]
    for kind, target, command in zip(Kind, targets, commands, strict=True):
        assert target.startswith(f"jaxpets_rollout_{kind.name.lower()}_")
        assert Path(command[-1]).name == kind.value
    assert {path.name for path in cache.iterdir()} == {f"{t}.so" for t in targets}
    platforms = {Kind.GPU: "CUDA", Kind.CPU: "cpu", Kind.REFERENCE: "cpu"}
    assert registered == list(zip(targets, platforms.values(), strict=True))


def test_a_processor_has_a_library_of_its_own(monkeypatch, commands, registered):
    """Where machines share a folder; the reference is for all of them."""
    target, shared = load("// one", Kind.CPU), load("// one", Kind.REFERENCE)
    told = build._processor
    monkeypatch.setattr(
        build, "_processor", lambda command: told(command) + "#define __MORE__ 1"
    )
    assert load("// one", Kind.CPU) != target
    assert load("// one", Kind.REFERENCE) == shared
    assert len(commands) == 3


def test_what_the_processor_can_do_is_what_the_compiler_says():
    command = build._compiler(Kind.CPU)
    said = build._processor(command)
    assert "#define __cplusplus" in said
    if platform.machine() == "x86_64":
        # Of the oldest processor of the kind, which has less than any since.
        least = [f.replace("-march=native", "-march=x86-64") for f in command]
        with pytest.raises(BuildError, match="has no fused multiply-add"):
            build._processor(least)


@pytest.mark.parametrize(
    ("machine", "flag"),
    [
        ("x86_64", "-march=native"),
        ("AMD64", "-march=native"),
        ("aarch64", "-mcpu=native"),
        ("arm64", "-mcpu=native"),
    ],
)
def test_a_cpu_is_built_for_by_its_name(monkeypatch, machine, flag):
    monkeypatch.setattr(platform, "machine", lambda: machine)
    command = build._compiler(Kind.CPU)
    assert flag in command and "-O3" in command
    assert command.index("-O3") > command.index("-O2")  # the last one counts
    assert not any("native" in word for word in build._compiler(Kind.REFERENCE))


def test_a_processor_that_is_not_known_says_so(monkeypatch, registered):
    def fake(command, **options):
        assert "-dM" in command  # and nothing is compiled
        text = "cc1plus: error: bad value ('native') for '-march=' switch\nnote: more"
        return SimpleNamespace(returncode=1, stdout="", stderr=text)

    monkeypatch.setattr(subprocess, "run", fake)
    with pytest.raises(
        BuildError, match=r"^\S+ failed: cc1plus: error: bad value .*ch$"
    ):
        load("// one", Kind.CPU)
    assert not registered


def test_a_compiler_that_cannot_be_run_says_so(monkeypatch, tmp_path):
    path = tmp_path / "c++"
    path.write_text("")
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    for kind in (Kind.CPU, Kind.REFERENCE):
        with pytest.raises(BuildError, match=r"^cannot run c\+\+: "):
            load("// one", kind)


def test_all_sources_are_given_to_the_compiler(monkeypatch, registered):
    seen = {}

    def fake(command, **options):
        folder = Path(command[-1]).parent
        seen.update({path.name: path.read_text() for path in folder.iterdir()})
        assert f"-I{folder}" in command and f"-I{jax.ffi.include_dir()}" in command
        return SimpleNamespace(returncode=1, stderr="")

    monkeypatch.setattr(subprocess, "run", fake)
    with pytest.raises(BuildError, match="failed: no message"):
        load("// the model", Kind.REFERENCE)
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


def test_without_a_home_folder_it_says_so(monkeypatch, commands):
    def nobody():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", nobody)
    with pytest.raises(BuildError, match="no home folder; set XDG_CACHE_HOME"):
        load("// one", Kind.REFERENCE)


def test_many_may_build_at_once(cache, commands, registered):
    """Each into a folder of its own; whoever is last replaces a whole by a whole."""
    with ThreadPoolExecutor(4) as pool:
        targets = list(pool.map(lambda _: load("// one", Kind.REFERENCE), range(8)))
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
        load("// one", Kind.REFERENCE)
    assert list(cache.iterdir()) == []
    errors = "killed\nsoon\n"
    with pytest.raises(BuildError, match=r"^\S+ failed: killed$"):
        load("// one", Kind.REFERENCE)


def test_a_broken_library_says_so(cache, monkeypatch, registered):
    def fake(command, **options):
        Path(command[command.index("-o") + 1]).write_text("no library")
        return SimpleNamespace(returncode=0, stdout="")

    monkeypatch.setattr(subprocess, "run", fake)
    with pytest.raises(BuildError, match=r"cannot load the compiled kernel: .*\.so"):
        load("// one", Kind.REFERENCE)
    assert not registered


def test_a_cache_that_cannot_be_written_says_so(cache):
    cache.write_text("a file, where a folder should be")
    with pytest.raises(BuildError, match=r"cannot write to the cache folder: .*jax"):
        load("// one", Kind.REFERENCE)


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
    target = load("// one", Kind.GPU)
    ((command, *_, source),) = commands
    assert command == "/path/nvcc" and Path(source).name == "rollout.cu"
    assert registered == [(target, "CUDA")]
    assert target.startswith("jaxpets_rollout_gpu_")
    ctypes.CDLL(str(cache / f"{target}.so"))
