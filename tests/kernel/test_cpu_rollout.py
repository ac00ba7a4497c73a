"""The kernel on CPUs: any width and precision, blocks of particles, many threads."""

import dataclasses
import functools
import os
import platform
import re
import shutil
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rollouts import (
    CASES,
    CPU,
    SMALL,
    Case,
    needs_cpu,
    put,
    recorded,
    relative_error,
    scan,
    unbounded,
)

from jaxpets import Precision
from jaxpets._src.chunks import window
from jaxpets._src.kernel.build import Kind

pytestmark = needs_cpu

BLOCK = 32  # particles of one member that are imagined together


def test_any_width_and_depth_will_do():
    """Of tiles of six outputs: none, whole ones, and what is left beside them.

    Observations and actions are wide, where a GPU has no room.
    """
    case = Case(130, 140, hidden_sizes=(7, 13, 1, 12, 257), horizon=2)
    args = case.args()
    assert relative_error(CPU.run(case)(*args), scan(case)(*args)) <= CPU.rounding


@pytest.mark.parametrize("precision", Precision)
def test_every_precision_is_float32(precision):
    fused, caught = recorded(lambda: SMALL.fused(precision))
    assert not caught and fused.uses_kernel and fused.reason == ""
    assert re.search(r"(c\+\+|clang) .*\d\.\d", fused.compiler)
    got, want = (
        str(jax.make_jaxpr(f)(*SMALL.avals())) for f in (fused, CPU.fused(SMALL))
    )
    assert got == want and "jaxpets_rollout_cpu_" in got


def test_hidden_units_may_be_far_from_zero():
    """Where their swish is a number times nothing, or the number itself."""
    case = CASES["sensors"]
    params, *rest = case.args()
    layers = params.network.members["params"]
    bias = np.tile(np.linspace(-150, 150, 64, dtype=np.float32), (3, 1))
    layers = layers | {"layer_0": layers["layer_0"] | {"bias": bias}}
    network = params.network._replace(members={"params": layers})
    args = unbounded(params._replace(network=network)), *rest
    assert relative_error(CPU.run(case)(*args), scan(case)(*args)) <= CPU.rounding


# Blocks.


@functools.cache
def many():
    """Arguments of SMALL with 70 candidates; 140 particles of each member."""
    params, key, obs, _ = SMALL.args()
    shape = (70, SMALL.horizon, SMALL.action_size)
    actions = np.random.default_rng(2).uniform(-1, 1, shape).astype(np.float32)
    return params, key, obs, actions


@pytest.mark.parametrize("num_samples", [1, 7, 8, 9, 15, 16, 17, 70])
def test_blocks_need_not_be_full(num_samples):
    """Two particles of each candidate: groups of 16 and blocks of 32, less and more."""
    params, key, obs, actions = many()
    part = window(key, jnp.int32(0), num_samples, 70)  # their noise beside the others
    got = CPU.run(SMALL)(params, part, obs, actions[:num_samples])
    want = np.asarray(scan(SMALL)(params, key, obs, actions))[:num_samples]
    assert relative_error(got, want) <= CPU.rounding


