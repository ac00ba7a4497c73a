"""A policy distilled from a planner, in whole runs of the preset smoke."""

import jax
import numpy as np
import pytest
import runs

import jaxpets
from experiments import distilling, policy, robots
from experiments.run import main
from experiments.storage import rundir
from jaxpets import policies
from jaxpets.policies import load_policy

PHASE = ("--phase", "distill", "--task", "forward,front-flip")
FOLDER = "distill-003-forward-front-flip"


@pytest.fixture(scope="module")
def explored(explored_copy):
    return explored_copy(0, 7)


def distilled(explored, capsys, *flags):
    """Distills, and returns what was said."""
    assert main([*PHASE, "--from", str(explored), *flags]) == 0
    return capsys.readouterr().err


@pytest.mark.slow
def test_a_policy_performs_beside_its_planner(explored, capsys):
    refit = ("--refit.num-epochs", "1", "--refit.batch-size", "16", "--tag", "refit")
    said = distilled(explored, capsys, *refit)
    assert "refit: 1 epochs" in said and "distilled 48 plans" in said
    assert "distill 2/2  off the planner by" in said
    folder = explored / f"{FOLDER}-refit"
    rows = runs.rows(folder)
    assert [(row["planner"], row["trial"]) for row in rows] == (
        [("plan", 1)] * 4 + [("policy", 2)] * 4 + [("both", 3)] * 4
    )
    assert {(row["seed"], row["task"]) for row in rows} == {
        (seed, task) for seed in (0, 7) for task in ("forward", "front-flip")
    }
    assert "policy" in said and "planner" in said
    # What acted is what was saved, and what programs without JAX get.
    paths = np.load(folder / "trajectories.npz")
    seen, acted = paths["obs"][:, :, 0, :-1], paths["action"][:, :, 0, 1:]
    assert np.ptp(acted[0] - acted[1]) > 1e-3  # seeds have networks of their own
    assert load_policy(folder / "policy-7.safetensors")
    about = jaxpets.models.about(folder / "policy-7.safetensors")
    assert about["environment"] == rundir.HALF_CHEETAH
    assert about["tasks"] == ["forward", "front-flip"]
    training = about["training"]
    assert (training["model"], training["seed"]) == (explored.name, 7)
    assert (training["num_trials"], training["refit"]["num_epochs"]) == (3, 1)
    assert training["distill"]["num_rounds"] == 2 and training["software"]["jax"]
    onnxruntime = pytest.importorskip("onnxruntime")
    goal = [[1.0, 0.0, 0.1], [0.0, 1.0, 0.1]]
    for i, seed in enumerate((0, 7)):
        session = onnxruntime.InferenceSession(folder / f"policy-{seed}.onnx")
        for k in (0, 1):
            tasks = np.tile(np.float32(goal[k]), (len(seen[i, k]), 1))
            (found,) = session.run(None, {"obs": seen[i, k], "task": tasks})
            np.testing.assert_allclose(found, acted[i, k], atol=1e-4)
    # A run that was stopped before it performed does so with what it had learned.
    assert "already complete" in distilled(explored, capsys, *refit)
    (folder / "metrics.jsonl").unlink()
    assert "distilled 48 plans" not in distilled(explored, capsys, *refit)
    assert runs.rows(folder) == rows


@pytest.mark.slow
def test_a_policy_can_be_imagined_before_a_planner_is_asked(explored, capsys):
    flags = ("--distill.critic.num-updates", "5", "--distill.critic.batch-size", "6")
    alone = ("--distill.num-rounds", "0", "--tag", "imagined")
    said = distilled(explored, capsys, *flags, *alone)
    assert "an imagined policy of all tasks: 5 gradient steps" in said
    assert "plans of each seed" not in said and "distill 1/" not in said
    rows = runs.rows(explored / f"{FOLDER}-imagined")
    assert [row["planner"] for row in rows[::4]] == ["plan", "policy", "both"]
    said = distilled(explored, capsys, *flags, "--tag", "begun")
    assert "imagined policy" in said and "distill 2/2  off the planner by" in said
    first, then = (
        load_policy(explored / f"{FOLDER}-{tag}" / "policy-0.safetensors")[1]
        for tag in ("imagined", "begun")
    )
    # Its critics know all that comes, discounted; the rounds' what a plan earns.
    assert first.scale != then.scale
    # The rounds go on from what was imagined: they see alike, and have moved.
    np.testing.assert_allclose(first.mean, then.mean, atol=1e-6)  # of sums in any order
    weights = [np.concatenate([*map(np.ravel, jax.tree.leaves(x.actor))])
               for x in (first, then)]  # fmt: skip
    assert 0.0 < np.abs(weights[0] - weights[1]).max() < 0.5


