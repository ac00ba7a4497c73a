"""JAX functions of one row, written out as C++: the compiler's numbers are JAX's."""

import ctypes
import functools
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxpets._src.kernel import jaxpr_to_cpp, primitives
from jaxpets._src.kernel.jaxpr_to_cpp import UnsupportedError, cpp_function

NAN, INF = np.nan, np.inf
# Rows: ordinary numbers, those with an own rule, and those that are none.
PAIRS = [
    ([0.5, -1.25, 2.0, -3.5], [1.5, -0.75, 2.0, 0.25]),
    ([0.0, -0.0, 1e-3, 12.0], [2.0, 1.0, -1e-3, -12.0]),
    ([0.7, 0.1, 0.9, 0.4], [0.2, 0.6, 0.9, 0.8]),
    ([NAN, 1.0, NAN, INF], [1.0, NAN, NAN, -INF]),
    ([INF, -INF, 3.0, -2.0], [1.0, 2.0, INF, -INF]),
]
PAIRS = [tuple(np.array(row, np.float32) for row in pair) for pair in PAIRS]
TABLE = np.array([3.0, -1.5, NAN, INF, -INF, 0.25], np.float32)


def constant(x, y):
    return jnp.float32([1.0, -2.5, jnp.nan, -jnp.inf])


def nested(x, y):
    return jax.jit(lambda a: jax.jit(jnp.sin)(a) + jax.jit(lambda b: b * y)(a))(x)


@jax.custom_vjp
def with_own_gradient(x):
    return x * 2.0


with_own_gradient.defvjp(lambda x: (x * 2.0, None), lambda _, g: (g,))

