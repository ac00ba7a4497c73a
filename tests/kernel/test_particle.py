"""Functions of particle.h on a CPU: right over all of their range, in vectors too."""

import ctypes
import math
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets._src.kernel import build
from jaxpets._src.kernel.build import Kind

# Loops that a compiler makes vectors of, as in the kernel.
SOURCE = """
#include "particle.h"
#define OVER(name)                                                       \\
  extern "C" void name##_row(const float* x, float* out, int64_t size) { \\
    for (int64_t i = 0; i < size; ++i) out[i] = name(x[i]);              \\
  }
OVER(fast_exp)
OVER(fast_log)
OVER(fast_sqrt)
OVER(fast_inverse)
OVER(sine)
OVER(cosine)
extern "C" void normal_row(const uint32_t* bits, float* out, int64_t size) {
  for (int64_t i = 0; i + 32 <= size; i += 32)
    normal(reinterpret_cast<const uint32_t (&)[32]>(bits[i]),
           reinterpret_cast<float (&)[32]>(out[i]));
}
"""
NONE = np.array([np.nan, np.inf, -np.inf], np.float32)


@pytest.fixture(scope="module", params=[Kind.WGMMA_REFERENCE, Kind.CPU])
def call(request, tmp_path_factory):
    """Calls a function on many numbers, built as for the kernel or its reference."""
    folder = tmp_path_factory.mktemp("functions")
    (folder / "functions.cc").write_text(SOURCE)
    built = folder / "functions.so"
    command = [*build._compiler(request.param), "-Wall", "-Werror"]
    files = [f"-I{Path(build.__file__).parent}", "-o", built, folder / "functions.cc"]
    subprocess.run([*command, *files], check=True)
    library = ctypes.CDLL(str(built))

    def call(name, numbers):
        out = np.empty(numbers.shape, np.float32)
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (numbers, out)]
        getattr(library, f"{name}_row")(*pointers, ctypes.c_int64(numbers.size))
        return out

    return call


def spread(low, high, count=1_000_000):
    """Numbers over all of a range, ends too, that are nothing special."""
    inner = np.random.default_rng(0).uniform(low, high, count)
    return np.concatenate([[low, high], inner]).astype(np.float32)


# 2e-7 are less than two units in the last place.


def test_exp(call):
    x = np.concatenate([spread(-87, 88), spread(-1e-3, 1e-3), np.float32([0.0, -0.0])])
    np.testing.assert_allclose(call("fast_exp", x), np.exp(np.float64(x)), rtol=2e-7)


def test_exp_of_what_float32_cannot_hold(call):
    """Beyond, where numbers end or lose their digits, it is infinite or nothing."""
    above = np.concatenate([spread(88.01, 3e38), spread(88.01, 200), [np.inf]])
    assert np.all(call("fast_exp", above.astype(np.float32)) == np.inf)
    below = np.concatenate([spread(-3e38, -87.01), spread(-200, -87.01), [-np.inf]])
    assert np.all(call("fast_exp", below.astype(np.float32)) == 0.0)
    assert np.isnan(call("fast_exp", np.full(33, np.nan, np.float32))).all()


def test_log(call):
    exponents = spread(math.log(1.2e-38), math.log(3.4e38))
    x = np.exp(np.float64(exponents)).astype(np.float32)
    x = np.concatenate([x, spread(0.5, 2.0), spread(0.999, 1.001), np.float32([1.0])])
    np.testing.assert_allclose(call("fast_log", x), np.log(np.float64(x)), rtol=3e-7)


@pytest.mark.parametrize(("name", "exact"), [("sine", np.sin), ("cosine", np.cos)])
@pytest.mark.parametrize("most", [0.01, 3.2, 100.0, 1e4, 1e6])
def test_angles(call, name, exact, most):
    """Next to a zero, too, what is lost is a part of one and not of the result."""
    x = spread(-most, most)
    x = np.concatenate(
        [x, np.arange(-1000, 1000).astype(np.float32) * np.float32(np.pi / 2)]
    )
    np.testing.assert_allclose(call(name, x), exact(np.float64(x)), rtol=0, atol=3e-7)


@pytest.mark.parametrize("name", ["sine", "cosine"])
def test_angles_past_counting_turns_have_some_sine(call, name):
    """A finite state stays finite, as in the scan."""
    x = np.geomspace(1e6, 3e38, 10_000).astype(np.float32)
    assert (np.abs(call(name, np.concatenate([x, -x]))) <= 1).all()


@pytest.mark.parametrize("name", ["sine", "cosine"])
def test_angles_that_are_none(call, name):
    assert np.isnan(call(name, NONE)).all()


def test_roots_and_inverses(call):
    x = np.concatenate([spread(1e-6, 1e6), np.float32([0.0, np.inf, 1e38])])
    with np.errstate(divide="ignore"):
        np.testing.assert_array_equal(call("fast_inverse", x), 1 / x)
    np.testing.assert_array_equal(call("fast_sqrt", x), np.sqrt(x))
    assert np.isnan(call("fast_sqrt", np.float32([-1.0, np.nan]))).all()


# Of the 32 bits 23 count: all 8 million, the ends and the middle among them.
BITS = np.arange(2**23, dtype=np.uint32) << 9


@pytest.fixture(scope="module")
def draws():
    """What jax.random.normal makes of BITS."""

    @jax.jit
    def drawn(bits):
        fraction = jax.lax.bitcast_convert_type(bits >> 9 | 0x3F800000, jnp.float32)
        least = jnp.nextafter(jnp.float32(-1), jnp.float32(0))
        uniform = jnp.maximum(least, (fraction - 1.0) * (1.0 - least) + least)
        return np.sqrt(np.float32(2)) * jax.lax.erf_inv(uniform)

    return np.asarray(drawn(BITS))


def test_every_number_that_a_draw_can_have(call, draws):
    got = call("normal", BITS)
    assert got.min() < -5 and got.max() > 5 and np.isfinite(got).all()
    near = abs(draws) < 2.9
    np.testing.assert_allclose(got[near], draws[near], rtol=2e-6, atol=1e-7)
    # JAX rounds u^2: of 1 - u^2, and so of the logarithm, a tail has lost digits.
    np.testing.assert_allclose(got, draws, rtol=1e-5)
