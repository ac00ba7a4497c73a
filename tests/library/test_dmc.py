"""The DeepMind Control Suite, beside dm_control itself."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("dm_control", reason="needs the extra jaxpets[dmc]")

import dmc_judge
import parity
from dm_control.utils import rewards as judged

from jaxpets import envs
from jaxpets.envs.dmc import DOMAINS
from jaxpets.envs.engines import Physics
from jaxpets.envs.tolerance import gaussian, linear, quadratic, tolerance
from jaxpets.envs.tracks import qpos_fn

TRIALS, STEPS = 12, 4
make = functools.cache(lambda name: envs.make(f"dmc/{name}"))


@functools.cache
def compared(name):
    """The largest differences to dm_control, and the trials: half start as they do."""
    return dmc_judge.differences(make(name), TRIALS, STEPS)


def starts(name):
    """The states in which the first trials began."""
    trials = compared(name)[1]
    return parity.at(trials.before, (slice(0, TRIALS // 2), 0))


@pytest.mark.parametrize("name", DOMAINS)
def test_steps_and_rewards_are_those_of_dm_control(name):
    found, _ = compared(name)
    # Physics is the same to the bit and passes through float32: an error of 6e-8.
    assert max(found.qpos, found.qvel, found.act) < 1e-7
    assert found.reward < 1e-6 and found.flipped == 0
    if name not in ("reacher", "finger"):  # whose targets may be anywhere
        assert any(found.positive.values())


@pytest.mark.parametrize("name", ["ball_in_cup", "finger", "quadruped"])
def test_a_trial_starts_without_contact(name):
    physics = starts(name).physics
    judge = dmc_judge.Judge(name, make(name).tasks.names[:1])
    assert len(np.unique(physics.qpos, axis=0)) == TRIALS // 2
    for i in range(TRIALS // 2):
        judge.put(parity.at(physics, i))
        assert judge.data.ncon == 0
        if name == "quadruped":
            judge.data.qpos[2] -= 0.01
            judge.physics.forward()
            assert judge.data.ncon > 0


def test_the_cheetah_settles_as_dm_controls_does():
    physics, model = starts("cheetah").physics, make("cheetah").model
    key = parity.start_keys(TRIALS)[0]
    drawn, _ = DOMAINS["cheetah"].start(model)(key)
    assert np.ptp(drawn[:3]) == 0.0 and np.ptp(drawn[3:]) > 0.1
    judge = dmc_judge.Judge("cheetah", ["run"])
    still = np.zeros(9)
    judge.put(Physics(drawn, still, still))
    judge.physics.step(200)
    # 200 steps with contacts, of which every fourth goes through float32.
    np.testing.assert_allclose(physics.qpos[0], judge.data.qpos, atol=1e-3)
    assert np.abs(physics.qvel).max() < 1.0


def test_cartpole_balances_from_upright_and_swings_up_from_below():
    robot, key = make("cartpole"), parity.start_keys(TRIALS)[0]
    assert robot.step_time == 0.04 and robot.action_repeat == 4
    states = jax.jit(jax.vmap(lambda task: robot.task_reset(task, key)))(
        robot.tasks.params
    )
    up = np.cos(states.physics.qpos[:, 1])
    assert robot.tasks.names[:2] == ("balance", "balance-sparse")
    assert (up[:2] > 0.999).all() and (up[2:] < -0.99).all()
    np.testing.assert_array_equal(states.obs[2], starts("cartpole").obs[0])
    with_target = envs.with_constants(jnp.int32(0), jnp.zeros(2))
    alone = robot.task_reset(with_target, key)
    np.testing.assert_allclose(alone.obs, states.obs[0], atol=1e-6)
    assert make("walker").task_reset is None


@pytest.mark.parametrize(("name", "near", "far"), [
    ("reacher", 0.05, 0.2), ("finger", 0.13, 0.13),
])  # fmt: skip
def test_a_target_is_drawn_for_a_trial_and_stays(name, near, far):
    targets = compared(name)[1].after.constants
    distance = np.linalg.norm(targets, axis=-1)
    assert targets.shape == (TRIALS, STEPS, 2) and np.ptp(targets[:, 0, 0]) > 0.1
    assert (distance > near - 1e-6).all() and (distance < far + 1e-6).all()
    np.testing.assert_array_equal(targets, targets[:, :1].repeat(STEPS, axis=1))


def test_a_robot_has_what_a_report_shows():
    robot = make("walker")
    assert [axis.unit for axis in robot.axes] == ["m/s", "rad/s"]
    rows = robot.env.coordinates
    assert rows[robot.angle].name == "qpos/rooty" and rows[robot.angle].kind == "angle"
    assert robot.space.coordinates == rows and robot.action_repeat == 2
    assert robot.camera in [robot.model.camera(i).name for i in range(robot.model.ncam)]
    edges = robot.axes[0].edges
    assert sorted(edges) == list(edges) and edges[0] == -8.0


def test_positions_are_drawn_from_what_was_observed():
    robot, trials = make("walker"), compared("walker")[1]
    first = parity.at(trials.after, 0)
    start = np.where(np.arange(9) == 1, trials.before.physics.qpos[0, 0], 0.0)
    # Where the walker stands is summed up from its velocity in float32.
    got = robot.qpos_fn(jnp.asarray(first.obs))
    np.testing.assert_allclose(got, first.physics.qpos - start, atol=1e-6)
    rows = tuple(r for r in robot.env.coordinates if r.name == "qpos/rooty")
    alone = qpos_fn(robot.model, rows, 0.05)(jnp.ones((3, 1)))
    np.testing.assert_array_equal(alone, np.tile(np.eye(9)[2], (3, 1)))


@pytest.mark.parametrize("name", DOMAINS)
def test_a_state_that_is_no_number_earns_none(name):
    parity.assert_nothing_is_earned_by_nan(make(name))


@pytest.mark.parametrize("shape", [gaussian, linear, quadratic])
def test_tolerance_is_that_of_dm_control(shape):
    x = np.linspace(-4.0, 4.0, 161)
    for low, high in ((-1.0, 2.0), (0.5, 0.5), (-np.inf, 1.0), (0.0, np.inf)):
        for margin in (0.0, 0.7):
            got = tolerance(
                jnp.asarray(x, jnp.float32), low, high,
                margin=margin, value=0.3, shape=shape,
            )  # fmt: skip
            want = judged.tolerance(x, (low, high), margin, shape.__name__, 0.3)
            np.testing.assert_allclose(got, want, atol=1e-6)


def test_all_twenty_tasks_are_there():
    assert {f"dmc/{name}" for name in DOMAINS} < set(envs.names())
    others = (*dmc_judge.OURS, *dmc_judge.MIRRORED)
    tasks = {
        (DOMAINS[name].file, t) for name in DOMAINS for t in make(name).tasks.names
    }
    judged_tasks = {task for task in tasks if task[1] not in others}
    assert len(judged_tasks - {("acrobot", "swingup-sparse")}) == 20
    assert {("cheetah", "run-backwards"), ("walker", "run-backwards")} < tasks
    with pytest.raises(ValueError, match="dmc/walker"):
        envs.make("dmc/walkers")