# Names of primitives, each written as `primitives.ELEMENTWISE` has it.
ELEMENTWISE = {
    "abs": lambda x, y: abs(x),
    "add": lambda x, y: x + y,
    "and": lambda x, y: ((x > 0) & (y > 0)).astype(jnp.float32),
    "atan2": jnp.arctan2,
    "ceil": lambda x, y: jnp.ceil(x),
    "clamp": lambda x, y: lax.clamp(-1.0, x, y),
    "copy": lambda x, y: jnp.copy(x),
    "cos": lambda x, y: jnp.cos(x),
    "div": lambda x, y: x / y,
    "eq": lambda x, y: (x == y).astype(jnp.float32),
    "exp": lambda x, y: jnp.exp(x),
    "floor": lambda x, y: jnp.floor(x),
    "ge": lambda x, y: (x >= y).astype(jnp.float32),
    "gt": lambda x, y: (x > y).astype(jnp.float32),
    "is_finite": lambda x, y: jnp.isfinite(x).astype(jnp.float32),
    "le": lambda x, y: (x <= y).astype(jnp.float32),
    "log": lambda x, y: jnp.log(x),
    "log1p": lambda x, y: jnp.log1p(x),
    "logistic": lambda x, y: jax.nn.sigmoid(x),
    "lt": lambda x, y: (x < y).astype(jnp.float32),
    "max": jnp.maximum,
    "min": jnp.minimum,
    "mul": lambda x, y: x * y,
    "ne": lambda x, y: (x != y).astype(jnp.float32),
    "neg": lambda x, y: -x,
    "not": lambda x, y: (~(x > y)).astype(jnp.float32),
    "or": lambda x, y: ((x > 0) | (y > 0)).astype(jnp.float32),
    "pow": lambda x, y: x**y,
    "rsqrt": lambda x, y: lax.rsqrt(x),
    "select_n": lambda x, y: jnp.where(x > 0.0, x, y),
    "sin": lambda x, y: jnp.sin(x),
    "sqrt": lambda x, y: jnp.sqrt(x),
    "square": lambda x, y: jnp.square(x),
    "stop_gradient": lambda x, y: lax.stop_gradient(x),
    "sub": lambda x, y: x - y,
    "tan": lambda x, y: jnp.tan(x),
    "tanh": lambda x, y: jnp.tanh(x),
}
OTHERS = {
    # Powers.
    "cube": lambda x, y: x**3,
    "inverse": lambda x, y: x**-1,
    "inverse_square": lambda x, y: x**-2,
    "power_0": lambda x, y: x**0 + y,
    "root": lambda x, y: x**0.5,
    # Choices.
    "clip": lambda x, y: jnp.clip(x, -1.0, 1.5),
    "clip_by_rows": lambda x, y: jnp.clip(x, y - 1.0, y),
    "clamp_by_nan": lambda x, y: lax.clamp(jnp.float32(NAN), x, 1.0),
    "clamp_crossed": lambda x, y: lax.clamp(2.0, x, -2.0),
    "where_constant": lambda x, y: jnp.where(np.array([1, 0, 1, 0], bool), x, y),
    "select_by_number": lambda x, y: lax.select_n(
        np.array([1, 0, 0, 1], np.int32), x, y
    ),
    "relu": lambda x, y: jax.nn.relu(x),
    "softplus": lambda x, y: jax.nn.softplus(x),
    "swish": lambda x, y: jax.nn.swish(x),
    "weak": lambda x, y: jnp.where(x > 0.0, 1.0, 0.0) + y,
    "as_bool": lambda x, y: x.astype(bool).astype(jnp.float32),
    "is_nan": lambda x, y: jnp.isnan(x).astype(jnp.float32),
    # Sums and extremes.
    "sum": lambda x, y: jnp.sum(x, keepdims=True),
    "mean_of_squares": lambda x, y: jnp.mean(x**2) + y,
    "maximum": lambda x, y: jnp.max(x, keepdims=True) + y,
    "minimum": lambda x, y: jnp.min(x, keepdims=True) * y,
    "norm": lambda x, y: jnp.linalg.norm(x - y)[None],
    "sum_of_columns": lambda x, y: jnp.sum(jnp.stack([x, y, x * y]), 0),
    "sum_of_middle": lambda x, y: jnp.sum(jnp.outer(x, y).reshape(2, 8, 1), (0, 2)),
    "max_of_both": lambda x, y: jnp.max(jnp.stack([x, y]).reshape(2, 2, 2), (2, 0)),
    "sum_of_nothing": lambda x, y: jnp.sum(x[4:], keepdims=True) + y,
    "max_of_nothing": lambda x, y: jnp.max(x[4:], initial=-2.0) + y,
    "sum_of_none": lambda x, y: lax.reduce_sum_p.bind(x, axes=(), out_sharding=None),
    # Moves.
    "unstack": lambda x, y: jnp.unstack(jnp.stack([x, y], -1))[1],
    "entry": lambda x, y: x[..., 2, None] - y[-1],
    "reversed": lambda x, y: x[::-1],
    "strided": lambda x, y: jnp.concatenate([y[1::2], x[::2]]),
    "flip_of_two": lambda x, y: lax.rev(jnp.stack([x, y]), (0, 1)),
    "gather": lambda x, y: x[jnp.array([3, 0, 0, -1])] + y,
    "gather_rows": lambda x, y: jnp.stack([x, y])[jnp.array([1, 0, 1])],
    "gather_beyond": lambda x, y: x.at[jnp.array([1, 9])].get(mode="fill") + y[:2],
    "gather_fill": lambda x, y: x.at[jnp.array([1, 9])].get(
        mode="fill", fill_value=-3.0
    ),
    "gather_clipped": lambda x, y: x.at[jnp.array([1, 9])].get(mode="clip"),
    "take": lambda x, y: jnp.take(x, np.array([2, 1])) * 2.0,
    "dynamic_slice": lambda x, y: lax.dynamic_slice(x, (jnp.int32(1) + 1,), (2,)),
    "reshape": lambda x, y: jnp.concatenate([x, y]).reshape(2, 2, 2).reshape(-1),
    "transpose": lambda x, y: jnp.stack([x, y, y]).reshape(2, 3, 2).transpose(2, 0, 1),
    "pad": lambda x, y: lax.pad(x, y[0], ((1, 2, 1),)),
    "pad_negative": lambda x, y: lax.pad(x, 0.5, ((-1, 1, 0),)),
    "roll": lambda x, y: jnp.roll(x, 1),
    "split": lambda x, y: jnp.concatenate(jnp.split(x, 2)[::-1]),
    "tile": lambda x, y: jnp.tile(x, 2) + jnp.repeat(y, 2),
    "squeeze": lambda x, y: jnp.squeeze(x[None, :, None], (0, 2)),
    "scalar": lambda x, y: x[0] * y[1],
    "numbers_between": lambda x, y: (
        -jnp.tanh(
            jnp.concatenate([x, jnp.float32([-0.5, NAN, INF, -INF, -0.0, 1e-42])])
        )
    ),
    # Numbers that are known.
    "constant": constant,
    "table": lambda x, y: jnp.concatenate([x, y[:2]]) * TABLE,
    "folded": lambda x, y: x * jnp.sum(jnp.sort(jnp.arange(5.0)) ** 2) + 1.0 / 3.0,
    "large": lambda x, y: x * 3e38 + -1e-38,
    "iota": lambda x, y: x + lax.iota(jnp.float32, 4),
    "comparison": lambda x, y: jnp.where(jnp.arange(4) != 2, x, -jnp.inf),
    "first": lambda x, y: x,
    # Functions of functions.
    "nested": nested,
    "own_gradient": lambda x, y: with_own_gradient(x) + y,
}
FUNCTIONS = ELEMENTWISE | OTHERS
# XLA's and C's functions differ by some roundings.
CLOSE = dict(rtol=3e-6, atol=1e-6)
SIZES = [("x", 4), ("y", 4)]


