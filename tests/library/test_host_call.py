"""A function of NumPy inside JAX programs: `jaxpets.envs.host_call`."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets.envs.host_call import host_call


def sums(rows):
    """Returns the sum of a row, and that of its squares."""
    assert isinstance(rows, np.ndarray)
    return np.stack([rows.sum(-1), (rows**2).sum(-1)], -1)


def counted(calls):
    def function(rows):
        calls.append(rows.shape)
        return sums(rows)

    return host_call(function, 2)


@pytest.fixture
def inputs():
    return jax.random.normal(jax.random.key(0), (3, 4, 5))


def test_it_is_the_function(inputs):
    call = host_call(sums, 2)
    for got in (call(inputs[0, 0]), jax.jit(call)(inputs[0, 0])):
        assert got.shape == (2,)
        np.testing.assert_array_equal(got, sums(np.asarray(inputs[0, 0])))


def test_any_nest_of_vmaps_is_one_call(inputs):
    calls = []
    every = jax.jit(jax.vmap(jax.vmap(counted(calls), 1)))
    got = every(inputs)
    assert calls == [(3, 5, 4)] and got.shape == (3, 5, 2)
    np.testing.assert_array_equal(got, sums(np.asarray(inputs).swapaxes(1, 2)))


def test_a_scan_calls_it_every_time(inputs):
    calls = []
    call = counted(calls)

    def step(count, row):
        return count + 1, call(row)

    run = jax.jit(lambda rows: jax.lax.scan(step, 0, rows))
    count, every = run(inputs[0])
    assert calls == [(5,)] * 4 and count == 4
    np.testing.assert_array_equal(every, sums(np.asarray(inputs[0])))


@pytest.mark.parametrize("dtype", [jnp.int32, jnp.bfloat16, jnp.float16])
def test_inputs_become_float32(dtype):
    def function(rows):
        assert rows.dtype == np.float32
        return sums(rows)

    row = jnp.arange(5).astype(dtype)
    np.testing.assert_array_equal(host_call(function, 2)(row), [10.0, 30.0])


def test_an_empty_batch_needs_no_call():
    calls = []
    assert jax.vmap(counted(calls))(jnp.zeros((0, 5))).shape == (0, 2)
    assert not calls


def test_an_eager_call_compiles_once(inputs, caplog):
    call, compiled = host_call(sums, 2), []
    for row in inputs[0]:
        caplog.clear()
        with jax.log_compiles(), caplog.at_level("WARNING"):
            call(row)
        compiled.append(sum("Compiling" in x for x in caplog.messages))
    assert compiled[0] > 0 and not any(compiled[1:])


def test_what_it_gets_cannot_be_written_to(inputs):
    def function(rows):
        rows[:] = 7.0
        return sums(rows)

    with pytest.raises(jax.errors.JaxRuntimeError, match="read-only"):
        jax.block_until_ready(jax.jit(host_call(function, 2))(inputs[0, 0]))


WRONG = [
    lambda rows: rows.sum(-1, keepdims=True),
    lambda rows: sums(rows)[..., None],
    lambda rows: np.zeros(3),
]


@pytest.mark.parametrize("function", WRONG)
def test_another_shape_is_refused(inputs, function):
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"must return \[4, 2\], got"):
        jax.block_until_ready(jax.jit(jax.vmap(host_call(function, 2)))(inputs[0]))


@pytest.mark.parametrize("shape", [(3, 5), (1, 5), ()])
def test_it_takes_one_axis(shape):
    with pytest.raises(ValueError, match=r"inputs must have one axis, \[I\], got"):
        host_call(sums, 2)(jnp.zeros(shape))


def test_it_has_no_gradient(inputs):
    call = host_call(sums, 2)
    with pytest.raises(ValueError, match="do not support JVP"):
        jax.grad(lambda x: call(x).sum())(inputs[0, 0])


def test_what_the_function_raises_is_told(inputs):
    def function(rows):
        raise ValueError("the robot has left the room")

    with pytest.raises(jax.errors.JaxRuntimeError, match="the robot has left the room"):
        jax.block_until_ready(jax.jit(host_call(function, 2))(inputs[0, 0]))


def test_nothing_of_jax_is_between_on_a_cpu(inputs):
    traced = jax.jit(jax.vmap(host_call(sums, 2))).trace(inputs[0])
    program = traced.lower(lowering_platforms=("cpu",)).as_text()
    assert re.findall(r"@(xla_\w*callback)", program) == [
        "xla_buffer_python_cpu_callback"
    ]


def test_other_platforms_get_a_pure_callback(inputs, monkeypatch):
    def default(*operands, default, **_):
        return default(*operands)

    monkeypatch.setattr(jax.lax, "platform_dependent", default)
    call = host_call(sums, 2)
    assert "pure_callback[" in str(jax.make_jaxpr(call)(inputs[0, 0]))
    got = jax.jit(jax.vmap(jax.vmap(call)))(inputs)
    np.testing.assert_array_equal(got, sums(np.asarray(inputs)))


@pytest.mark.gpu
def test_a_gpu_calls_the_function(inputs):
    device = jax.devices("gpu")[0]
    calls = []
    every = jax.jit(jax.vmap(jax.vmap(counted(calls))))
    got = every(jax.device_put(inputs, device))
    assert got.devices() == {device} and calls == [(3, 4, 5)]
    np.testing.assert_array_equal(got, sums(np.asarray(inputs)))