def without(instructions, monkeypatch, folder):
    """Lets the compiler believe in a lesser processor."""
    script = folder / "c++"
    script.write_text(
        f'#!/bin/sh\nexec {shutil.which("c++")} "$@" -mno-{instructions}\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.skipif(platform.machine() != "x86_64", reason="has flags of its own")
def test_processors_with_shorter_vectors_have_smaller_groups(monkeypatch, tmp_path):
    without("avx512f", monkeypatch, tmp_path)
    # Another width: the kernel of a model that was met before would not be built.
    case = dataclasses.replace(SMALL, hidden_sizes=(16, 25), num_samples=70)
    args = case.args()
    assert relative_error(CPU.run(case)(*args), scan(case)(*args)) <= CPU.rounding


@pytest.mark.skipif(platform.machine() != "x86_64", reason="has flags of its own")
def test_processors_that_cannot_multiply_and_add_at_once_have_none(
    monkeypatch, tmp_path
):
    without("fma", monkeypatch, tmp_path)
    case = dataclasses.replace(SMALL, hidden_sizes=(16, 26))
    assert case.of_kind(Kind.CPU).reason == "the processor has no fused multiply-add"


def test_members_have_blocks_of_their_own():
    case = dataclasses.replace(SMALL, num_members=17, particles=13)
    args = case.args()  # 52 particles of each
    assert relative_error(CPU.run(case)(*args), scan(case)(*args)) <= CPU.rounding


def test_a_path_is_the_same_wherever_it_is_computed():
    """At another place in a block, in another block, beside others or beside none."""
    params, key, obs, actions = many()
    run = CPU.run(SMALL)
    silent = params.network._replace(  # the noise depends on the place
        min_logvar=np.full_like(params.network.min_logvar, -np.inf),
        max_logvar=np.full_like(params.network.max_logvar, -np.inf),
    )
    params = params._replace(network=silent)
    path = np.asarray(run(params, key, obs, actions))
    assert np.isfinite(path).all()
    np.testing.assert_array_equal(path[..., 0, :], path[..., 1, :])
    for shift in (1, 7, 16, BLOCK, 69):
        got = run(params, key, obs, np.roll(actions, shift, 0))
        np.testing.assert_array_equal(got, np.roll(path, shift, 0))
    for i in (0, 15, 16, 69):
        got = run(params, key, obs, actions[i : i + 1])
        np.testing.assert_array_equal(np.asarray(got)[0], path[i])


def test_noise_of_the_first_member_does_not_depend_on_how_many_follow():
    """It is counted from the front: a path is that of the first candidates alone."""
    params, key, obs, actions = many()
    run = CPU.run(SMALL)
    path = np.asarray(run(params, key, obs, actions))
    for count in (1, 7, 16, 33):
        got = run(params, key, obs, actions[:count])
        np.testing.assert_array_equal(np.asarray(got)[:, :, 0], path[:count, :, 0])


def test_what_is_not_finite_stays_in_its_place_of_a_block():
    params, key, obs, actions = many()
    run = CPU.run(SMALL)
    path = np.asarray(run(params, key, obs, actions))
    for i, number in ((0, np.nan), (9, np.inf), (16, -np.inf), (69, np.nan)):
        got = np.asarray(run(params, key, obs, put(actions, (i, 1), number)))
        assert np.isnan(got[i, 2:]).all()
        np.testing.assert_array_equal(got[i, :2], path[i, :2])
        np.testing.assert_array_equal(np.delete(got, i, 0), np.delete(path, i, 0))


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("layer", ["layer_0", "layer_1", "layer_2"])
def test_a_sum_that_is_not_finite_goes_where_it_goes_in_the_scan(layer, number):
    """The swish of minus infinity is NaN there: minus infinity times nothing."""
    params, *rest = SMALL.args()
    layers = params.network.members["params"]
    bias = put(layers[layer]["bias"], (0, 1), number)
    layers = layers | {layer: layers[layer] | {"bias": bias}}
    network = params.network._replace(members={"params": layers})
    params = params._replace(network=network)
    got, want = (f(SMALL)(params, *rest) for f in (CPU.run, scan))
    np.testing.assert_array_equal(np.isnan(got), np.isnan(want))


# Calls.


def test_calls_are_equal_to_the_last_bit():
    args = many()
    path = CPU.run(SMALL)(*args)
    for _ in range(20):
        np.testing.assert_array_equal(CPU.run(SMALL)(*args), path)
    eager = CPU.fused(SMALL)(*args)
    np.testing.assert_allclose(eager, path, rtol=1e-5, atol=1e-5)


def test_a_batch_shares_the_threads():
    """Blocks of all members and of the whole batch, with less in each than threads."""
    params, key, obs, actions = many()
    starts = obs * np.linspace(0.5, 1.5, 50, dtype=np.float32)[:, None]
    mapped = jax.jit(jax.vmap(CPU.fused(SMALL), (None, None, 0, None)))
    got = mapped(params, key, starts, actions[:3])
    for path, start in zip(np.asarray(got), starts, strict=True):
        np.testing.assert_array_equal(
            path, CPU.run(SMALL)(params, key, start, actions[:3])
        )


def test_programs_of_many_threads_do_not_wait_for_each_other():
    """More calls at once than XLA has threads, of two programs."""
    params, key, obs, actions = many()
    double = jax.jit(
        lambda *args: [
            CPU.fused(SMALL)(*args),
            CPU.fused(SMALL)(*args[:3], -args[3]),
        ]
    )
    one = CPU.run(SMALL)
    keys = jax.random.split(key, 40)
    wanted = [one(params, key, obs, actions) for key in keys]
    opposite = [one(params, key, obs, -actions) for key in keys]

    def call(i):
        if i % 2:
            return [one(params, keys[i], obs, actions)], [wanted[i]]
        return double(params, keys[i], obs, actions), [wanted[i], opposite[i]]

    with ThreadPoolExecutor(16) as pool:
        futures = [pool.submit(call, i) for i in range(40)]
        for future in futures:
            for got, want in zip(*future.result(timeout=60), strict=True):
                np.testing.assert_array_equal(got, want)
