"""C MuJoCo called by XLA: `jaxpets.envs.native_c`, which NumPy's way is a judge of."""

import gc
import os
import re
import shutil
import subprocess
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxpets
from jaxpets._src.kernel.build import BuildError, Kernel, Kind, load_kernel
from jaxpets.envs import engines, native, native_c

ROBOTS = """<mujoco>
  <option integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="9 9 1"/>
    <body name="ball" pos="0 0 0.2"><freejoint/><geom size="0.2" mass="2"/>
      <body name="arm" pos="0.3 0 0"><joint name="arm" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0.1" size="0.05"/>
        <site name="tip" pos="0.4 0 0.1"/></body></body>
    <body name="cart" pos="3 1 0.5"><joint name="cart" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.1 0.2 0.3"/>
      <body name="pole" pos="0 0 0.3"><joint name="pole" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.03"/></body></body>
  </worldbody>
  <actuator>
    <motor joint="arm" ctrlrange="-2 2"/>
    <general joint="cart" dyntype="filter" dynprm="0.1" gainprm="9" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <accelerometer site="tip"/><subtreelinvel body="ball"/><jointvel joint="pole"/>
  </sensor>
</mujoco>"""
PLACES = [
    *(("sensordata", i) for i in range(7)),
    *((array, i) for array in ("xpos", "xipos", "subtree_linvel") for i in range(15)),
    *(("xmat", i) for i in range(45)),
    *(("site_xpos", i) for i in range(3)),
    ("ncon", 0),
]
needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))),
    reason="needs a C++ compiler",
)


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(ROBOTS)


@pytest.fixture(scope="module")
def rows(model):
    """States as they come `[40, *]`: on the ground, in the air, moving."""
    rng, data, found = np.random.default_rng(0), mujoco.MjData(model), []
    for _ in range(40):
        data.ctrl[:] = rng.uniform(-1, 1, 2)
        data.qvel += rng.normal(size=model.nv)
        mujoco.mj_step(model, data, 20)
        row = [data.qpos, data.qvel, data.qacc_warmstart, data.act, data.ctrl]
        found.append([np.float32(x) for x in row])
    return [jnp.asarray(np.stack(x)) for x in zip(*found, strict=True)]


def ways(model, monkeypatch, build):
    """Returns what is built where there is a compiler, and where there is none."""
    by_c = build(model)
    monkeypatch.setattr(native, "c_function", lambda *_, **__: None)
    return by_c, build(model)


def step_of(model, **settings):
    return native.native_physics(model, num_substeps=3, **settings)


def read_of(model):
    return native.native_readings(model, PLACES)


@needs_compiler
@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_steps_are_those_of_numpy(model, rows, monkeypatch, count):
    part = [x[:count] for x in rows]
    got, want = (jax.vmap(f)(*part) for f in ways(model, monkeypatch, step_of))
    jax.tree.map(np.testing.assert_array_equal, got, want)
    assert [x.shape for x in got] == [(count, n) for n in (10, 9, 9, 1)]


@needs_compiler
def test_readings_are_those_of_numpy(model, rows, monkeypatch):
    by_c, by_numpy = ways(model, monkeypatch, read_of)
    got, want = (jax.jit(jax.vmap(f))(*rows) for f in (by_c, by_numpy))
    velocity = slice(7 + 30, 7 + 45)  # sums in another order
    np.testing.assert_allclose(got[:, velocity], want[:, velocity], atol=1e-6)
    rest = np.delete(np.arange(len(PLACES)), np.r_[velocity])
    np.testing.assert_array_equal(got[:, rest], want[:, rest])
    assert got[:, -1].max() > 0


@needs_compiler
def test_a_program_works_without_its_environment(model, rows):
    step = step_of(model)
    want = jax.vmap(step)(*rows)
    program = jax.jit(jax.vmap(step)).lower(*rows).compile()
    del step
    jax.clear_caches()
    gc.collect()
    jax.tree.map(np.testing.assert_array_equal, program(*rows), want)


@needs_compiler
def test_models_and_settings_have_worlds_of_their_own(model, rows, monkeypatch):
    heavy = mujoco.MjModel.from_xml_string(ROBOTS.replace('mass="2"', 'mass="9"'))
    _, want = ways(heavy, monkeypatch, step_of)
    monkeypatch.undo()
    light, got = step_of(model), step_of(heavy)
    assert np.abs(light(*[x[0] for x in rows])[1] - got(*[x[0] for x in rows])[1]).any()
    same = [jax.vmap(f)(*rows) for f in (got, want)]
    jax.tree.map(np.testing.assert_array_equal, *same)


