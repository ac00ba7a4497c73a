"""The kernel for GPUs: on which ones it is built, and that it equals the scan there."""

import dataclasses
import shutil
import subprocess

import jax
import numpy as np
import pytest
from rollouts import (
    CASES,
    CHEETAH,
    SMALL,
    SOURCES,
    Case,
    kernels_of,
    pretend,
    recorded,
    relative_error,
    stacked,
)

import jaxpets
from jaxpets import Precision
from jaxpets._src import fused_rollout as module
from jaxpets._src.kernel.build import Kind

PAPER = dataclasses.replace(CHEETAH, hidden_sizes=(200,) * 4)
WIDE = dataclasses.replace(CASES["free joint"], obs_size=13, hidden_sizes=(256,) * 2)
WIDEST = Case(110, 21, (512, 400), space=jaxpets.delta_space())
GELU = dataclasses.replace(PAPER, activation="gelu")
KINDS = [Kind.WGMMA, Kind.MMA]  # on a GPU that has both


@pytest.fixture
def asked(monkeypatch):
    return kernels_of(monkeypatch, module)


@pytest.mark.parametrize(
    ("attributes", "capability"),
    [
        (dict(compute_capability="7.5"), "7.5"),
        (dict(compute_capability="gfx942"), "gfx942"),
        (dict(), "unknown"),
    ],
)
def test_on_other_gpus_it_is_the_scan(monkeypatch, asked, attributes, capability):
    pretend(monkeypatch, **attributes)
    fused, _ = recorded(SMALL.fused)
    words = f"the GPU's compute capability is {capability}, not 8.0 or more"
    assert fused.reason == words and not fused.uses_kernel and not asked


@pytest.mark.parametrize(
    ("capability", "kind", "arch"),
    [
        ("8.0", Kind.MMA, "sm_80"),
        ("8.9", Kind.MMA, "sm_89"),
        ("9.0", Kind.WGMMA, "sm_90a"),
        ("12.0", Kind.MMA, "sm_120"),
    ],
)
def test_a_gpu_has_the_kernel_that_was_written_for_it(
    monkeypatch, asked, capability, kind, arch
):
    pretend(monkeypatch, compute_capability=capability)
    fused, caught = recorded(SMALL.fused)
    assert not caught and fused.uses_kernel and fused.arch == arch
    reference = {Kind.MMA: Kind.MMA_REFERENCE, Kind.WGMMA: Kind.WGMMA_REFERENCE}[kind]
    assert SMALL.of_kind(reference).uses_kernel
    (kernel, *built), (plain, *other) = asked
    assert built == [kind, arch] and other == [reference, ""]
    # The same model, with the instructions it needs.
    assert kernel.startswith(plain) and "wgmma" not in plain
    assert ("wgmma.mma_async" in kernel) == (kind is Kind.WGMMA)


def test_what_is_too_large_for_hoppers_own_kernel_has_the_other(monkeypatch, asked):
    pretend(monkeypatch, compute_capability="9.0")
    wide = dataclasses.replace(SMALL, hidden_sizes=(400, 512))
    fused, caught = recorded(wide.fused)
    assert not caught and fused.uses_kernel and fused.arch == "sm_90"
    wider = dataclasses.replace(SMALL, hidden_sizes=(513,))
    fused, (warning,) = recorded(wider.fused)
    assert not fused.uses_kernel and "wider than 256" in str(warning)
    assert len(asked) == 1


def test_a_gpu_may_be_named(monkeypatch, asked):
    """Hopper without its own instructions; or one that is not here."""
    pretend(monkeypatch, compute_capability="9.0")
    model, particles = SMALL.model(Precision.BF16), SMALL.num_members
    for arch, kind in (("sm_90", Kind.MMA), ("sm_90a", Kind.WGMMA)):
        fused = jaxpets.fused_rollout(model, num_particles=particles, arch=arch)
        assert fused.arch == arch and asked.pop()[1:] == (kind, arch)
    with pytest.raises(
        ValueError, match=r"^arch must be the name of a GPU, .* got '9'"
    ):
        jaxpets.fused_rollout(model, num_particles=particles, arch="9")


def test_both_kernels_compute_the_same():
    """From weights that lie otherwise, each sum in the same order."""
    first, second = (
        jax.jit(CHEETAH.of_kind(kind))(*CHEETAH.args())
        for kind in (Kind.WGMMA_REFERENCE, Kind.MMA_REFERENCE)
    )
    np.testing.assert_array_equal(first, second)


NVCC = shutil.which("nvcc")
ARCHS = ("sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")


