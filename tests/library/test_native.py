"""HalfCheetah on C MuJoCo: its physics to the bit, whatever surrounds it."""

import dataclasses
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import c_step, visited_states

import jaxpets
from experiments.build import build
from experiments.presets import PRESETS
from jaxpets.envs import env_rollout, native
from jaxpets.envs import half_cheetah as hc
from jaxpets.envs.engines import Physics

STATES = 200
# The physics is the same to the bit, wherever it is called from. XLA may divide by the
# time step as a product for the velocity, which is one rounding apart.
ROUNDING = {"rtol": 1e-6, "atol": 1e-6}


@pytest.fixture(scope="module")
def model():
    return hc.load_model()


def by_numpy(monkeypatch):
    """Lets environments call NumPy, as where there is no compiler."""
    monkeypatch.setattr(native, "c_function", lambda *_, **__: None)


@pytest.fixture(scope="module", params=["c", "numpy"])
def env(request):
    with pytest.MonkeyPatch.context() as monkeypatch:
        if request.param == "numpy":
            by_numpy(monkeypatch)
        yield hc.half_cheetah_native()


@pytest.fixture(scope="module")
def states(model):
    """Half upright, half tumbled `[STATES]`, as they come in a run."""
    qpos, qvel, warmstart = visited_states(model, STATES)
    velocity = np.zeros_like(qpos[:, :1])
    obs = np.concatenate([velocity, qpos[:, 1:], qvel], axis=-1)
    state = jaxpets.EnvState(obs, Physics(qpos, qvel, warmstart))
    return jax.tree.map(jnp.asarray, state)


@pytest.fixture(scope="module")
def actions():
    rng = np.random.default_rng(1)
    return jnp.asarray(rng.uniform(-1, 1, (STATES, 6)), jnp.float32)


@pytest.fixture(scope="module")
def after(env, states, actions):
    return jax.jit(jax.vmap(env.step))(states, actions)


def assert_same(got, want):
    jax.tree.map(np.testing.assert_array_equal, got, want)


def first(count, tree):
    return jax.tree.map(lambda x: x[:count], tree)


# -- physics -------------------------------------------------------------------------


def test_one_step_is_that_of_c_rounded_once(model, states, actions, after):
    qpos, qvel, warmstart = (np.asarray(x) for x in states.physics[:3])
    want, contacts = c_step(model, qpos, qvel, warmstart, np.asarray(actions))
    assert (contacts > 0).mean() > 0.5
    np.testing.assert_array_equal(after.physics.qpos, np.float32(want[0]))
    np.testing.assert_array_equal(after.physics.qvel, np.float32(want[1]))
    velocity = (want[0][:, 0] - qpos[:, 0]) / hc.TIMESTEP
    seen = np.concatenate([velocity[:, None], want[0][:, 1:], want[1]], axis=-1)
    # The velocity is a difference of positions of up to 10 m that were rounded.
    np.testing.assert_allclose(after.obs, seen, rtol=1e-5, atol=2e-5)


def test_the_warm_start_goes_in_and_comes_out(states, actions):
    # With one iteration the solver gets no further than it started.
    model = hc.load_model()
    model.opt.iterations = 1
    step = jax.jit(jax.vmap(native.native_physics(model, num_substeps=2)))
    got = Physics(*step(*states.physics, actions))
    data = mujoco.MjData(model)
    for i in range(0, STATES, 9):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = (
            x[i] for x in states.physics[:3]
        )
        data.ctrl[:] = actions[i]
        mujoco.mj_step(model, data, 2)
        np.testing.assert_array_equal(got.qpos[i], np.float32(data.qpos))
        np.testing.assert_array_equal(got.qvel[i], np.float32(data.qvel))
        want = np.float32(data.qacc_warmstart)
        np.testing.assert_array_equal(got.qacc_warmstart[i], want)
    cold = states.physics._replace(qacc_warmstart=jnp.zeros((STATES, 9), jnp.float32))
    assert np.abs(step(*cold, actions)[1] - got.qvel).max() > 1e-3


