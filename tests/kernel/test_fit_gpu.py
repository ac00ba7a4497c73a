"""The kernel that trains, compiled for Hopper, and on it."""

import shutil
import subprocess

import jax
import numpy as np
import pytest
from fits import SMALL, SOURCES, Fit, dataset_of, distance, recorded, start

from jaxpets import Precision

PAPER = Fit((200,) * 4, 18, 6, 5, num_epochs=2)
WIDE = Fit((256,) * 4, 18, 6, 5, "gelu")  # 16 rows at once
RAGGED = Fit((130, 90, 210), 50, 12, 3, "tanh", batch_size=48)
NVCC = shutil.which("nvcc")


@pytest.mark.skipif(NVCC is None, reason="needs nvcc")
@pytest.mark.parametrize("case", [PAPER, WIDE], ids=["paper", "wide"])
def test_it_is_compiled_for_hopper(tmp_path, case):
    """With at most a register of each moment spilled: they are as many as fit."""
    layout = case.but(ctas=16, threads=256).layout()
    (tmp_path / "model.h").write_text(layout.header())
    command = [NVCC, "-std=c++17", "-O3", "-cubin", "-arch=sm_90a", "-Xptxas=-v"]
    folders = [tmp_path, SOURCES, jax.ffi.include_dir()]
    command += [*(f"-I{folder}" for folder in folders), "-o", tmp_path / "fit"]
    command += [SOURCES / "fit_epoch.cu"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "spill" in line]
    spilled = int(line.split(" bytes spill stores")[0].split()[-1])
    assert spilled <= 128  # bytes of a thread, of its 1020


def ends(case, build, dataset):
    """Where training ends, and its metrics, as seen from a start."""
    params, key, state = start(case)
    fitter = build(case)
    after, _, metrics = jax.jit(fitter.step)(params, key, state, dataset)
    return jax.device_get((after, metrics))


@pytest.mark.gpu
@pytest.mark.parametrize(
    "case",
    [
        SMALL,
        PAPER,
        PAPER.but(batch_size=256, bootstrap=False, final_rate=0.0, num_epochs=4),
        WIDE,
        RAGGED,
    ],
    ids=["small", "paper", "batches of 256", "wide", "ragged"],
)
def test_it_trains_on_a_hopper_gpu_as_the_fitter(case):
    """It is as far from the fitter in float32 as TF32 takes the fitter itself.

    Rounding differs in every update, and Adam makes whole steps of small gradients, so
    both ends are compared with the way from the start. A fault of the kernel is of the
    size of an update: a tenth of the way, or NaN.
    """
    with jax.default_device(jax.devices("gpu")[0]):
        fused, caught = recorded(case.fused)
        if "compute capability 9.0" in fused.reason:
            pytest.skip("needs a GPU of 9.0")
        assert not caught and fused.uses_kernel, fused.reason
        dataset = case.dataset(300, capacity=400)
        got, shown = ends(case, lambda _: fused, dataset)
        exact, want = ends(case.but(precision=Precision.F32), Fit.plain, dataset)
        rounded, _ = ends(case, Fit.plain, dataset)
        way = distance(exact, start(case)[0])
    tf32 = distance(rounded, exact) / way
    # As much as TF32 does, up to chance, and what float32 does with a large margin.
    assert distance(got, exact) / way < 2.0 * tf32 + 1e-3
    assert shown.num_skipped == want.num_skipped == 0
    np.testing.assert_allclose(shown.nll, want.nll, rtol=1e-2, atol=1e-2)
    np.testing.assert_allclose(shown.mse, want.mse, rtol=1e-2)


@pytest.mark.gpu
def test_it_drops_what_the_fitter_drops_on_a_hopper_gpu():
    """And takes seeds; one, whose numbers are those of all."""
    case = SMALL.but(batch_size=10)
    data = case.transitions(70)
    data.next_obs[5, 0] = np.nan
    with jax.default_device(jax.devices("gpu")[0]):
        fused, _ = recorded(case.fused)
        if not fused.uses_kernel:
            pytest.skip("needs a GPU of 9.0")
        _, shown = ends(case, lambda _: fused, dataset_of(data, 70))
        _, want = ends(case, Fit.plain, dataset_of(data, 70))
        assert shown.num_skipped == want.num_skipped > 0
        params, key, state = jax.tree.map(lambda x: x[None], start(case))
        mapped = jax.jit(jax.vmap(fused.step, (0, 0, 0, None)))
        _, _, one = mapped(params, key, state, dataset_of(data, 70))
        np.testing.assert_array_equal(one.nll[0], shown.nll)
