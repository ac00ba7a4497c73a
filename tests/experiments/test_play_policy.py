"""The page's switch between plans and a policy, which may come with the model."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxpets
from experiments import policy, robots
from experiments.errors import CheckpointError, UsageError
from experiments.play.command import POLICY, TO_EXPLORE, Commands
from experiments.play.readout import curves, disagreement, under_line
from jaxpets import envs, policies
from jaxpets.policies import ActorCriticConfig, Goals, actor_critic, save_policy

pytest.importorskip("viser", reason="the extra jaxpets[play] is not installed")

from experiments.play import source
from experiments.play.controls import Controls, Press, Values
from experiments.play.live import Live
from experiments.play.session import Session


def saved(robot, model, params, path, *, goals=None, about=None):
    """Writes a policy that has learned nothing."""
    env = robot.env
    box = {"action_low": env.action_low, "action_high": env.action_high}
    learner = actor_critic(
        model.sample, robot.tasks.reward_fn, optax.adam(1e-3), ActorCriticConfig(),
        robot.space, obs_size=18, num_members=model.num_members,
        goals=goals or policy.family(robot, len(robot.tasks.names)), **box,
    )  # fmt: skip
    data = jaxpets.datasets.init(50, 18, 6)
    noise = jax.random.normal(jax.random.key(1), (50, 18))
    seen = jaxpets.Transition(noise, jnp.zeros((50, 6)), noise)
    data = jaxpets.datasets.append(data, seen, 50)
    tasks = robot.tasks.params
    if goals is not None:
        tasks = jax.tree.map(lambda x: x[0], tasks)
    known = jaxpets.PlanParams(params, tasks)
    state = jax.jit(learner.init)(known, jax.random.key(0), data)
    save_policy(
        path, params=state.params, space=robot.space, obs_size=18, about=about, **box
    )
    return path


def of_file(path, robot):
    return policy.of_file(path, robot, robot.name, robot.tasks.names)


@pytest.fixture(scope="module")
def cheetah():
    return envs.make("pets/half_cheetah", backend="mujoco"), *jaxpets.pretrained("best")


@pytest.fixture(scope="module")
def found(cheetah, tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "policy-0.safetensors"
    return of_file(saved(*cheetah, path), cheetah[0])


@pytest.fixture(scope="module")
def live(cheetah, found):
    robot, model, params = cheetah
    box = {"action_low": robot.env.action_low, "action_high": robot.env.action_high}
    sizes = {"horizon": 3, "num_samples": 6, "num_elites": 2, "num_iterations": 1}
    search = jaxpets.optimizers.cem(**box, **sizes)
    rollout = jaxpets.particle_rollout(model.sample, num_members=5, num_particles=5)
    return Live(robot, rollout, search, params, horizon=3, policy=found)


def test_a_policy_acts_on_tasks_and_plans_on_all_else(cheetah, live, found):
    robot, _, params = cheetah
    commands = Commands(robot, params)
    first = Values(commands.first.line, (0.0,) * len(commands.sliders), 0.1, 0.0)
    controls, session = Controls(commands, first), Session(live, commands.first)
    frame = live.start(session.command)
    assert len(frame.ghosts) and np.isfinite(frame.disagreement)

    controls.apply(session, first, [Press("acts", POLICY)])
    assert session.command.is_for_policy and "by its policy" in under_line(
        session.command
    )
    acted, _ = live.step(frame, session.command, None)
    # It is where the policy's own action leads.
    task = jax.tree.map(lambda x: x[0], robot.tasks.params)
    act = jax.jit(found.planner.step)
    data = jaxpets.policies.Guided(task, found.networks)
    obs = frame.world.env.obs
    output, _ = act(jaxpets.PlanParams((), data), jax.random.key(0), (), obs)
    there = robot.env.step(frame.world.env, output.action)
    np.testing.assert_allclose(acted.obs, there.obs, atol=1e-6)
    assert not len(acted.ghosts) and "no plan" in disagreement(acted)
    assert np.isnan(acted.promised) and np.isfinite(acted.earned)
    # A promise of the planner is not compared with what the policy earned.
    assert np.isnan(curves([frame, acted], 1, 0.05).promised).all()

    # What it cannot know is planned, and the switch stays.
    for ask in (
        lambda x: commands.by_name(x, TO_EXPLORE),
        lambda x: commands.by_text(x, "velocity"),
    ):
        command = ask(session.command)
        assert command.acts == POLICY and not command.is_for_policy
        planned, _ = live.step(acted, command, None)
        assert len(planned.ghosts)
    controls.apply(session, first, [Press("acts", "x"), Press("acts", "plan")])
    assert not session.command.is_for_policy


def test_a_model_that_came_along_brings_its_policy(cheetah, monkeypatch):
    for name, own in (
        ("pretrained/best", policies.path("best")),
        ("pretrained", None),
        ("pretrained/dmc/walker", None),
        (str(jaxpets.models.path("best")), None),  # a file, of whomever
    ):
        assert source.found(name).policy == own
    robot = cheetah[0]
    monkeypatch.setattr(robots, "named", lambda *_: robot)
    assert source.found("pretrained/best", env="own.py").policy is None
    own = of_file(policies.path("best"), robot)
    for said in ("pretrained/best", "pretrained"):  # there is no other
        found = of_file(Path(said), robot)
        np.testing.assert_array_equal(found.networks.mean, own.networks.mean)
    with pytest.raises(UsageError, match="--policy pretrained/bst is not valid; name"):
        of_file(Path("pretrained/bst"), robot)


def test_a_file_that_is_no_policy_of_the_robot_is_refused(cheetah, tmp_path):
    robot = cheetah[0]
    with pytest.raises(UsageError, match=r"--policy .* there is no such file"):
        of_file(tmp_path / "none.safetensors", robot)
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"x")
    with pytest.raises(CheckpointError, match=r"bad\.safetensors"):
        of_file(bad, robot)
    one = saved(*cheetah, tmp_path / "one.safetensors", goals=Goals())
    with pytest.raises(CheckpointError, match="of another robot, or other tasks"):
        of_file(one, robot)
    walker = envs.make("dmc/walker", backend="mujoco")
    with pytest.raises(CheckpointError):
        of_file(one, walker)


@pytest.mark.parametrize(
    ("about", "words"),
    [
        (
            {"environment": "gym/Walker2d-v5"},
            "a policy of gym/Walker2d-v5, not of pets",
        ),
        ({"environment": 3}, "a policy of 3, not of pets"),
        (
            {"tasks": ["forward"]},
            "it was learned on forward, and forward, backward, fr",
        ),
        ({"tasks": [[1]]}, "learned on [1], and"),
    ],
)
def test_a_policy_that_fits_may_be_of_another_robot(cheetah, tmp_path, about, words):
    """Or of other tasks: HalfCheetah and Walker2d of gym have the same shapes."""
    path = saved(*cheetah, tmp_path / "other.safetensors", about=about)
    with pytest.raises(CheckpointError) as refused:
        of_file(path, cheetah[0])
    assert f"{path} is a policy of " in str(refused.value)
    assert words in str(refused.value)


def test_a_policy_is_of_the_tasks_that_are_performed(cheetah, tmp_path):
    about = {"environment": "cart-robot", "tasks": ["forward", "front-flip"]}
    path = saved(*cheetah, tmp_path / "own.safetensors", about=about)
    # A robot of a file is called as the file is.
    assert policy.of_file(path, cheetah[0], "runs/cart.py:robot", ["front-flip"])
