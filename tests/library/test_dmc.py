"""The DeepMind Control Suite, beside dm_control itself."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("dm_control", reason="needs the extra jaxpets[dmc]")

import judge
from dm_control.utils import rewards as judged

from jaxpets import envs
from jaxpets.envs.dmc import DOMAINS
from jaxpets.envs.tolerance import gaussian, linear, quadratic, tolerance
from jaxpets.envs.tracks import qpos_fn

make = functools.cache(lambda name: envs.make(f"dmc/{name}"))


@pytest.mark.parametrize("name", DOMAINS)
def test_steps_and_rewards_are_those_of_dm_control(name):
    found = judge.differences(make(name), 12, 3)
    # Physics is the same to the bit and passes through float32: an error of 6e-8.
    assert max(found.position, found.velocity, found.act) < 1e-7
    assert found.reward < 1e-6 and found.flipped == 0
    assert found.steps == 36
    if name not in ("reacher", "finger"):  # whose targets may be anywhere
        assert any(found.positive.values())


def starts(name, count=4):
    """States of trials, and the judge to look at them."""
    robot = make(name)
    keys = jax.random.split(jax.random.key(3), count)
    return (
        robot,
        jax.jit(jax.vmap(robot.env.reset))(keys),
        judge.Judge(name, robot.tasks.names[:1]),
    )


@pytest.mark.parametrize("name", ["ball_in_cup", "finger", "quadruped"])
def test_a_trial_starts_without_contact(name):
    _, states, judged_by = starts(name)
    assert len(np.unique(states.physics.qpos, axis=0)) == 4
    for i in range(4):
        physics = jax.tree.map(lambda x, i=i: np.array(x[i]), states.physics)
        judged_by.put(physics)
        assert judged_by.data.ncon == 0
        if name == "quadruped":
            physics.qpos[2] -= 0.01
            judged_by.put(physics)
            assert judged_by.data.ncon > 0


def test_the_cheetah_settles_as_dm_controls_does():
    robot, states, judged_by = starts("cheetah")
    keys = jax.random.split(jax.random.key(3), 4)
    draw, _ = DOMAINS["cheetah"].start(robot.model)(keys[0])
    data = judged_by.data
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = draw, 0, 0
    judged_by.physics.step(200)
    # 200 steps with contacts, of which every fourth goes through float32.
    np.testing.assert_allclose(states.physics.qpos[0], data.qpos, atol=1e-3)
    assert np.abs(states.physics.qvel).max() < 1.0
    assert np.ptp(draw[1:3]) == 0.0 and np.ptp(draw[3:]) > 0.1


def test_cartpole_balances_from_upright_and_swings_up_from_below():
    robot = make("cartpole")
    key = jax.random.key(1)
    states = jax.jit(jax.vmap(lambda task: robot.task_reset(task, key)))(
        robot.tasks.params
    )
    up = np.cos(states.physics.qpos[:, 1])
    assert robot.tasks.names[:2] == ("balance", "balance-sparse")
    assert (up[:2] > 0.999).all() and (up[2:] < -0.99).all()
    alone = robot.task_reset(envs.with_constants(jnp.int32(2), jnp.zeros(2)), key)
    np.testing.assert_array_equal(alone.obs, robot.env.reset(key).obs)


@pytest.mark.parametrize(("name", "near", "far"), [
    ("reacher", 0.05, 0.2), ("finger", 0.13, 0.13),
])  # fmt: skip
def test_a_target_is_drawn_for_a_trial_and_stays(name, near, far):
    robot, states, _ = starts(name, 40)
    distance = np.linalg.norm(states.constants, axis=-1)
    assert states.constants.shape == (40, 2) and np.ptp(states.constants[:, 0]) > 0.1
    assert (distance > near - 1e-6).all() and (distance < far + 1e-6).all()
    state = jax.tree.map(lambda x: x[0], states)
    after = robot.env.step(state, jnp.zeros(2))
    np.testing.assert_array_equal(after.constants, state.constants)


def test_a_robot_has_what_a_report_shows():
    robot = make("walker")
    assert [axis.unit for axis in robot.axes] == ["m/s", "rad/s"]
    rows = robot.env.coordinates
    assert rows[robot.angle].name == "qpos/rooty" and rows[robot.angle].kind == "angle"
    assert robot.space.coordinates == rows
    assert robot.camera in [robot.model.camera(i).name for i in range(robot.model.ncam)]
    edges = robot.axes[0].edges
    assert sorted(edges) == list(edges) and edges[0] == -8.0


def test_positions_are_drawn_from_what_was_observed():
    robot = make("walker")
    state, path, want = robot.env.reset(jax.random.key(0)), [], []
    start = state.physics.qpos
    for _ in range(5):
        state = robot.env.step(state, jnp.full(6, 0.5))
        path.append(state.obs)
        want.append(state.physics.qpos.at[1].add(-start[1]))
    # Where the walker stands is summed up from its velocity in float32.
    np.testing.assert_allclose(robot.qpos_fn(jnp.stack(path)), want, atol=1e-6)


def test_nothing_is_known_of_a_slide_that_is_not_observed():
    robot = make("walker")
    rows = tuple(r for r in robot.env.coordinates if r.name == "qpos/rooty")
    got = qpos_fn(robot.model, rows, 0.05)(jnp.ones((3, 1)))
    np.testing.assert_array_equal(got, np.tile(np.eye(9)[2], (3, 1)))


@pytest.mark.parametrize("shape", [gaussian, linear, quadratic])
def test_tolerance_is_that_of_dm_control(shape):
    x = np.linspace(-4.0, 4.0, 161)
    for low, high in ((-1.0, 2.0), (0.5, 0.5), (-math.inf, 1.0), (0.0, math.inf)):
        for margin in (0.0, 0.7):
            got = tolerance(
                jnp.asarray(x, jnp.float32), low, high,
                margin=margin, value=0.3, shape=shape,
            )  # fmt: skip
            want = judged.tolerance(x, (low, high), margin, shape.__name__, 0.3)
            np.testing.assert_allclose(got, want, atol=1e-6)


def test_all_of_the_tables_tasks_are_there():
    names = envs.names()
    assert {f"dmc/{name}" for name in DOMAINS} < set(names)
    num_judged = sum(
        task not in judge.OURS and task not in judge.MIRRORED
        for name in DOMAINS
        for task in make(name).tasks.names
    )
    assert num_judged == 21  # with the sparse swing-up of acrobot
    walker = make("walker").tasks.names
    assert walker[:3] == ("stand", "walk", "run") and "run-backwards" in walker
    with pytest.raises(ValueError, match="dmc/walker"):
        envs.make("dmc/walkers")
