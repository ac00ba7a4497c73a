import functools

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_mujoco import c_step, visited_states

import jaxpets
from jaxpets.envs import half_cheetah as hc
from jaxpets.envs.engines import Physics

STATES = 200
JOINTS = ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]


@pytest.fixture(scope="module")
def gym_model():
    """The model of gymnasium's own environment."""
    env = gymnasium.make("HalfCheetah-v5")
    yield env.unwrapped.model
    env.close()


@pytest.fixture(scope="module")
def env():
    return hc.half_cheetah()


@pytest.fixture(scope="module")
def step(env):
    """The one compiled step of this file: any number of states up to STATES."""
    compiled = jax.jit(jax.vmap(env.step))

    def run(states, actions):
        count = len(states.obs)
        pad = STATES - count
        padded = jax.tree.map(
            lambda x: np.pad(x, [(0, pad)] + [(0, 0)] * (x.ndim - 1)),
            (states, np.float32(actions)),
        )
        return jax.tree.map(lambda x: np.asarray(x[:count]), compiled(*padded))

    return run


def env_states(qpos, qvel, warmstart=None):
    """EnvStates of given positions and velocities, `[n, 9]`."""
    qpos, qvel = np.float32(qpos), np.float32(qvel)
    warmstart = np.zeros_like(qpos) if warmstart is None else np.float32(warmstart)
    velocity = np.zeros_like(qpos[:, :1])
    obs = np.concatenate([velocity, qpos[:, 1:], qvel], axis=-1)
    return jaxpets.EnvState(obs, Physics(qpos, qvel, warmstart))


# -- parity --------------------------------------------------------------------------