@functools.cache
def size_of(name):
    return jax.eval_shape(FUNCTIONS[name], *PAIRS[0]).size


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """All functions in one library, callable from here."""
    folder = tmp_path_factory.mktemp("rows")
    lines = ['#include "particle.h"']
    for name, function in FUNCTIONS.items():
        lines.append(cpp_function(f"f_{name}", function, SIZES))
        pointer = f"reinterpret_cast<float (&)[{size_of(name)}]>(*out)"
        lines.append(
            f'extern "C" void {name}_row(const float* x, const float* y, float* out) {{'
            "const auto& a = reinterpret_cast<const float (&)[4]>(*x);"
            "const auto& b = reinterpret_cast<const float (&)[4]>(*y);"
            f"f_{name}(a, b, {pointer}); }}"
        )
    source, built = folder / "rows.cc", folder / "rows.so"
    source.write_text("\n".join(lines))
    flags = ["-std=c++17", "-O1", "-shared", "-fPIC", "-Wall", "-Werror"]
    headers = Path(jaxpr_to_cpp.__file__).parent
    command = [shutil.which("c++"), *flags, f"-I{headers}", "-o", built, source]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(built))


def test_every_expression_is_tested():
    assert set(ELEMENTWISE) == set(primitives.ELEMENTWISE)


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_each_function_is_what_it_is_called(name):
    """Else an expression would pass because JAX wrote another."""
    assert f" {name}" in str(jax.make_jaxpr(FUNCTIONS[name])(*PAIRS[0]))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_equals_jax(library, name):
    function = jax.jit(FUNCTIONS[name])
    for x, y in PAIRS:
        want = np.asarray(function(x, y), np.float32).reshape(-1)
        got = np.full(size_of(name), 77.0, np.float32)
        pointers = [row.ctypes.data_as(ctypes.c_void_p) for row in (x, y, got)]
        getattr(library, f"{name}_row")(*pointers)
        np.testing.assert_allclose(got, want, **CLOSE, err_msg=f"{x} {y}")


@pytest.mark.parametrize("turns", [1, 100, 10_000])
def test_angles_of_many_turns(library, turns):
    """Two pi is cut in three: the angle keeps its digits, and XLA agrees."""
    angles = 2 * np.pi * turns * np.array([1, -1, 0.6, -0.3])
    x, out = angles.astype(np.float32), np.zeros(4, np.float32)
    for name, function in (("sin", np.sin), ("cos", np.cos)):
        pointers = [row.ctypes.data_as(ctypes.c_void_p) for row in (x, x, out)]
        getattr(library, f"{name}_row")(*pointers)
        np.testing.assert_allclose(out, function(np.float64(x)), atol=1e-6 * turns**0.5)


def test_what_moves_costs_nothing():
    text = cpp_function("f", lambda x, y: jnp.concatenate([y[::-1], x[1:2]]), SIZES)
    assert text == (
        "template <class In0, class In1, class Out>\n"
        "PARTICLE_FUNCTION void f(const In0& x, const In1& y, Out&& out) {\n"
        "  out[0] = y[3];\n  out[1] = y[2];\n  out[2] = y[1];\n"
        "  out[3] = y[0];\n  out[4] = x[1];\n}\n"
    )


