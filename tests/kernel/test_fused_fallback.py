"""Where there can be no rollout kernel the scan runs, and the result says why."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rollouts
from rollouts import REFERENCE, SMALL, recorded

import jaxpets
from jaxpets import Precision, coordinates
from jaxpets._src.kernel.build import Kind
from jaxpets.coordinates import Coordinate


def assert_is_the_scan(fused, case, words, precision=Precision.BF16):
    assert fused.reason == words and not fused.uses_kernel and not fused.compiler
    args = case.avals()
    scan = str(jax.make_jaxpr(case.scan(precision))(*args))
    assert str(jax.make_jaxpr(fused)(*args)) == scan
    params, *rest = args

    def bound(params, *rest):
        return fused.bind(params)(*rest)

    assert str(jax.make_jaxpr(bound)(params, *rest)) == scan


def test_a_warning_says_why():
    """What, of which entries by their names, and in which line."""
    space = coordinates.space(map(Coordinate, ("height", "pitch", "rate")))
    features = lambda obs: jnp.concatenate([obs, jax.lax.erf(obs[..., 1:])], -1)  # noqa: E731
    case = dataclasses.replace(SMALL, space=space._replace(features=features))
    fused, (warning,) = recorded(case.fused)
    place = f"{Path(__file__).name}:{features.__code__.co_firstlineno}"
    words = (
        f"the primitive 'erf' has no C++ form, in features of pitch and rate ({place})"
    )
    assert str(warning.message) == f"fused_rollout runs as a scan: {words}."
    assert warning.filename == rollouts.__file__  # where it was asked for
    assert_is_the_scan(fused, case, words)


@pytest.mark.parametrize("precision", [Precision.BF16, Precision.F32])
def test_on_other_devices_it_is_the_scan(monkeypatch, precision):
    device = SimpleNamespace(platform="tpu")
    words = {
        Precision.BF16: "the device is a tpu, not a GPU or CPU",
        Precision.F32: "the precision is f32, not bf16",
    }
    with monkeypatch.context() as patch:
        patch.setattr(jax, "devices", lambda: [device])
        fused, (warning,) = recorded(lambda: SMALL.fused(precision))
    assert words[precision] in str(warning.message)
    assert_is_the_scan(fused, SMALL, words[precision], precision)


@pytest.mark.parametrize("precision", [Precision.F32, Precision.TF32])
def test_other_precisions_are_the_scan_on_a_gpu(precision):
    words = f"the precision is {precision.value}, not bf16"
    fused = SMALL.of_kind(Kind.WGMMA_REFERENCE, precision)
    assert_is_the_scan(fused, SMALL, words, precision)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(hidden_sizes=(16, 257)), "hidden layers are wider than 256"),
        (dict(obs_size=129), "observations have more than 128 entries"),
        (dict(action_size=254), "features and action have more than 256 entries"),
        (
            dict(obs_size=128, action_size=128, hidden_sizes=(256, 256)),
            "the model does not fit into the GPU's shared memory",
        ),
    ],
)
def test_what_is_too_large_is_the_scan_on_a_gpu(change, words):
    case = dataclasses.replace(SMALL, **change)
    assert_is_the_scan(case.of_kind(Kind.WGMMA_REFERENCE), case, words)


NEVER = dataclasses.replace(SMALL, hidden_sizes=(40,))  # never built


def test_without_a_compiler_it_is_the_scan(engine, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    words = "no C++ compiler found (c++, g++ or clang++)"
    assert_is_the_scan(NEVER.of_kind(engine.kind), NEVER, words)


def test_with_a_compiler_that_fails_it_is_the_scan(engine, compiler):
    compiler("echo In file included >&2; echo 'a.h:1: error: no' >&2; exit 1")
    words = "c++ failed: a.h:1: error: no"
    assert_is_the_scan(NEVER.of_kind(engine.kind), NEVER, words)


def test_coordinates_that_do_not_fit_are_refused_as_the_scan_refuses_them(engine):
    space = jaxpets.delta_space()._replace(next_obs=lambda obs, target: obs[..., :2])
    case = dataclasses.replace(SMALL, space=space, state_margin=None)
    fused = case.of_kind(engine.kind)
    assert fused.reason == "next_obs makes [2] of [3]"
    with pytest.raises(ValueError, match=r"must be float32\[.*3\], got"):
        jax.eval_shape(fused, *SMALL.args())


@pytest.mark.parametrize("size", [1, 4])
def test_coordinates_that_only_a_bound_makes_fit_are_the_scan(size):
    """A next observation of another size: a kernel has no room for it."""

    def next_obs(obs, target):
        return jnp.concatenate([obs, target], axis=-1)[..., :size]

    space = jaxpets.delta_space()._replace(
        next_obs=next_obs,
        bound=lambda obs, low, high: jnp.clip(obs[..., -3:], low, high),
    )
    case = dataclasses.replace(SMALL, space=space)
    fused = case.of_kind(Kind.WGMMA_REFERENCE)
    assert_is_the_scan(fused, case, f"next_obs makes [{size}] of [3]")


def test_other_kinds_of_keys_run_the_scan():
    """Of a kernel that was built."""
    fused = REFERENCE.fused(SMALL)
    text = "fused_rollout runs as a scan: keys are not partitionable threefry."
    params, key, obs, actions = SMALL.args()
    args = params, jax.random.key(0, impl="rbg"), obs, actions
    got, (warning,) = recorded(lambda: jax.jit(fused)(*args))
    assert str(warning.message) == text
    np.testing.assert_array_equal(got, jax.jit(SMALL.scan(Precision.BF16))(*args))
    with jax.threefry_partitionable(False):
        args = params, key, obs, actions
        _, (warning,) = recorded(lambda: jax.eval_shape(fused, *args))
        assert str(warning.message) == text
