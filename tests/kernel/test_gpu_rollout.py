"""The kernel for GPUs: on which ones it is built, and that it equals the scan there."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from rollouts import CASES, CHEETAH, SMALL, recorded, relative_error, stacked

from jaxpets._src import fused_rollout as module
from jaxpets._src.kernel.build import Kernel, Kind


def pretend(monkeypatch, **attributes):
    device = SimpleNamespace(platform="gpu", **attributes)
    monkeypatch.setattr(jax, "devices", lambda: [device])


@pytest.mark.parametrize(
    ("attributes", "capability"),
    [
        (dict(compute_capability="8.0"), "8.0"),
        (dict(compute_capability="10.0"), "10.0"),
        (dict(), "unknown"),
    ],
)
def test_on_other_gpus_it_is_the_scan(monkeypatch, attributes, capability):
    pretend(monkeypatch, **attributes)
    fused, _ = recorded(SMALL.fused)
    assert fused.reason == f"the GPU's compute capability is {capability}, not 9.0"
    assert not fused.uses_kernel


def test_on_a_hopper_gpu_the_kernel_is_built(monkeypatch):
    pretend(monkeypatch, compute_capability="9.0")
    asked = []

    def load_kernel(model, kind):
        asked.append((model, kind))
        return Kernel("target", "nvcc 13.0")

    monkeypatch.setattr(module, "load_kernel", load_kernel)
    _, caught = recorded(SMALL.fused)
    assert not caught and SMALL.of_kind(Kind.GPU_REFERENCE).uses_kernel
    (kernel, kind), (reference, other) = asked
    assert (kind, other) == (Kind.GPU, Kind.GPU_REFERENCE)
    # The same model, with the instructions it needs.
    assert kernel.startswith(reference)
    assert "wgmma.mma_async" in kernel and "wgmma" not in reference


@pytest.mark.gpu
@pytest.mark.parametrize(
    "name", ["half_cheetah", "free joint", "ball joint", "sensors", "rich"]
)
def test_the_kernel_equals_the_scan(name):
    case = dataclasses.replace(CASES[name], num_samples=70)  # blocks that are not full
    with jax.default_device(jax.devices("gpu")[0]):
        fused, caught = recorded(case.fused)
        assert not caught and fused.uses_kernel
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


# Weights that stay in shared memory; that stream through a ring which holds a layer, or
# does not; candidates for blocks of one tile, and for blocks of both kinds.
@pytest.mark.gpu
@pytest.mark.parametrize("num_samples", [70, 1000])
@pytest.mark.parametrize(
    "hidden_sizes", [(64,), (200,) * 4, (208,) * 4, (256,) * 4, (128,) * 8]
)
def test_the_kernel_equals_the_scan_at_every_width(hidden_sizes, num_samples):
    case = dataclasses.replace(
        CHEETAH, hidden_sizes=hidden_sizes, num_samples=num_samples
    )
    with jax.default_device(jax.devices("gpu")[0]):
        fused, caught = recorded(case.fused)
        assert not caught and fused.uses_kernel
        got, want = jax.jit(fused)(*case.args()), jax.jit(case.scan())(*case.args())
        assert relative_error(got, want) <= 1e-3