def test_what_is_known_is_computed_now():
    function = lambda x, y: x[:1] * jnp.cumsum(jnp.arange(4.0))[-1]  # noqa: E731
    text = cpp_function("f", function, SIZES)
    assert "const float v0 = (x[0] * 0x1.8000000000000p+2f);" in text
    assert text.count("const float v") == 1


def test_rows_have_the_sizes_that_were_asked_for():
    text = cpp_function("f", lambda a: a[::-1], [("a", 7)])
    assert "out[0] = a[6];" in text and "out[6] = a[0];" in text
    assert "[7]" not in text


def test_strict_promotion_and_tracing_around_it():
    """Also while another program is being traced."""
    texts = []

    def outer(z):
        texts.append(cpp_function("f", FUNCTIONS["folded"], SIZES))
        return z

    jax.jit(outer)(1.0)
    assert texts == [cpp_function("f", FUNCTIONS["folded"], SIZES)]


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda x, y: jnp.sort(x), "the primitive 'sort' has no C++ form"),
        (lambda x, y: jnp.cumsum(x), "the primitive 'cumsum' has no C++ form"),
        (lambda x, y: x.at[0].set(1.0), "the primitive 'scatter' has no C++ form"),
        (lambda x, y: x @ y, "the primitive 'dot_general' has no C++ form"),
        (lambda x, y: jnp.argmax(x), "the primitive 'argmax' has no C++ form"),
        (lambda x, y: jnp.any(x > 0), "the primitive 'reduce_or' has no C++ form"),
        (
            lambda x, y: y[(x > 0).astype(jnp.int32)],
            "values of type int32 have no C++ form",
        ),
        (
            lambda x, y: x.astype(jnp.bfloat16) + y.astype(jnp.bfloat16),
            "values of type bfloat16 have no C++ form",
        ),
        (
            lambda x, y: lax.select_n(np.array([0, 1, 2, 0], np.int32), x, y, x + y),
            "a choice among more than two has no C++ form",
        ),
        (
            lambda x, y: lax.while_loop(lambda z: z[0] < 1.0, lambda z: z + 1.0, x),
            "the primitive 'while' has no C++ form",
        ),
        (
            lambda x, y: jax.jit(lambda z: jnp.sort(z * 2.0))(x),
            "the primitive 'sort' has no C++ form",
        ),
    ],
)
def test_what_has_no_form_says_so(function, words):
    with pytest.raises(UnsupportedError) as error:
        cpp_function("f", function, SIZES)
    assert str(error.value).startswith(f"{words}, in f of ")


def said(function, called=None, sizes=SIZES):
    """What is said of a function that has no form, after what it does."""
    with pytest.raises(UnsupportedError) as error:
        cpp_function("f", function, sizes, called)
    return str(error.value).partition(" form, ")[2]


def test_what_has_no_form_is_said_to_be_of_its_entries():
    """Of those that it is computed from, in the order of the arguments."""
    assert said(lambda x, y: jnp.sort(x)[:0]).startswith(
        "in f of x[0], x[1], x[2] and 1 more ("
    )
    mixed = lambda x, y: jnp.concatenate([x, lax.erf(jnp.sin(y[3:] * x[1:2] + y[3:]))])  # noqa: E731
    assert said(mixed).startswith("in f of x[1] and y[3] (")
    called = {"x[1]": "qpos/hip", "y[3]": "qvel/hip"}
    assert said(mixed, called).startswith("in f of qpos/hip and qvel/hip (")
    same = {"x[1]": "hip", "y[3]": "hip"}  # one entry, and what moves it
    assert said(mixed, same).startswith("in f of hip (")
    nothing = lambda x, y: lax.erf(jnp.sum(x[4:], keepdims=True))  # noqa: E731
    assert said(nothing).startswith("in f (")


def test_what_has_no_form_is_said_to_be_in_its_line():
    """Where the model asks for it, not where a function that it calls does."""
    inner = jax.jit(lambda x: jnp.sort(x * 2.0))
    function = lambda x, y: x + inner(y)  # noqa: E731
    file, line = Path(__file__).name, function.__code__.co_firstlineno
    assert said(function).endswith(f"and 1 more ({file}:{line})")
    # The function is not the model's own.
    assert said(jnp.sort, sizes=SIZES[:1]) == "in f of x[0], x[1], x[2] and 1 more"