@pytest.mark.skipif(NVCC is None, reason="needs nvcc")
@pytest.mark.parametrize(
    ("case", "arch"),
    [(PAPER, arch) for arch in ARCHS]
    + [(WIDE, ARCHS[0]), (PAPER, "sm_90a"), (WIDEST, ARCHS[0]), (GELU, "sm_90a")],
)
def test_kernels_are_compiled_without_spills(monkeypatch, asked, tmp_path, case, arch):
    """For every generation of GPUs, and the widest model."""
    capability = f"{arch.strip('sm_a')[:-1]}.{arch.strip('sm_a')[-1]}"
    pretend(monkeypatch, compute_capability=capability)
    kind = Kind.WGMMA if arch == "sm_90a" else Kind.MMA
    assert case.of_kind(kind).uses_kernel
    ((model, _, _),) = asked
    (tmp_path / "model.h").write_text(model)
    command = [NVCC, "-std=c++17", "-O3", "-cubin", f"-arch={arch}", "-Xptxas=-v"]
    folders = [tmp_path, SOURCES, jax.ffi.include_dir()]
    command += [*(f"-I{folder}" for folder in folders), "-o", tmp_path / "rollout"]
    command += [SOURCES / kind.source]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    assert "0 bytes spill stores, 0 bytes spill loads" in done.stderr


def kernel_of(case, kind):
    """The kernel of this kind, on a GPU; that of 9.0 has two."""
    fused, caught = recorded(case.fused)
    assert not caught and fused.uses_kernel
    if fused.arch == "sm_90a":
        return case.of_kind(kind)
    return fused if kind is Kind.MMA else pytest.skip("needs a GPU of 9.0")


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num_samples", [70, 1515])  # tiles and slices in part empty
@pytest.mark.parametrize(
    "name", ["half_cheetah", "free joint", "ball joint", "sensors", "rich"]
)
def test_the_kernel_equals_the_scan(name, num_samples, kind):
    case = dataclasses.replace(CASES[name], num_samples=num_samples)
    with jax.default_device(jax.devices("gpu")[0]):
        fused = kernel_of(case, kind)
        args = case.args()
        got, want = jax.jit(fused)(*args), jax.jit(case.scan())(*args)
        # Its tanh and its exponential have 11 and 22 bits.
        assert relative_error(got, want) <= 1e-3
        many, axes = stacked(case, ["p", "k", "o", "a"])
        mapped = fused
        for in_axes in reversed(axes):
            mapped = jax.vmap(mapped, in_axes)
        one = jax.jit(mapped)(*many)[1, 2, 1, 2]
        last = [jax.tree.map(lambda x: x[-1], arg) for arg in many]
        np.testing.assert_array_equal(one, jax.jit(fused)(*last))


@pytest.mark.gpu
@pytest.mark.parametrize("hidden_sizes", [(272,) * 4, (384,) * 3, (512,) * 4])
@pytest.mark.parametrize("obs_size", [18, 110, 256])
def test_a_wide_kernel_equals_the_scan(hidden_sizes, obs_size):
    """Also on Hopper, whose own kernel has no room for such a model."""
    case = Case(obs_size, 21, hidden_sizes, num_members=5, particles=4, num_samples=200)
    with jax.default_device(jax.devices("gpu")[0]):
        fused = case.fused()
        assert fused.uses_kernel and not fused.arch.endswith("a")
        got, want = jax.jit(fused)(*case.args()), jax.jit(case.scan())(*case.args())
        assert relative_error(got, want) <= 1e-3


# Blocks of one tile, of one and a slice, of two; weights that stay in shared memory, or
# stream through a ring which holds a layer, or does not.
@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num_samples", [70, 500, 1000])
@pytest.mark.parametrize(
    "hidden_sizes", [(64,), (200,) * 4, (208,) * 4, (256,) * 4, (128,) * 8]
)
def test_the_kernel_equals_the_scan_at_every_width(hidden_sizes, num_samples, kind):
    case = dataclasses.replace(
        CHEETAH, hidden_sizes=hidden_sizes, num_samples=num_samples
    )
    with jax.default_device(jax.devices("gpu")[0]):
        fused = kernel_of(case, kind)
        got, want = jax.jit(fused)(*case.args()), jax.jit(case.scan())(*case.args())
        assert relative_error(got, want) <= 1e-3


@pytest.mark.gpu
def test_a_slice_with_many_entries_equals_the_scan():
    """More than its warps draw at once."""
    case = Case(60, 8, (64,) * 2, num_samples=1515)
    with jax.default_device(jax.devices("gpu")[0]):
        fused = kernel_of(case, Kind.WGMMA)
        got, want = jax.jit(fused)(*case.args()), jax.jit(case.scan())(*case.args())
        assert relative_error(got, want) <= 1e-3


@pytest.mark.gpu
@pytest.mark.parametrize("num_samples", [250, 500, 1000])
@pytest.mark.parametrize("hidden_sizes", [(200,) * 4, (208,) * 4])
def test_nothing_overtakes_what_is_read(hidden_sizes, num_samples):
    """What streams is overwritten as soon as all have read it: every time, the same."""
    case = dataclasses.replace(
        CHEETAH, hidden_sizes=hidden_sizes, num_samples=num_samples, horizon=30
    )
    with jax.default_device(jax.devices("gpu")[0]):
        imagine = jax.jit(kernel_of(case, Kind.WGMMA))
        first = imagine(*case.args())
        for _ in range(50):
            np.testing.assert_array_equal(imagine(*case.args()), first)