def test_reset_is_that_of_mjx(env, key):
    keys = jax.random.split(key, 5)
    got, want = (jax.jit(jax.vmap(e.reset))(keys) for e in (env, hc.half_cheetah()))
    assert_same(got, want)
    np.testing.assert_array_equal(env.action_low, -np.ones(6))
    np.testing.assert_array_equal(env.action_high, np.ones(6))


def test_state_keeps_its_avals(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((6,), jnp.float32))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
        assert a.dtype == jnp.float32


def test_what_is_not_finite_is_nan_and_stays_alone(env, states, actions, after):
    count = 8
    state, action = first(count, (states, actions))
    qpos, qvel, warmstart, _ = state.physics
    physics = Physics(
        qpos.at[0, 4].set(jnp.nan),
        qvel.at[1, 3].set(jnp.inf).at[2].set(1e9),  # C resets what is too fast
        warmstart.at[3, 0].set(jnp.nan),
    )
    action = action.at[4, 2].set(jnp.nan)
    step = jax.jit(jax.vmap(env.step))
    got = step(state._replace(physics=physics), action)
    for leaf in jax.tree.leaves(got.physics):
        assert np.isnan(leaf[:5]).all()
    others, wanted = (
        jax.tree.map(lambda x: x[5:count], tree.physics) for tree in (got, after)
    )
    assert_same(others, wanted)
    for leaf in jax.tree.leaves(step(got, jnp.zeros((count, 6), jnp.float32)).physics):
        assert np.isnan(leaf[:5]).all() and np.isfinite(leaf[5:]).all()
    again = step(state, first(count, actions))
    assert_same(again.physics, first(count, after.physics))


def test_a_reset_is_seen_however_long_a_step_is(model, states):
    """MuJoCo goes on from a state that it has reset, here for two seconds."""
    step = jax.jit(jax.vmap(native.native_physics(model, num_substeps=200)))
    qpos, qvel, warmstart, _ = first(2, states).physics
    fast = Physics(qpos, qvel.at[0, 2].set(1e9), warmstart)
    got = step(*fast, jnp.zeros((2, 6), jnp.float32))[0]
    assert np.isnan(got[0]).all() and np.isfinite(got[1]).all()


def test_actions_are_clipped_even_when_infinite(env, states):
    state = first(3, states)
    wild = jnp.array([jnp.inf, -jnp.inf, 3.0, -1e30, 1.0, 0.5], jnp.float32)
    tame = jnp.array([1.0, -1.0, 1.0, -1.0, 1.0, 0.5], jnp.float32)
    step = jax.jit(jax.vmap(env.step, (0, None)))
    assert_same(step(state, wild), step(state, tame))


# -- transforms ----------------------------------------------------------------------


def test_any_nest_of_vmaps_is_the_loop(env, states, actions):
    state, action = first(3, states), first(4, actions)
    over_actions = jax.vmap(env.step, (None, 0))
    got = jax.jit(jax.vmap(over_actions, (0, None), 1))(state, action)
    assert got.obs.shape == (4, 3, 18)
    for i in range(3):
        one = jax.tree.map(lambda x, i=i: x[i], state)
        for j in range(4):
            want = env.step(one, action[j])
            mapped = jax.tree.map(lambda x, i=i, j=j: x[j, i], got)
            assert_same(mapped.physics, want.physics)
            np.testing.assert_allclose(mapped.obs, want.obs, **ROUNDING)


def test_any_nest_of_vmaps_is_one_call(states, actions, monkeypatch):
    calls, host_call = [], native.host_call

    def counted(function, size):
        def count(inputs):
            calls.append(inputs.shape)
            return function(inputs)

        return host_call(count, size)

    by_numpy(monkeypatch)
    monkeypatch.setattr(native, "host_call", counted)
    env = hc.half_cheetah_native()
    over_actions = jax.vmap(env.step, (None, 0))
    every = jax.jit(jax.vmap(over_actions, (0, None), 1))
    state, action = first(3, states), first(4, actions)
    jax.block_until_ready(every(state, action))
    assert calls == [(3, 4, 33)]
    for i in range(3):
        for j in range(4):
            one = jax.tree.map(lambda x, i=i: x[i], state)
            jax.block_until_ready(env.step(one, action[j]))
    assert calls[1:] == [(33,)] * 12