def test_a_planner_that_earns_nothing_has_no_share():
    """As with a sparse reward; the run is complete all the same."""
    rows = [
        {"planner": who, "task": "hop", "return": value}
        for who, value in zip(distilling.WHO, (0.0, 3.0, 0.0), strict=True)
    ]
    text = distilling._summary(rows, ["hop"], 1.0)
    assert "%" not in text and "policy      3" in text
    rows[0]["return"], rows[1]["return"] = 10.0, -20.0
    text = distilling._summary(rows, ["hop"], 1.0)
    assert "policy    -20  both      0 (0%)" in text
    rows[0]["return"], rows[1]["return"] = 0.0, np.nan
    text = distilling._summary(rows, ["hop"], 1.0)
    assert text.splitlines()[-1].startswith("  the reward of hop is not finite in 1 of")
    rows[0]["lost_steps"] = 7
    text = distilling._summary(rows, ["hop"], 1.0)
    assert "  physics diverged in 1 of 3 trials: 7 steps lost\n" in text


def test_a_task_is_seen_by_its_weights_or_as_one_of_several():
    cheetah = robots.named(rundir.HALF_CHEETAH, "mujoco")
    reacher = robots.named("dmc/reacher", "mujoco")
    for robot, size in ((cheetah, 3), (reacher, len(reacher.tasks.names) + 2)):
        goals = policy.family(robot, len(robot.tasks.names))
        drawn = [goals.draw(robot.tasks.params, jax.random.key(i)) for i in range(20)]
        seen = np.stack([goals.features(x) for x in drawn])
        assert seen.shape == (20, size) and seen.dtype == np.float32
        assert len(np.unique(seen[:, : size - 2], axis=0)) > 1
    assert set(np.unique(seen[:, :-2])) == {0.0, 1.0}


def test_the_policy_that_comes_along_performs_all_tasks():
    """At least half of what each of four trials of 200 steps returned."""
    robot = robots.named(rundir.HALF_CHEETAH, "mujoco")
    tasks = robot.tasks
    goals = policy.family(robot, len(tasks.names))
    planner, networks = load_policy(policies.path("best"), goals=goals)
    keys = jax.random.split(jax.random.key(0))

    def returned(task):
        params = jaxpets.PlanParams((), policies.Guided(task, networks))
        state = jaxpets.start_trial(robot.env, planner, keys[0])
        _, seen, _ = jaxpets.unroll(
            robot.env, planner, params, keys[1], state, length=200
        )
        return jax.vmap(tasks.reward_fn, (None, 0, 0, 0))(task, *seen).sum()

    found = jax.jit(jax.vmap(returned))(tasks.params)
    assert tasks.names == ("forward", "backward", "front-flip", "back-flip")
    assert (np.asarray(found) > (450, 290, 870, 910)).all()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--critic.num-updates", "5"), "--distill.critic.num-updates is meant"),
        (("--critic.acts",), "--critic.acts True is not"),
        (("--distill.num-rounds", "0"), "--distill.num-rounds 0 is not valid"),
        (
            ("--distill.critic.num-updates", "5", "--pessimism", "1"),
            "--pessimism 1.0 is not valid",
        ),
    ],
    ids=["critic", "acts", "rounds", "pessimism"],
)
def test_what_cannot_be_is_refused(explored, capsys, flags, words):
    assert main([*PHASE, *flags, "--from", str(explored), "--tag", "refused"]) == 2
    assert words in capsys.readouterr().err
    assert not list(explored.glob("*refused"))
