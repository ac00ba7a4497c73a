"""Any robot: the environment that an MJCF means, on both engines."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import robots
import toys

import jaxpets
from jaxpets import coordinates
from jaxpets.coordinates import Coordinate
from jaxpets.envs import half_cheetah as hc
from jaxpets.envs.mujoco_env import load_model, mujoco_env
from jaxpets.envs.observations import DEFAULT

EVERYTHING = (
    "mean_qvel/root.x", "qpos", "qvel", "sensordata", "site_xpos/foot.z", "xmat/leg.zz",
    "subtree_linvel/torso.x", "xpos/arm",
)  # fmt: skip
KEYS = (
    '<keyframe><key name="left" qpos="-3 0"/><key name="right" qpos="3 3.1" '
    'qvel="1 0"/></keyframe></mujoco>'
)
CART = robots.CART_XML.replace("</mujoco>", KEYS)
# The same cart, pushed by a motor that takes 0.1 s to do as it is told.
SLOW_CART = CART.replace(
    '<motor name="push"',
    '<general name="push" dyntype="filter" dynprm="0.1" gainprm="1"',
)


@pytest.fixture(scope="module")
def free():
    return mujoco_env(robots.FREE_XML, observe=EVERYTHING, control_step=0.02)


def rolled(env, key, num_steps=30):
    """Transitions of random actions, and the state behind the last."""

    def step(state, key):
        action = jax.random.uniform(key, env.action_low.shape, jnp.float32, -1.0, 1.0)
        after = env.step(state, action)
        return after, jaxpets.Transition(state.obs, action, after.obs)

    def trial(key):
        return jax.lax.scan(step, env.reset(key), jax.random.split(key, num_steps))

    return jax.jit(trial)(key)


def test_the_cheetah_comes_out_of_its_model(key):
    """Nothing said but the model: the environment of PETS, to the bit."""
    got, want = mujoco_env(hc.load_model()), hc.half_cheetah_native()
    assert got.coordinates == hc.model_space().coordinates
    for a, b in zip(rolled(got, key), rolled(want, key), strict=True):
        jax.tree.map(np.testing.assert_array_equal, a, b)
    np.testing.assert_array_equal(got.action_low, want.action_low)


def test_readings_are_those_of_mujoco_in_the_state_that_was_reached(free, key):
    model = mujoco.MjModel.from_xml_string(robots.FREE_XML)
    data = mujoco.MjData(model)
    state, action = jax.jit(free.reset)(key), jnp.full((1,), 0.7)
    step = jax.jit(free.step)
    for _ in range(40):  # until it stands on its foot
        before, state = state, step(state, action)
    data.qpos[:], data.qvel[:] = state.physics.qpos, state.physics.qvel
    data.qacc_warmstart[:] = state.physics.qacc_warmstart
    data.ctrl[:] = action
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    found = dict(zip([c.name for c in free.coordinates], state.obs, strict=True))
    moved = (state.physics.qpos[0] - before.physics.qpos[0]) / 0.02
    want = {
        "mean_qvel/root.x": moved,
        "qpos/hip": data.joint("hip").qpos[0],
        "qvel/root.wz": data.joint("root").qvel[5],
        "sensordata/drift.y": data.sensor("drift").data[1],
        "site_xpos/foot.z": data.site("foot").xpos[2],
        "xmat/leg.zz": data.body("leg").xmat[8],
        "subtree_linvel/torso.x": data.subtree_linvel[model.body("torso").id][0],
        "xpos/arm.y": data.body("arm").xpos[1],
        "sensordata/sole": data.sensor("sole").data[0],
    }
    for name, value in want.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-5, atol=1e-6)


def test_a_model_can_be_learned_in_its_coordinates(free, key):
    _, data = rolled(free, key)
    space = coordinates.space(free.coordinates)
    jaxpets.check_space(space, data.obs, data.next_obs)
    assert data.obs.shape == (30, len(free.coordinates))


def test_one_step_on_mjx_is_that_of_c(key):
    observe = (*DEFAULT, "site_xpos/tip", "subtree_linvel/cart.x")
    native, mjx = (
        mujoco_env(SLOW_CART, observe=observe, control_step=0.01, backend=backend)
        for backend in ("mujoco", "mjx")
    )
    start, action = jax.jit(native.reset)(key), jnp.full((1,), 0.5)
    got, want = (jax.jit(env.step)(start, action) for env in (mjx, native))
    # Five substeps in float32, without contacts.
    np.testing.assert_allclose(got.obs, want.obs, rtol=1e-4, atol=1e-5)
    assert native.coordinates == mjx.coordinates and want.obs.shape == (9,)
    np.testing.assert_allclose(got.physics.act, want.physics.act, rtol=1e-6)


def test_mjx_steps_in_float32_where_a_caller_computes_in_float64(key):
    def trial():
        observe = (*DEFAULT, "site_xpos/tip")
        env = mujoco_env(SLOW_CART, observe=observe, control_step=0.004, backend="mjx")
        return rolled(env, key, 3)

    with jax.enable_x64(True):
        got = trial()
    # The same program but for its counters, compiled twice.
    toys.assert_trees_close(got, trial(), rtol=1e-5, atol=1e-6)
    assert {x.dtype for x in jax.tree.leaves(got)} == {np.dtype(np.float32)}


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_an_action_stays_in_its_range_whatever_a_flag_says(backend, key):
    flag = '<mujoco><option><flag clampctrl="disable"/></option>'
    env = mujoco_env(
        CART.replace("<mujoco>", flag), control_step=0.002, backend=backend
    )
    start, step = env.reset(key), jax.jit(env.step)
    far, most = (step(start, jnp.full((1,), x)).obs for x in (3.0, 1.0))
    np.testing.assert_array_equal(far, most)


def test_activations_are_state_and_are_observed(key):
    env = mujoco_env(SLOW_CART, control_step=0.02, observe=("act/push", "qpos"))
    model = mujoco.MjModel.from_xml_string(SLOW_CART)
    data = mujoco.MjData(model)
    before, action = env.reset(key), jnp.ones(1)
    assert before.physics.act.shape == (1,) and before.obs[0] == 0.0
    data.qpos[:], data.qvel[:] = before.physics.qpos, before.physics.qvel
    data.ctrl[:] = 1.0
    state = before
    for step in range(1, 4):
        mujoco.mj_step(model, data, 10)
        state = env.step(state, action)
        # The state goes through float32 at every step.
        np.testing.assert_allclose(state.obs[0], data.act[0], rtol=1e-6)
        np.testing.assert_allclose(state.physics.qvel, data.qvel, rtol=1e-5)
        np.testing.assert_allclose(state.obs[0], 1 - np.exp(-0.2 * step), rtol=0.02)
    row = env.coordinates[0]
    assert row == Coordinate("act/push", "relative", True, True)
    assert hc.half_cheetah_native().reset(key).physics.act == ()


@pytest.mark.skipif(
    mujoco.mj_version() < 4_000_000, reason="an actuator has one control before 4.0"
)
def test_an_actuator_may_have_several_controls_or_none(key):
    """A servo of place and speed, a passive motor, and one with an activation."""
    servo = '<pid name="servo" joint="hinge" kp="1" kv="1" input="pos vel" {}/>'
    passive = '<dcmotor joint="hinge" motorconst="1" resistance="1" input="none"/>'
    added = f"<actuator>{servo}{passive}{passive}"
    limited = added.format('ctrlrange="-3 3" velrange="-2 2"')
    env = mujoco_env(SLOW_CART.replace("<actuator>", limited))
    assert [row.name for row in env.coordinates][-1] == "act/push"
    np.testing.assert_array_equal(env.action_low, [-3, -2, -1])
    start = env.reset(key)
    still, pushed = (env.step(start, jnp.array([0.0, 0.0, x])).obs for x in (0.0, 1.0))
    assert still[-1] == 0.0 and pushed[-1] > 0.3
    half = added.format('ctrlrange="-3 3"')
    with pytest.raises(ValueError, match="but control 1 of servo has none"):
        mujoco_env(SLOW_CART.replace("<actuator>", half))


def test_a_trial_settles_and_has_constants(key):
    def drawn(key):
        return {"target": jax.random.uniform(key, (2,), jnp.float32)}

    def tilted(key):
        del key
        return jnp.array([0.0, 0.5]), jnp.zeros(2)

    options = {"control_step": 0.02, "reset": tilted}
    env = mujoco_env(CART, **options, settle_time=0.06, constants=drawn)
    plain = mujoco_env(CART, **options)
    state, want = env.reset(key), plain.reset(key)
    other = env.reset(jax.random.key(7)).constants["target"].tolist()
    assert want.constants == () and other != state.constants["target"].tolist()
    for _ in range(3):
        want = plain.step(want, jnp.zeros(1))
    jax.tree.map(np.testing.assert_array_equal, state.physics, want.physics)
    after = env.step(state, jnp.ones(1))
    assert after.constants["target"].tolist() == state.constants["target"].tolist()


def test_an_action_is_held_for_its_repeats(key):
    once = mujoco_env(CART, control_step=0.02, observe=["mean_qvel/slider", "qpos"])
    thrice = mujoco_env(
        CART, control_step=0.02, action_repeat=3, observe=["mean_qvel/slider", "qpos"]
    )
    action = jnp.ones(1)
    state = first = once.reset(key)
    for _ in range(3):
        state = once.step(state, action)
    held = thrice.step(first, action)
    # Steps of the environment round to float32 in between.
    np.testing.assert_allclose(held.obs[1:], state.obs[1:], rtol=1e-5)
    moved = (held.physics.qpos[0] - first.physics.qpos[0]) / 0.06
    np.testing.assert_allclose(held.obs[0], moved, rtol=1e-5)


def test_trials_start_where_they_are_told(key):
    keys = jax.random.split(key, 40)
    env = mujoco_env(CART, reset=("left", "right"))
    both = jax.jit(jax.vmap(env.reset))(keys).physics
    sides = np.sign(both.qpos[:, 0])
    assert 5 < (sides > 0).sum() < 35
    np.testing.assert_allclose(both.qpos[:, 0], 3 * sides, atol=0.01)
    np.testing.assert_allclose(both.qvel[:, 0], sides > 0, atol=0.01)
    one = mujoco_env(CART, reset=["left"]).reset(key)
    np.testing.assert_allclose(one.physics.qpos, [-3, 0], atol=0.01)

    def own(key):
        del key
        qpos = jnp.full((12,), 2.0)
        return qpos, jnp.arange(10, dtype=jnp.float32)

    state = mujoco_env(robots.FREE_XML, reset=own).reset(key)
    want = [2.0] * 3 + [0.5] * 4 + [2.0] + [0.5] * 4
    np.testing.assert_allclose(state.physics.qpos, want)
    np.testing.assert_array_equal(state.physics.qvel, np.arange(10))


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_a_keyframe_says_what_the_actuators_hold(backend, key):
    xml = SLOW_CART.replace('name="left"', 'name="left" act="0.7"')
    env = mujoco_env(xml, reset=("left",), observe=("act", "qpos"), backend=backend)
    state = env.reset(key)
    np.testing.assert_allclose(state.physics.act, [0.7])
    np.testing.assert_allclose(state.obs[0], 0.7)
    right = mujoco_env(xml, reset=("right",), backend=backend).reset(key)
    np.testing.assert_array_equal(right.physics.act, [0.0])


def test_a_keyframe_may_say_where_a_mocap_body_is_in_rounded_numbers():
    mark = '<worldbody><body mocap="true" pos="0.1234567 0 0" quat="1 1 0 0"/>'
    said = 'name="left" mpos="0.12346 0 0" mquat="0.7071 0.7071 0 0"'
    xml = CART.replace("<worldbody>", mark).replace('name="left"', said)
    assert mujoco_env(xml, reset=("left",)).action_low.shape == (1,)


def test_a_start_may_be_of_numpy(key):
    def own(key):
        del key
        return np.full(12, 2.0, np.float32), np.zeros(10, np.float32)

    physics = mujoco_env(robots.FREE_XML, reset=own).reset(key).physics
    np.testing.assert_allclose(physics.qpos[3:7], [0.5] * 4)


def test_a_start_of_zeros_turns_nothing(key):
    def own(key):
        del key
        return jnp.zeros(12), jnp.zeros(10)

    physics = mujoco_env(robots.FREE_XML, reset=own).reset(key).physics
    want = [0.0] * 3 + [1.0, 0.0, 0.0, 0.0] + [0.0] + [1.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(physics.qpos, want)


def test_a_model_is_a_path_a_text_or_itself(tmp_path, key):
    path = tmp_path / "cart.xml"
    path.write_text(CART)
    model = mujoco.MjModel.from_xml_string(CART)
    want = mujoco_env(CART).reset(key)
    for given in (path, str(path), model):
        jax.tree.map(np.testing.assert_array_equal, mujoco_env(given).reset(key), want)
    assert load_model(model) is model
    marked = tmp_path / "marked.xml"
    marked.write_text(CART, encoding="utf-8-sig")
    assert load_model(marked.read_text(encoding="utf-8")).nq == model.nq


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_what_a_model_becomes_later_is_another_robot(backend, key):
    model = load_model(CART)
    env = mujoco_env(model, control_step=0.002, backend=backend)
    start = env.reset(key)
    model.body_mass[1:] *= 100.0
    heavy = mujoco_env(model, control_step=0.002, backend=backend)
    speed, slower = (
        abs(x.step(start, jnp.ones(1)).physics.qvel[0] - start.physics.qvel[0])
        for x in (env, heavy)
    )
    assert speed > 10 * slower


NO_RANGE = CART.replace(' ctrlrange="-1 1"', "")
BAD = {
    "model must be a path, MJCF or an MjModel, got int": (3, {}),
    "model must be a file or MJCF, but none.xml is none": ("none.xml", {}),
    "model must be a file or MJCF, but a{5000} is none": ("a" * 5000, {}),
    "model must compile, but this text does not: XML": ("<mujoco><x/>", {}),
    "every actuator must have a ctrlrange, but push has none": (NO_RANGE, {}),
    "every actuator must have a ctrlrange, but actuator0 has none": (
        NO_RANGE.replace('name="push"', ""), {},
    ),
    "every ctrlrange must go from a finite .* but that of push is -inf to inf": (
        CART.replace('"-1 1"', '"-inf inf"'), {},
    ),
    "every ctrlrange must go from a finite .* but that of actuator0 is 0 to inf": (
        CART.replace('name="push"', "").replace('"-1 1"', '"0 1e39"'), {},
    ),
    "model must have an actuator, got none": (
        robots.mjcf('<body><joint/><geom size="1"/></body>'), {},
    ),
    "control_step must be a multiple of the model's 0.002 s, as 0.004, got 0.003": (
        CART, {"control_step": 0.003},
    ),
    "control_step must be finite and more than 0, got -0.05": (
        CART, {"control_step": -0.05},
    ),
    "control_step must be finite and more than 0, got 0.0": (
        CART, {"control_step": 0.0},
    ),
    "control_step must be finite and more than 0, got nan": (
        CART, {"control_step": float("nan")},
    ),
    "settle_time must be a multiple of the 0.02 s of a step, got 0.03": (
        CART, {"control_step": 0.02, "settle_time": 0.03},
    ),
    "settle_time must be finite and at least 0, got -0.02": (
        CART, {"control_step": 0.02, "settle_time": -0.02},
    ),
    "settle_time must be finite and at least 0, got nan": (
        CART, {"settle_time": float("nan")},
    ),
    "settle_time must be a Python float, got '1'": (CART, {"settle_time": "1"}),
    "terminal_fn must be a function, got 5": (CART, {"terminal_fn": 5}),
    "constants must be a function, got 5": (CART, {"constants": 5}),
    "num_threads must be at least 1, got -3": (
        CART, {"backend": "mjx", "num_threads": -3},
    ),
    "reset must be keyframes among ..left., .right.., got 5": (CART, {"reset": 5}),
    "action_repeat must be at least 1": (CART, {"action_repeat": 0}),
    "reset must be keyframes among ..left., .right.., got .'up',.": (
        CART, {"reset": ("up",)},
    ),
    "reset must be keyframes .* got 'left'": (CART, {"reset": "left"}),
    "reset must be None or a function, as the model has no keyframes, got .'up',.": (
        robots.FREE_XML, {"reset": ("up",)},
    ),
    "reset must be keyframes that leave mocap bodies .* got 'left'": (
        CART.replace("<worldbody>", '<worldbody><body mocap="true"/>').replace(
            'name="left"', 'name="left" mpos="1 2 3"'
        ),
        {"reset": ("right", "left")},
    ),
    'backend must be "mujoco" or "mjx", got \'warp\'': (CART, {"backend": "warp"}),
    "names of coordinates must differ": (CART, {"observe": ["qpos", "qpos"]}),
    "model must have no state but positions, velocities and activations": (
        CART.replace("<motor", '<motor delay="0.01" nsample="5"'), {"backend": "mjx"},
    ),
    "MJX lacks what this model uses": (
        CART.replace("<worldbody>", '<option solver="PGS"/><worldbody>'),
        {"backend": "mjx"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_be_is_said(message):
    model, options = BAD[message]
    with pytest.raises((TypeError, ValueError, FileNotFoundError), match=message):
        mujoco_env(model, **options)


def test_a_start_of_the_wrong_size_is_refused(key):
    env = mujoco_env(CART, reset=lambda key: (jnp.zeros(3), jnp.zeros(2)))
    with pytest.raises(ValueError, match=r"the qpos of reset must be float32\[2\]"):
        env.reset(key)
    for drawn, said in ((jnp.zeros(2), "ArrayImpl"), ((1, 2, 3), "3 of them")):
        env = mujoco_env(CART, reset=lambda key, drawn=drawn: drawn)
        with pytest.raises(TypeError, match=f"return .qpos, qvel., got {said}"):
            env.reset(key)
    with pytest.raises(ValueError, match=r"action must be float32\[1\]"):
        env.step(mujoco_env(CART).reset(key), jnp.zeros(2))