def test_jitted_scan_equals_the_loop(env, states, actions):
    state = first(2, states)
    plans = actions[:60].reshape(30, 2, 6)
    step = jax.vmap(env.step)

    def tick(state, action):
        state = step(state, action)
        return state, state.obs

    end, path = jax.jit(lambda s, a: jax.lax.scan(tick, s, a))(state, plans)
    for t in range(30):
        state = step(state, plans[t])
        np.testing.assert_allclose(path[t], state.obs, **ROUNDING)
    assert_same(end.physics, state.physics)


def test_plans_with_and_in_the_simulator(env, states, key):
    """`unroll` with a planner that imagines with the environment it acts in."""
    search = jaxpets.optimizers.cem(
        horizon=2,
        action_low=env.action_low,
        action_high=env.action_high,
        num_samples=8,
        num_elites=2,
        num_iterations=2,
    )
    planner = jaxpets.plan(env_rollout(env), hc.task_reward, search)
    params = jaxpets.PlanParams((), hc.task("forward"))

    def act(key):
        start_key, key = jax.random.split(key)
        begin = jaxpets.start_trial(env, planner, start_key)
        run = jaxpets.unroll(
            env, planner, params, key, begin, length=4, observe_fn=lambda s: s
        )
        return begin.env, *run

    begin, end, seen, plans = jax.jit(jax.vmap(act))(jax.random.split(key, 3))
    assert seen.next_obs.shape == (3, 4, 18) and np.isfinite(plans.value).all()
    state = begin
    for t in range(4):
        np.testing.assert_allclose(seen.obs[:, t], state.obs, **ROUNDING)
        state = jax.vmap(env.step)(state, plans.action[:, t])
    assert_same(end.env.physics, state.physics)


def test_gradients_are_refused(env, states, request):
    one = jax.tree.map(lambda x: x[0], states)
    way = request.node.callspec.params["env"]
    words = {"c": "cannot be differentiated", "numpy": "do not support JVP"}
    with pytest.raises(ValueError, match=words[way]):
        jax.grad(lambda a: env.step(one, a).obs.sum())(jnp.zeros(6, jnp.float32))


# -- threads -------------------------------------------------------------------------


@pytest.mark.parametrize("num_threads", [1, 2, 3, 16])
def test_threads_change_nothing(num_threads, states, actions, after):
    env = hc.half_cheetah_native(num_threads=num_threads)
    counts = 1, 7, 37, STATES

    def steps(*args):
        return [jax.vmap(env.step)(*first(count, args)) for count in counts]

    for count, got in zip(counts, jax.jit(steps)(states, actions), strict=True):
        assert_same(got.physics, first(count, after.physics))


def test_callers_in_threads_take_turns(env, states, actions, after):
    step = jax.jit(jax.vmap(env.step))
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: step(states, actions), range(12)))
    for got in found:
        assert_same(got, after)


def test_an_error_of_mujoco_is_told_and_the_next_call_is_right(
    env, states, actions, after
):
    step = jax.jit(jax.vmap(env.step))
    mujoco.set_mjcb_control(lambda model, data: None)  # its threads take none of Python
    try:
        with pytest.raises(jax.errors.JaxRuntimeError, match="mjcb_control"):
            jax.block_until_ready(step(states, actions))
    finally:
        mujoco.set_mjcb_control(None)
    assert_same(step(states, actions).physics, after.physics)


def test_calls_of_any_size_follow_each_other(env, states, actions, after):
    step = jax.jit(jax.vmap(env.step))
    for count in (3, 1, 8, 2, 8):
        got = step(*first(count, (states, actions)))
        assert_same(got.physics, first(count, after.physics))


def test_all_cores_are_the_default(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 5, 6}, raising=False)
    assert native._num_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert native._num_cores() == (os.cpu_count() or 1)


