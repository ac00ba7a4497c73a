"""A function of NumPy inside JAX programs: `jaxpets.envs.host_call`."""

import ctypes
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpets.envs import host_call as module
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


@pytest.mark.parametrize(("platform", "target"), [("cpu", "cpu"), ("cuda", "gpu")])
def test_nothing_of_jax_is_between(inputs, platform, target):
    traced = jax.jit(jax.vmap(host_call(sums, 2))).trace(inputs[0])
    program = traced.lower(lowering_platforms=(platform,)).as_text()
    assert re.findall(r"@(xla_\w*callback)", program) == [
        f"xla_buffer_python_{target}_callback"
    ]


def test_platforms_that_have_neither_get_a_pure_callback(inputs, monkeypatch):
    def default(*operands, default, **_):
        return default(*operands)

    monkeypatch.setattr(jax.lax, "platform_dependent", default)
    call = host_call(sums, 2)
    assert "pure_callback[" in str(jax.make_jaxpr(call)(inputs[0, 0]))
    got = jax.jit(jax.vmap(jax.vmap(call)))(inputs)
    np.testing.assert_array_equal(got, sums(np.asarray(inputs)))


# -- a GPU, and its driver ------------------------------------------------------------


class Buffer:
    """Memory of the host in the place of a GPU's."""

    def __init__(self, array):
        self.array, self.shape = array, array.shape
        self.__cuda_array_interface__ = {"data": (array.ctypes.data, False)}

    def __dlpack_device__(self):
        return 2, 0  # CUDA


class Context:
    stream = 7


class Driver:
    """What is called of libcuda, with memory of the host."""

    def __init__(self, error=0):
        self.called, self.error = [], error

    def copy(self, there, here, size, stream):
        assert stream.value == Context.stream
        ctypes.memmove(there, here, size.value)
        return self.error

    def cuMemcpyDtoHAsync_v2(self, *arguments):  # noqa: N802 - the driver's name
        self.called.append("from")
        return self.copy(*arguments)

    def cuStreamSynchronize(self, stream):  # noqa: N802 - the driver's name
        assert stream.value == Context.stream
        self.called.append("wait")
        return 0

    def cuMemcpyHtoDAsync_v2(self, *arguments):  # noqa: N802 - the driver's name
        self.called.append("to")
        return self.copy(*arguments)


@pytest.fixture
def on_cuda(monkeypatch):
    """Returns what is called of a GPU with this driver and function."""

    def build(driver, function=sums):
        made = []

        def taken(callback, shape, **_):
            made.append(callback)

        monkeypatch.setattr(module, "buffer_callback", taken)
        monkeypatch.setattr(ctypes, "CDLL", lambda name: driver)
        module._driver.cache_clear()
        host_call(function, 2)
        return made[0]

    yield build
    module._driver.cache_clear()


def test_a_gpu_copies_there_and_back(on_cuda):
    driver = Driver()

    def function(rows):
        driver.called.append("function")
        return sums(rows)

    rows = np.arange(15, dtype=np.float32).reshape(3, 5)
    out = np.zeros((3, 2), np.float32)
    on_cuda(driver, function)(Context, Buffer(out), Buffer(rows))
    np.testing.assert_array_equal(out, sums(rows))
    assert driver.called == ["from", "wait", "function", "to", "wait"]


@pytest.mark.parametrize("function", WRONG)
def test_a_gpu_gets_no_other_shape(on_cuda, function):
    driver = Driver()
    rows, out = np.ones((4, 5), np.float32), np.zeros((4, 2), np.float32)
    with pytest.raises(ValueError, match=r"must return \[4, 2\], got"):
        on_cuda(driver, function)(Context, Buffer(out), Buffer(rows))
    assert "to" not in driver.called and not out.any()


def test_an_error_of_the_driver_is_told(on_cuda):
    rows, out = np.zeros((1, 5), np.float32), np.zeros((1, 2), np.float32)
    with pytest.raises(RuntimeError, match=r"cuMemcpyDtoHAsync_v2 .* failed with 201"):
        on_cuda(Driver(error=201))(Context, Buffer(out), Buffer(rows))


@pytest.mark.gpu
def test_a_gpu_calls_the_function(inputs):
    device = jax.devices("gpu")[0]
    calls = []
    every = jax.jit(jax.vmap(jax.vmap(counted(calls))))
    got = every(jax.device_put(inputs, device))
    assert got.devices() == {device} and calls == [(3, 4, 5)]
    np.testing.assert_array_equal(got, sums(np.asarray(inputs)))