@needs_compiler
def test_a_name_that_nobody_has_opened_is_an_error():
    kernel = load_kernel("", Kind.PHYSICS, needs=native_c._flags())
    shape = jax.ShapeDtypeStruct((3,), jnp.float32)
    call = jax.ffi.ffi_call(kernel.target, shape)
    with pytest.raises(jax.errors.JaxRuntimeError, match="nobody has built the env"):
        jax.block_until_ready(call(jnp.zeros(3), name="nobody"))


@pytest.mark.parametrize("wrong", ["qpos", "qvel", "qacc_warmstart", "act", "ctrl"])
def test_states_of_another_size_are_refused(model, rows, wrong):
    names = "qpos", "qvel", "qacc_warmstart", "act", "ctrl"
    row = {name: x[0] for name, x in zip(names, rows, strict=True)}
    row[wrong] = jnp.zeros(200)
    size = len(rows[names.index(wrong)][0])
    for function in (step_of(model), read_of(model)):
        named = rf"{wrong} must have shape \[{size}\], got \[200\]"
        with pytest.raises(ValueError, match=named):
            function(**row)


@needs_compiler
def test_c_refuses_operands_of_another_size(model):
    step = step_of(model)
    program = jax.jit(step).lower(*jax.eval_shape(lambda: rows_of_zero(model)))
    name = re.search(r'name = "(\w{64})"', program.as_text())[1]
    kernel = native_c._kernel()
    for inputs, outputs in ((200, 29), (30, 500)):
        call = jax.ffi.ffi_call(
            kernel.target, jax.ShapeDtypeStruct((outputs,), jnp.float32)
        )
        with pytest.raises(jax.errors.JaxRuntimeError, match="of another size"):
            jax.block_until_ready(call(jnp.zeros(inputs), name=name))


def rows_of_zero(model):
    sizes = model.nq, model.nv, model.nv, model.na, model.nu
    return [jnp.zeros(size) for size in sizes]


@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="/proc knows of threads")
def test_threads_go_with_environments_and_programs(model, rows):
    def threads():
        return len(os.listdir("/proc/self/task"))

    wide = [jnp.tile(x, (4, 1)) for x in rows]
    jax.block_until_ready(jax.vmap(step_of(model, num_threads=1))(*wide))
    jax.clear_caches()
    gc.collect()
    before = threads()
    step = step_of(model, num_threads=5)
    program = jax.jit(jax.vmap(step)).lower(*wide).compile()
    jax.block_until_ready(program(*wide))
    assert threads() == before + 4
    del step
    jax.clear_caches()
    gc.collect()
    assert threads() <= before
    jax.block_until_ready(program(*wide))
    assert threads() <= before


def test_without_a_compiler_numpy_steps(model, rows, monkeypatch):
    want = jax.vmap(step_of(model))(*rows)
    asked = []

    def fail(*_, **__):
        asked.append(1)
        raise BuildError("no C++ compiler found")

    monkeypatch.setattr(native_c, "load_kernel", fail)
    native_c._kernel.cache_clear()
    try:
        step, _ = step_of(model), step_of(model)
    finally:
        native_c._kernel.cache_clear()
    assert len(asked) == 1
    program = str(jax.make_jaxpr(jax.vmap(step))(*rows))
    assert "buffer_callback" in program and "jaxpets_physics" not in program
    jax.tree.map(np.testing.assert_array_equal, jax.vmap(step)(*rows), want)


