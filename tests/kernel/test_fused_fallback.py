"""Where there can be no rollout kernel the scan runs, and a warning says why."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rollouts
from rollouts import ENGINES, SMALL, needs_cpu, recorded

import jaxpets
from jaxpets import Precision


@pytest.fixture(params=ENGINES)
def engine(request):
    return request.param


def assert_is_the_scan(case, words, precision=Precision.BF16, *, interpret):
    fused, caught = recorded(lambda: case.fused(precision, interpret=interpret))
    (warning,) = caught
    assert str(warning.message) == f"fused_rollout runs as a scan: {words}."
    assert warning.filename == rollouts.__file__
    args = case.avals()
    got, want = (str(jax.make_jaxpr(f)(*args)) for f in (fused, case.scan(precision)))
    assert got == want


@pytest.mark.parametrize("precision", [Precision.BF16, Precision.F32])
def test_on_other_devices_it_is_the_scan(monkeypatch, precision):
    device = SimpleNamespace(platform="tpu")
    words = {
        Precision.BF16: "the device is a tpu, not a GPU or CPU",
        Precision.F32: "the precision is f32, not bf16",
    }
    with monkeypatch.context() as patch:
        patch.setattr(jax, "devices", lambda: [device])
        assert_is_the_scan(SMALL, words[precision], precision, interpret=False)


@pytest.mark.parametrize("precision", [Precision.F32, Precision.TF32])
def test_other_precisions_are_the_scan(precision):
    words = f"the precision is {precision.value}, not bf16"
    assert_is_the_scan(SMALL, words, precision, interpret=True)


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
def test_what_is_too_large_is_the_scan(change, words):
    case = dataclasses.replace(SMALL, **change)
    assert_is_the_scan(case, words, interpret=True)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (jnp.sort, "the primitive 'sort' has no C++ form"),
        (jnp.cumsum, "the primitive 'cumsum' has no C++ form"),
        (
            lambda obs: obs + obs[..., jnp.int32(0)] * jnp.floor(obs).astype(jnp.int32),
            "values of type int32 have no C++ form",
        ),
        (
            lambda obs: (
                jnp.take(obs, (obs[..., 0] > 0).astype(jnp.int32), axis=-1) + obs
            ),
            "values of type int32 have no C++ form",
        ),
    ],
)
def test_what_cannot_be_written_as_rows_is_the_scan(engine, function, words):
    def features(obs):
        return function(obs).astype(jnp.float32)

    with jax.numpy_dtype_promotion("standard"):
        space = jaxpets.delta_space()._replace(features=features)
        case = dataclasses.replace(SMALL, space=space)
        fused, (warning,) = recorded(lambda: case.fused(interpret=engine.interpret))
    assert str(warning.message) == f"fused_rollout runs as a scan: {words}."
    assert callable(fused)


NEVER = dataclasses.replace(SMALL, hidden_sizes=(40,))  # never built


KNOWS = 'case "$*" in *-dM*) echo "#define __FMA__ 1"; exit;; esac'


def compiler(folder, script, knows=KNOWS):
    """A compiler that is asked what it knows of the processor, and then does this."""
    path = folder / "c++"
    path.write_text(f"#!/bin/sh\n{knows}\n{script}\n")
    path.chmod(0o755)


def test_without_a_compiler_it_is_the_scan(engine, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    words = "no C++ compiler found (c++, g++ or clang++)"
    assert_is_the_scan(NEVER, words, interpret=engine.interpret)


def test_with_a_compiler_that_fails_it_is_the_scan(engine, monkeypatch, tmp_path):
    compiler(tmp_path, "echo In file included >&2; echo 'a.h:1: error: no' >&2; exit 1")
    monkeypatch.setenv("PATH", str(tmp_path))
    words = "c++ failed: a.h:1: error: no"
    assert_is_the_scan(NEVER, words, interpret=engine.interpret)


@needs_cpu
def test_with_a_processor_that_the_compiler_does_not_know_it_is_the_scan(
    monkeypatch, tmp_path
):
    knows = "echo \"c++: error: bad value 'native' for '-march='\" >&2; exit 1"
    compiler(tmp_path, "echo 'it was asked to build' >&2; exit 1", knows)
    monkeypatch.setenv("PATH", str(tmp_path))
    words = "c++ failed: c++: error: bad value 'native' for '-march='"
    assert_is_the_scan(NEVER, words, interpret=False)


def test_with_a_compiler_that_is_no_program_it_is_the_scan(
    engine, monkeypatch, tmp_path
):
    path = tmp_path / "c++"
    path.write_text("")
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert_warns(NEVER, engine, "cannot run c++: ")


def assert_warns(case, engine, words):
    """Of what the system says the end is its own."""
    _, (warning,) = recorded(lambda: case.fused(interpret=engine.interpret))
    text = str(warning.message)
    assert text.startswith(f"fused_rollout runs as a scan: {words}")
    assert "\n" not in text


def test_with_a_library_that_does_not_load_it_is_the_scan(
    engine, monkeypatch, tmp_path
):
    # The last argument but one is where the library goes.
    compiler(tmp_path, 'while [ "$1" != -o ]; do shift; done; echo no > "$2"')
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert_warns(NEVER, engine, "cannot load the compiled")


def test_with_a_cache_that_cannot_be_written_it_is_the_scan(
    engine, monkeypatch, tmp_path
):
    (tmp_path / "jaxpets").write_text("a file, where a folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert_warns(NEVER, engine, "cannot write to the cache")


def test_coordinates_that_do_not_fit_are_refused_as_the_scan_refuses_them(engine):
    space = jaxpets.delta_space()._replace(next_obs=lambda obs, target: obs[..., :2])
    case = dataclasses.replace(SMALL, space=space, state_margin=None)
    fused, (warning,) = recorded(lambda: case.fused(interpret=engine.interpret))
    text = "fused_rollout runs as a scan: next_obs makes [2] of [3]."
    assert str(warning.message) == text
    with pytest.raises(ValueError, match=r"must be float32\[.*3\], got"):
        jax.eval_shape(fused, *SMALL.args())


@pytest.mark.parametrize("size", [1, 4])
def test_coordinates_that_only_a_bound_makes_fit_are_the_scan(engine, size):
    """A next observation of another size: a kernel has no room for it."""

    def next_obs(obs, target):
        return jnp.concatenate([obs, target], axis=-1)[..., :size]

    space = jaxpets.delta_space()._replace(
        next_obs=next_obs,
        bound=lambda obs, low, high: jnp.clip(obs[..., -3:], low, high),
    )
    case = dataclasses.replace(SMALL, space=space)
    fused, _ = recorded(lambda: case.fused(interpret=engine.interpret))
    got = jax.jit(fused)(*case.args())
    want = jax.jit(case.scan(Precision.BF16))(*case.args())
    np.testing.assert_array_equal(got, want)


def test_other_kinds_of_keys_run_the_scan(engine):
    params, _, obs, actions = SMALL.args()
    text = "fused_rollout runs as a scan: keys are not partitionable threefry."
    args = params, jax.random.key(0, impl="rbg"), obs, actions
    got, (warning,) = recorded(lambda: jax.jit(engine.fused(SMALL))(*args))
    assert str(warning.message) == text
    np.testing.assert_array_equal(got, jax.jit(SMALL.scan(Precision.BF16))(*args))
    with jax.threefry_partitionable(False):
        args = params, jax.random.key(0), obs, actions
        _, (warning,) = recorded(lambda: jax.eval_shape(engine.fused(SMALL), *args))
        assert str(warning.message) == text