DEVICES = """
import gc, os
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxpets.envs import half_cheetah, native

if {by_numpy}:
    native.c_function = lambda *_, **__: None

def roll(state, actions):
    step = lambda state, action: (jax.vmap(env.step)(state, action), None)
    return jax.lax.scan(step, state, actions)[0]

def threads():
    return len(os.listdir("/proc/self/task"))

env = half_cheetah.half_cheetah_native(num_threads=3)
keys = jax.random.split(jax.random.key(0), 32)
state = jax.jit(jax.vmap(env.reset))(keys)
actions = jax.random.uniform(jax.random.key(1), (20, 32, 6), jnp.float32, -1, 1)
want = jax.jit(roll)(state, actions)
mesh = jax.sharding.Mesh(np.array(jax.devices()), ("x",))
specs = PartitionSpec("x"), PartitionSpec(None, "x")
whole = jax.jit(roll)(*jax.device_put((state, actions), (
    NamedSharding(mesh, specs[0]), NamedSharding(mesh, specs[1]))))
parts = jax.jit(jax.shard_map(roll, mesh=mesh, in_specs=specs, out_specs=specs[0]))(
    state, actions)
for got in (whole, parts):
    jax.tree.map(np.testing.assert_array_equal, got.physics, want.physics)
    assert len(got.obs.sharding.device_set) == 2
before = threads()
del env
jax.clear_caches()
gc.collect()
assert threads() == before - 2
env = half_cheetah.half_cheetah_native(num_threads=3)
jax.vmap(env.step)(state, actions[0])  # the program ends with its threads alive
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/proc knows of threads")
@pytest.mark.parametrize("way", ["c", "numpy"])
def test_devices_share_the_host_and_threads_go_with_the_environment(tmp_path, way):
    """In a process of its own, with two devices: sharded, freed, and gone at exit."""
    package = Path(jaxpets.__file__).parents[1]
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    result = subprocess.run(
        [sys.executable, "-c", DEVICES.replace("{by_numpy}", str(way == "numpy"))],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
        env={
            **os.environ,
            "JAX_PLATFORMS": "cpu",
            "PYTHONPATH": str(package),
            "XLA_FLAGS": flags,
        },
    )
    assert result.returncode == 0, result.stderr


# -- bad arguments -------------------------------------------------------------------


def test_bad_arguments(env, model):
    with pytest.raises(ValueError, match="num_threads must be at least 1, got 0"):
        hc.half_cheetah_native(num_threads=0)
    for value in (2.0, True, "2"):
        with pytest.raises(TypeError, match="num_threads must be a Python int, got"):
            hc.half_cheetah_native(num_threads=value)
    with pytest.raises(ValueError, match="num_substeps must be at least 1, got 0"):
        native.native_physics(model, num_substeps=0)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    for shape, dtype in (((5,), jnp.float32), ((6,), jnp.int32)):
        action = jax.ShapeDtypeStruct(shape, dtype)
        with pytest.raises(ValueError, match=r"action must be float32\[6\], got"):
            jax.eval_shape(env.step, state, action)


def test_a_model_with_more_state_is_refused():
    late = mujoco.MjModel.from_xml_string(
        """<mujoco>
          <worldbody><body><joint name="hinge"/><geom size="1"/></body></worldbody>
          <actuator>
            <general joint="hinge" delay="0.01" nsample="5"/>
          </actuator>
        </mujoco>"""
    )
    with pytest.raises(ValueError, match="no state but positions, velocities and act"):
        native.native_physics(late, num_substeps=1)
    asleep = mujoco.MjModel.from_xml_string(
        '<mujoco><option><flag sleep="enable"/></option></mujoco>'
    )
    with pytest.raises(ValueError, match="model must run in batches: sleep and IPC"):
        native.native_physics(asleep, num_substeps=1)


@pytest.mark.parametrize(("engine", "calls"), [("mjx", 0), ("mujoco", 1)])
def test_experiments_choose_the_engine(engine, calls, monkeypatch):
    by_numpy(monkeypatch)
    config = dataclasses.replace(PRESETS["smoke"], phase="explore", engine=engine)
    env = build(config).robot.env
    state = jax.eval_shape(env.reset, jax.random.key(0))
    program = jax.make_jaxpr(env.step)(state, jnp.zeros(6, jnp.float32))
    assert str(program).count("= buffer_callback[") == calls


@pytest.mark.gpu
def test_a_gpu_gets_what_a_cpu_gets(env, states, actions, after):
    with jax.default_device(jax.devices("gpu")[0]):
        got = jax.jit(jax.vmap(env.step))(states, actions)
        assert_same(got.physics, after.physics)