def test_mujoco_without_its_library_is_no_error(monkeypatch, tmp_path):
    monkeypatch.setattr(native_c.mujoco, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(BuildError, match="no library of MuJoCo in its package"):
        native_c._flags()


KEPT = """
import logging, jax, jax.numpy as jnp
from jaxpets.envs import half_cheetah
logging.getLogger("jax._src.compiler").setLevel(logging.DEBUG)
logging.getLogger("jax._src.compiler").addHandler(logging.StreamHandler())
env = half_cheetah.half_cheetah_native()
state = env.reset(jax.random.key(0))
print(jax.jit(env.step)(state, jnp.zeros(6)).obs.sum())
"""


@needs_compiler
def test_jaxs_cache_keeps_its_programs(tmp_path):
    settings = {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "PYTHONPATH": str(Path(jaxpets.__file__).parents[1]),
    }
    runs = [
        subprocess.run(
            [sys.executable, "-c", KEPT],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
            env=os.environ | settings,
        )
        for _ in range(2)
    ]
    assert runs[0].stdout == runs[1].stdout
    assert "CACHE MISS for 'jit_step'" in runs[0].stderr
    assert "cache hit for 'jit_step'" in runs[1].stderr


@pytest.mark.parametrize("way", ["c", "numpy"])
def test_a_model_is_what_it_was_when_it_was_built_of(rows, monkeypatch, way):
    model = mujoco.MjModel.from_xml_string(ROBOTS)
    built = ways(model, monkeypatch, step_of)[way == "numpy"]
    read = native.native_readings(model, PLACES)
    want = jax.vmap(built)(*rows), jax.vmap(read)(*rows)
    model.opt.timestep *= 2
    model.body_mass *= 3
    wider = [jnp.concatenate([x, x]) for x in rows]  # a batch that is made anew
    got = [jax.tree.map(lambda x: x[:40], jax.vmap(f)(*wider)) for f in (built, read)]
    jax.tree.map(np.testing.assert_array_equal, tuple(got), want)


def test_only_what_is_known_is_read(model):
    places = ("qfrc_bias", 0), ("xpos", 15), ("xpos", -1), ("ncon", 1)
    for place in places:
        named = re.escape("places must be of sensordata [7], site_xpos [3], xpos [15]")
        with pytest.raises(
            ValueError, match=f"{named}.*, got '{place[0]}', {place[1]}"
        ):
            native.native_readings(model, [("xpos", 3), place])
    late = ROBOTS.replace(
        'ctrlrange="-2 2"', 'ctrlrange="-2 2" delay="0.01" nsample="5"'
    )
    late = mujoco.MjModel.from_xml_string(late)
    with pytest.raises(ValueError, match="no state but positions, velocities and act"):
        native.native_readings(late, PLACES)


def test_without_places_nothing_is_read(model, rows):
    engine = engines.native_engine(model, num_substeps=1)
    qpos, qvel, warmstart, act, action = (x[0] for x in rows)
    physics = engines.Physics(qpos, qvel, warmstart, act)
    assert engine.read(physics, action).shape == (0,)


def test_a_reading_of_one_row_does_not_grow_with_a_batch(model, rows, monkeypatch):
    _, read = ways(model, monkeypatch, read_of)
    want = read(*[x[0] for x in rows])
    every = jax.vmap(read)(*rows)
    np.testing.assert_array_equal(every[0], want)
    np.testing.assert_array_equal(read(*[x[0] for x in rows]), want)


@needs_compiler
@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_no_python_is_called(model, rows, platform):
    program = jax.jit(jax.vmap(step_of(model))).trace(*rows)
    text = program.lower(lowering_platforms=(platform,)).as_text()
    assert "jaxpets_physics" in text and "python" not in text


@pytest.mark.gpu
@pytest.mark.parametrize("count", [0, 1, 40])
def test_a_gpu_gets_what_c_does(model, rows, count):
    part = [x[:count] for x in rows]
    gpu, cpu = jax.devices("gpu")[0], jax.devices("cpu")[0]
    for function in (step_of(model), read_of(model)):
        call = jax.jit(jax.vmap(function))
        got, want = (call(*jax.device_put(part, device)) for device in (gpu, cpu))
        assert all(x.devices() == {gpu} for x in jax.tree.leaves(got))
        jax.tree.map(np.testing.assert_array_equal, got, want)


@pytest.mark.gpu
def test_an_error_of_c_is_told_beside_a_gpu(model, rows):
    call = jax.jit(jax.vmap(step_of(model)))
    given = jax.device_put(rows, jax.devices("gpu")[0])
    mujoco.set_mjcb_control(lambda model, data: None)
    try:
        with pytest.raises(jax.errors.JaxRuntimeError, match="mjcb_control"):
            jax.block_until_ready(call(*given))
    finally:
        mujoco.set_mjcb_control(None)
    assert np.isfinite(call(*given)[0]).all()


def test_no_memory_for_a_model_is_an_error(model, monkeypatch):
    def refuse(*_):
        return False

    library = types.SimpleNamespace(jaxpets_open=refuse)
    kernel = Kernel("none", "none", library)
    monkeypatch.setattr(native_c, "_kernel", lambda: kernel)
    with pytest.raises(MemoryError, match="no memory for another model"):
        step_of(model)