def errors_against_c(model, run):
    """Largest |dqpos| and |dqvel| of each state after one environment step."""
    qpos, qvel, warmstart = visited_states(model, STATES)
    actions = np.random.default_rng(1).uniform(-1, 1, (STATES, 6)).astype(np.float32)
    # The cases are those meant: on the back or the side, and touching the floor.
    want, contacts = c_step(model, qpos, qvel, warmstart, actions)
    turned = np.cos(qpos[STATES // 2 :, 2]) < 0.5
    print(f"turned {turned.mean():.2f}, in contact {(contacts > 0).mean():.2f}")
    print(f"contacts at most {contacts.max()}")
    assert turned.mean() > 0.3
    assert (contacts[STATES // 2 :] > 0).mean() > 0.7 and contacts.max() >= 4
    middle = STATES // 2
    got = run(env_states(qpos, qvel, warmstart), actions)
    dqpos = np.abs(got.physics.qpos - want[0]).max(-1)
    dqvel = np.abs(got.physics.qvel - want[1]).max(-1)
    for name, error in (("qpos", dqpos), ("qvel", dqvel)):
        for half, part in (("upright", error[:middle]), ("tumbled", error[middle:])):
            print(
                f"|d{name}| {half}: median {np.median(part):.2g}, "
                f"99 % {np.quantile(part, 0.99):.2g}, worst {part.max():.2g}"
            )
    return dqpos, dqvel


def test_one_step_equals_c_mujoco(gym_model, step):
    """float32 MJX against double precision, each state from the same warm start."""
    dqpos, dqvel = errors_against_c(gym_model, step)
    # One float32 rounding of an angle in radians is 1e-7; a wrong contact is 1e-1.
    assert np.median(dqpos) < 1e-6
    assert dqvel.max() < 1e-2


@pytest.mark.gpu
def test_one_step_equals_c_mujoco_on_the_gpu(gym_model, env):
    """Where matrix products would be TF32, had the environment not forbidden it."""
    device = jax.devices("gpu")[0]
    compiled = jax.jit(jax.vmap(env.step))

    def run(states, actions):
        with jax.default_device(device):
            return jax.tree.map(np.asarray, compiled(states, actions))

    dqpos, dqvel = errors_against_c(gym_model, run)
    assert np.median(dqpos) < 1e-6
    assert dqvel.max() < 1e-2


def test_ten_steps_stay_beside_c_mujoco(gym_model, step):
    qpos, qvel, warmstart = visited_states(gym_model, 80, seed=3)
    pick = slice(0, 40)  # upright
    state = env_states(qpos[pick], qvel[pick], warmstart[pick])
    data = mujoco.MjData(gym_model)
    rng = np.random.default_rng(4)
    actions = rng.uniform(-1, 1, (10, 40, 6)).astype(np.float32)
    want = np.zeros((40, 9))
    for i in range(40):
        mujoco.mj_resetData(gym_model, data)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        data.qacc_warmstart[:] = warmstart[i]
        for action in actions[:, i]:
            data.ctrl[:] = action
            mujoco.mj_step(gym_model, data, 5)
        want[i] = data.qpos
    for action in actions:
        state = step(state, action)
    error = np.abs(state.physics.qpos - want).max(-1)
    # The motion is chaotic: a rounding grows about tenfold in five steps.
    assert np.median(error) < 1e-4 and error.max() < 2e-2


def test_constants_equal_gymnasiums(gym_model):
    model = hc.load_model()
    assert (model.nq, model.nv, model.nu, model.ngeom) == (9, 9, 6, gym_model.ngeom)
    fields = [
        "body_mass",
        "body_inertia",
        "body_ipos",
        "body_pos",
        "geom_size",
        "geom_pos",
        "geom_quat",
        "geom_friction",
        "geom_contype",
        "geom_conaffinity",
        "geom_solref",
        "geom_solimp",
        "jnt_axis",
        "jnt_range",
        "jnt_stiffness",
        "jnt_pos",
        "dof_damping",
        "dof_armature",
        "dof_invweight0",
        "actuator_gear",
        "actuator_ctrlrange",
        "qpos0",
        "qpos_spring",
    ]
    for field in fields:
        want = getattr(gym_model, field)
        np.testing.assert_allclose(
            getattr(model, field), want, rtol=1e-9, atol=1e-12, err_msg=field
        )
    np.testing.assert_allclose(model.body_mass.sum(), 14.0, rtol=1e-9)
    for field in ("timestep", "integrator", "cone", "solver"):
        assert getattr(model.opt, field) == getattr(gym_model.opt, field)
    np.testing.assert_array_equal(model.opt.gravity, gym_model.opt.gravity)
    assert model.opt.timestep * 5 == pytest.approx(hc.TIMESTEP)


def test_solver_settings_reach_the_model():
    for name in ("iterations", "ls_iterations"):
        with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
            hc.half_cheetah(**{name: 0})
        with pytest.raises(TypeError, match=f"{name} must be a Python int"):
            hc.half_cheetah(**{name: 8.0})


# -- observation ---------------------------------------------------------------------


def test_index_names_are_mujocos(gym_model):
    joints = [gym_model.joint(i).name for i in range(gym_model.njnt)]
    assert joints == ["rootx", "rootz", "rooty", *JOINTS]
    # obs = [velocity, qpos[1:], qvel], so joint j stands at j and 9 + j.
    names = ["velocity", *joints[1:], *joints]
    assert len(names) == hc.OBS_SIZE == 18
    assert names[hc.FORWARD_VELOCITY] == "velocity"
    assert names[hc.HEIGHT] == "rootz" and hc.HEIGHT < 9
    assert names[hc.PITCH] == "rooty" and hc.PITCH < 9
    assert names[hc.JOINT_ANGLES] == JOINTS and hc.JOINT_ANGLES.stop <= 9
    assert names[hc.X_VELOCITY] == "rootx"
    assert names[hc.Z_VELOCITY] == "rootz" and hc.Z_VELOCITY >= 9
    assert names[hc.PITCH_RATE] == "rooty" and hc.PITCH_RATE >= 9
    assert names[hc.JOINT_VELOCITIES] == JOINTS and hc.JOINT_VELOCITIES.start >= 9
    actuators = [gym_model.actuator(i).name for i in range(6)]
    assert actuators == JOINTS and hc.ACTION_SIZE == 6


def test_observation_is_velocity_positions_velocities(step):
    rng = np.random.default_rng(0)
    before = env_states(0.1 * rng.normal(size=(8, 9)), rng.normal(size=(8, 9)))
    after = step(before, rng.uniform(-1, 1, (8, 6)))
    moved = after.physics.qpos[:, 0] - before.physics.qpos[:, 0]
    # Differences of positions near 1 m have 1e-7 m of rounding, over 0.05 s.
    np.testing.assert_allclose(after.obs[:, 0], moved / 0.05, atol=1e-5)
    np.testing.assert_array_equal(after.obs[:, 1:9], after.physics.qpos[:, 1:])
    np.testing.assert_array_equal(after.obs[:, 9:], after.physics.qvel)
    assert after.obs.dtype == np.float32


def test_state_has_no_reward(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert state._fields == ("obs", "physics", "constants")
    assert state.physics._fields == ("qpos", "qvel", "qacc_warmstart", "act")
    assert state.constants == () and state.physics.act == ()
    np.testing.assert_array_equal(env.action_low, -np.ones(6))
    np.testing.assert_array_equal(env.action_high, np.ones(6))


def test_signs_of_velocity_and_pitch_rate(gym_model, step):
    """In free air: +x is forward, a positive pitch rate turns the nose down."""
    qpos, qvel = np.zeros((3, 9)), np.zeros((3, 9))
    qpos[:, 1] = 5.0
    qvel[0, 0], qvel[1, 0], qvel[2, 2] = 2.0, -2.0, 2.0
    after = step(env_states(qpos, qvel), np.zeros((3, 6)))
    np.testing.assert_allclose(after.obs[:2, hc.FORWARD_VELOCITY], [2, -2], atol=0.2)
    np.testing.assert_allclose(after.obs[:2, hc.X_VELOCITY], [2, -2], atol=0.2)
    assert after.obs[2, hc.PITCH_RATE] > 1 and after.obs[2, hc.PITCH] > 0.05

    def head_above_torso(qpos):
        data = mujoco.MjData(gym_model)
        data.qpos[:] = qpos
        mujoco.mj_forward(gym_model, data)
        return data.geom("head").xpos[2] - data.body("torso").xpos[2]

    drop = head_above_torso(after.physics.qpos[2]) - head_above_torso(qpos[2])
    assert drop < -0.02
    # The head is in front, so that nose down is a roll forward.
    data = mujoco.MjData(gym_model)
    mujoco.mj_forward(gym_model, data)
    assert data.geom("head").xpos[0] > data.body("torso").xpos[0]


def test_reset_statistics(env, gym_model):
    keys = jax.random.split(jax.random.key(0), 4000)
    states = jax.jit(jax.vmap(env.reset))(keys)
    physics = states.physics
    for value, centre in ((physics.qpos, gym_model.qpos0), (physics.qvel, 0.0)):
        offset = np.asarray(value) - centre
        # 4000 draws: the deviation is known to 1.1 %, the mean to 1.6 % of it.
        np.testing.assert_allclose(offset.std(0), 0.001, rtol=0.06)
        np.testing.assert_allclose(offset.mean(0), 0.0, atol=8e-5)
    both = np.concatenate([physics.qpos, physics.qvel], axis=1)
    off_diagonal = np.corrcoef(both.T) - np.eye(18)
    assert np.abs(off_diagonal).max() < 0.08
    assert not np.any(states.obs[:, hc.FORWARD_VELOCITY])
    # XLA may compute the two outputs apart, which rounds the last bit of them apart.
    same = functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-9)
    same(states.obs[:, 1:9], physics.qpos[:, 1:])
    same(states.obs[:, 9:], physics.qvel)
    assert not np.any(physics.qacc_warmstart)


def test_state_keeps_its_avals(env):
    """Strict promotion is on: the step traces under it, and gives what it took."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    action = jax.ShapeDtypeStruct((6,), jnp.float32)
    after = jax.eval_shape(env.step, state, action)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(state), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)


def test_wrong_actions_fail_when_traced(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    for shape, dtype in (((5,), jnp.float32), ((6,), jnp.int32)):
        action = jax.ShapeDtypeStruct(shape, dtype)
        with pytest.raises(ValueError, match=r"action must be float32\[6\], got"):
            jax.eval_shape(env.step, state, action)


def test_positions_follow_from_a_recorded_trial(step):
    state = env_states(np.zeros((1, 9)), np.zeros((1, 9)))
    rng = np.random.default_rng(0)
    obs, qpos = [state.obs[0]], [state.physics.qpos[0]]
    for _ in range(12):
        state = step(state, rng.uniform(-1, 1, (1, 6)))
        obs.append(state.obs[0])
        qpos.append(state.physics.qpos[0])
    got = jax.jit(hc.qpos_from_obs)(np.stack(obs))
    assert got.shape == (13, 9)
    np.testing.assert_allclose(got, np.stack(qpos), atol=1e-5)
