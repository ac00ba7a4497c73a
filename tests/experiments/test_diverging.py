"""Physics that diverges in a trial: the trial ends there, and the run goes on."""

import jax
import numpy as np
import pytest
import runs
import wild_robot

import jaxpets
from experiments import acting, cli, exploration, records
from experiments.acting import Score, Scorer, Trials
from experiments.build import build
from experiments.errors import DivergedError
from experiments.report import caveats
from experiments.run import main
from experiments.storage import checkpoint, metrics, rundir

SEEDS, LAST, STEPS = (1, 2), 2, runs.STEPS
FLAGS = (
    "explore", "--env", wild_robot.__file__, "--preset", "smoke", "--engine", "mujoco",
    "--seeds", *map(str, SEEDS), "--num-trials", str(LAST), "--model.num-members", "2",
    "--model.hidden-size", "8", "--model.num-layers", "1", "--planner.no-fused",
    "--planner.horizon", "2", "--planner.num-particles", "2",
    "--planner.num-iterations", "1", "--task-planner.num-particles", "2",
)  # fmt: skip
NAME = "smoke-wild_robot-epistemic"


@pytest.fixture(scope="module")
def parts():
    config = cli.parse(FLAGS)
    return config, build(config)


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """The folder of a run, and what it said."""
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        said = []
        patch.setattr("experiments.progress.Progress.line", lambda _, x: said.append(x))
        assert main([*FLAGS, "--out", str(out)]) == 0
    return out / NAME, said


def learner(folder, parts):
    template = exploration.as_saved(*parts)
    found = checkpoint.restore(folder / "checkpoints", template, warn=pytest.fail)
    return jax.tree.map(np.asarray, found[1])


def kept(folder):
    """The steps of every trial before physics diverged, `[trial, seed]`."""
    lost = [row.get("lost_steps", 0) for row in runs.rows(folder)]
    return STEPS - np.reshape(lost, (LAST, len(SEEDS)))


def test_what_came_before_is_learned_from(explored, parts):
    """The random trial's rows are those of the trial as it was, and it is finite."""
    folder, _ = explored
    state, counts = learner(folder, parts), kept(folder)
    assert ((counts[0] > 0) & (counts[0] < STEPS)).all()
    assert int(state.dataset.size) == LAST * STEPS
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state))
    data = state.dataset.data
    for seed in range(len(SEEDS)):
        for trial in range(LAST):
            rows = slice(trial * STEPS, trial * STEPS + counts[trial, seed])
            obs, after = data.obs[seed, rows], data.next_obs[seed, rows]
            np.testing.assert_array_equal(obs[1:], after[:-1])  # one path
        end = counts[0, seed]
        again = data.obs[seed, end:STEPS]  # rows that were there
        assert (again[:, None] == data.obs[seed, :end]).all(-1).any(1).all()
        assert (data.action[seed, end:STEPS] != 0).all()
    assert np.abs(data.next_obs).max() < 1e4  # it blows up to 1e8


def test_the_log_and_the_line_of_the_trial_say_it(explored):
    folder, said = explored
    for row in runs.rows(folder):
        assert row["returns"]["steps"] == STEPS - row.get("lost_steps", 0)
        assert (
            "bad_plans" not in row and np.isfinite([row["value"], row["turns"]]).all()
        )
        assert row["fit"]["num_updates"] > 0 and row["fit"]["num_skipped"] == 0
    for line, counts in zip(said, kept(folder), strict=True):
        lost = STEPS - counts
        text = f"physics diverged in {(lost > 0).sum()} of 2 trials: {lost.sum()} steps"
        assert text in line or not lost.any()


def test_the_report_says_it(explored):
    folder, _ = explored
    config = rundir.find_json(folder / "config.json")
    rows = list(metrics.read(folder / "metrics.jsonl", config))
    lost = STEPS - kept(folder)
    want = (
        f"`epistemic`: physics diverged in {(lost > 0).sum()} of 4 trials of explore; "
        f"{lost.sum()} steps are lost, and returns count what was earned before."
    )
    assert want in caveats.sentences(rows, {}, LAST)


def test_a_run_goes_on_across_it(explored, parts, tmp_path):
    """From before the last trial, to the same log and state, bit for bit."""
    folder, _ = explored
    again = runs.unfinished(folder, tmp_path, LAST)
    assert main([*FLAGS, "--out", str(tmp_path)]) == 0
    one, two = (
        [{k: v for k, v in row.items() if k != "seconds"} for row in runs.rows(x)]
        for x in (folder, again)
    )
    assert one == two
    jax.tree.map(
        np.testing.assert_array_equal, learner(folder, parts), learner(again, parts)
    )


def some_trials(count, num_kept):
    """Trials of T = 4 steps, and what scores them by counting."""
    obs = np.zeros((count, 4, 1), np.float32)
    seen = jaxpets.Transition(obs, obs, obs)
    num_steps = np.array(num_kept, np.int32)
    score = Score(num_steps[:, None].astype(np.float32), None, num_steps)
    scorer = Scorer(("steps",), lambda seen, constants: score)
    values = np.array([[1.0, 2.0, -1e29, -1e29]] * count, np.float32)
    return scorer, Trials(seen, values)


def test_plans_of_what_has_diverged_do_not_count():
    scorer, trials = some_trials(3, [4, 1, 0])
    labels = [{"phase": "explore"}] * 3
    whole, short, none = records.rows(scorer, labels, trials)
    assert whole["bad_plans"] == 2 and "lost_steps" not in whole
    assert short["value"] == 1.5 and "bad_plans" not in short
    assert (none["value"], none["lost_steps"], none["returns"]["steps"]) == (1, 4, 0)


def test_a_robot_that_diverges_at_once_cannot_be_learned():
    scorer, trials = some_trials(2, [1, 0])
    rows = records.rows(scorer, [{"phase": "explore"}] * 2, trials)
    records.check_begun(rows[:1], 4)
    with pytest.raises(DivergedError, match="in the first step of the first trial"):
        records.check_begun(rows, 4)


def test_a_trial_that_is_drawn_ends_there_too(tmp_path):
    """That of fine-tuning comes from the data, where other rows took its places."""
    log = tmp_path / "metrics.jsonl"
    rows = [{"trial": 3, "lost_steps": 9}, {"trial": 4}, {"trial": 4, "lost_steps": 1}]
    metrics.append_rows(log, [*rows, {"trial": 4, "lost_steps": "x"}])
    assert metrics.lost_steps(log, 4) == [0, 1, 0]
    _, trials = some_trials(2, [4, 3])
    path = records.until_diverged(trials.transitions, [0, 1]).next_obs
    np.testing.assert_array_equal(np.isnan(path[..., 0]), [[0] * 4, [0, 0, 0, 1]])
    path = records.until_diverged(trials.transitions, []).next_obs
    assert np.isfinite(path).all()


def test_scores_count_what_was_earned_before(parts):
    """Whole trials, and one of which nothing is left."""
    robot = parts[1].robot
    obs = np.zeros((3, 4, 4), np.float32)
    obs[..., 0] = np.pi * np.arange(4)
    obs[1, 2], obs[2, 0] = np.nan, 1e11
    seen = jaxpets.Transition(obs, np.zeros((3, 4, 1), np.float32), obs)
    score = acting.scorer(robot).score(seen, ())
    assert score.num_steps.tolist() == [4, 2, 0]
    assert score.returns.tolist() == [[4.0], [2.0], [0.0]]
    np.testing.assert_allclose(score.turns[:2], [1.5, 0.5], rtol=1e-6)
