"""An actor and a critic of every task, in whole runs of the preset smoke."""

import json

import jax
import numpy as np
import pytest
import runs

import jaxpets
from experiments import cli, critic, preparation, robots
from experiments.build import build
from experiments.run import main
from experiments.storage import checkpoint
from jaxpets.policies import Guided

PHASE = ("--phase", "zero-shot", "--task", "front-flip")
FLAGS = (
    "--critic.num-updates", "3", "--critic.batch-size", "6", "--critic.horizon", "2",
    "--critic.hidden-size", "8",
)  # fmt: skip
SAID = "a critic of each task: 3 gradient steps"


@pytest.fixture(scope="module")
def explored(explored_copy):
    return explored_copy(0, 7)


@pytest.fixture
def perform(explored, capsys):
    """A function of flags: what a zero-shot said."""

    def performed(*flags):
        assert main([*PHASE, "--from", str(explored), *FLAGS, *flags]) == 0
        return capsys.readouterr().err

    return performed


@pytest.mark.slow
def test_the_actor_acts_as_it_was_saved(explored, perform):
    flags = ("--critic.acts", "--tag", "actor")
    assert SAID in perform(*flags)
    config = cli.parse([*PHASE, "--from", str(explored), *FLAGS, *flags])
    parts = build(config)
    tasks = robots.chosen(config, parts.robot)
    folder = explored / "zero-shot-003-front-flip-actor"
    _, model, _ = checkpoint.restore(
        folder / "checkpoints",
        preparation.template(config, parts, tasks),
        warn=pytest.fail,
    )
    act = parts.actor.step

    def action(networks, obs):
        params = jaxpets.PlanParams((), Guided((), networks))
        return act(params, jax.random.key(0), (), obs)[0].action

    paths = np.load(folder / "trajectories.npz")
    seen, acted = paths["obs"][:, :, 0, :-1], paths["action"][:, :, 0, 1:]
    of_trial = jax.vmap(action, (None, 0))
    found = jax.jit(jax.vmap(jax.vmap(of_trial)))(model.reward, seen)
    np.testing.assert_allclose(found, acted, atol=1e-5)
    assert np.ptp(acted[0] - acted[1]) > 1e-2  # seeds have networks of their own
    assert json.loads((folder / "env.json").read_text())["rollout"] == "none"


@pytest.mark.slow
def test_a_stopped_run_plans_with_the_critic_that_it_had(explored, perform):
    assert SAID in perform()
    folder = explored / "zero-shot-003-front-flip"
    before = runs.rows(folder)
    assert all(np.isfinite(row["value"]) for row in before)
    (folder / "metrics.jsonl").unlink()
    assert SAID not in perform()
    assert runs.rows(folder) == before


def test_what_is_drawn_for_a_trial_is_seen():
    """The reacher's networks see its target; the walker has none."""
    reacher, walker = (
        robots.named(f"dmc/{x}", "mujoco") for x in ("reacher", "walker")
    )
    assert critic.goals_of(walker).features(()).shape == (0,)
    task = jax.tree.map(lambda x: x[0], reacher.tasks.params)
    goals = critic.goals_of(reacher)
    drawn = [goals.draw(task, jax.random.key(i)) for i in (0, 1)]
    seen = [goals.features(x) for x in drawn]
    assert seen[0].shape == (2,) and not np.allclose(*seen)
    for x, features in zip(drawn, seen, strict=True):
        assert np.asarray(x.constants).ravel() == pytest.approx(np.asarray(features))


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (
            ("--phase", "finetune", *FLAGS),
            "--critic.num-updates 3 is not valid; it must be left out in finetune",
        ),
        (("--phase", "zero-shot", "--critic.acts"), "--critic.acts"),
        (("--phase", "zero-shot", *FLAGS, "--pessimism", "1"), "--pessimism 1.0"),
        (("--phase", "zero-shot", "--critic.discount", "1"), "--critic.discount"),
    ],
    ids=["finetune", "alone", "pessimism", "discount"],
)
def test_what_cannot_be_is_refused(explored, capsys, flags, words):
    assert main([*flags, "--from", str(explored), "--tag", "refused"]) == 2
    assert words in capsys.readouterr().err
    assert not list(explored.glob("*refused"))
