"""A robot, tasks and an objective of the user's, through every phase."""

import json
from pathlib import Path

import jax
import numpy as np
import own_robot
import pytest
import runs

from experiments import cli, robots, user_files
from experiments.build import build
from experiments.errors import UsageError
from experiments.report import style
from experiments.run import main
from experiments.storage import rundir
from experiments.tools import model_error, share, video
from jaxpets import envs

FILE = own_robot.__file__
ROBOT = ("--env", FILE)
ARM = ("--arm", f"{FILE}:novelty")
TINY = (
    "--preset", "smoke", "--engine", "mujoco", "--model.num-members", "2",
    "--model.hidden-size", "8", "--model.num-layers", "1", "--num-trials", "2",
    *(f"--{name}.{flag}" for name in ("planner", "task-planner")
      for flag in ("no-fused", "horizon=2", "num-particles=2", "num-iterations=1")),
)  # fmt: skip
NAME = "smoke-own_robot-own_robot-novelty"
TUNED = "finetune-002-own_robot"


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    """Explored, performed the robot's tasks, tuned one of a file, reported."""
    out = tmp_path_factory.mktemp("out")
    assert main(["explore", *ROBOT, *ARM, *TINY, "--out", str(out)]) == 0
    later = ("--from", str(out / NAME), *ROBOT, *ARM)
    assert main(["zero-shot", *later, "--eval-trials", "2"]) == 0
    tune = ("--tasks", FILE, "--finetune-trials", "1")
    assert main(["finetune", *later, *tune]) == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(style.STYLE, "savefig.dpi", 30)
        assert main(["report", "--out", str(out)]) == 0
    return out


def test_exploration_is_logged_with_the_tasks_of_the_robot(out):
    first, second = runs.rows(out / NAME)
    assert (first["arm"], first["planner"]) == ("own_robot-novelty", "random")
    assert set(first["returns"]) == {"reach", "spin"}
    assert second["value"] > 0.0 and np.isfinite(second["turns"])
    goals = [row["constants/goal"] for row in (first, second)]
    assert goals[0] != goals[1] and max(map(abs, goals)) <= 1.0


def test_what_comes_next_names_the_files_again(out, capsys):
    """They run because a command names them, and not as a run's config does."""
    assert main(["explore", *ROBOT, *ARM, *TINY, "--out", str(out)]) == 0
    last = capsys.readouterr().err.splitlines()[-1]
    said = f"zero-shot --from {out / NAME} --env {FILE} --arm {FILE}:novelty"
    assert last.startswith("next: ") and last.endswith(said)


def test_coverage_has_the_axes_of_the_robot(out):
    found = json.loads((out / NAME / "coverage.json").read_text())
    assert found["units"] == ["m", "rad/s"]
    counts = np.array(found["counts"]["0"])
    assert counts.shape == (4, 2) and counts.sum() == 2 * runs.STEPS


def test_a_trial_is_scored_by_what_was_drawn_for_it(out):
    """By the file of trajectories, for a zero-shot and for the last tuned trial."""
    for folder, task in (("zero-shot-002", "reach"), (TUNED, "near")):
        paths = dict(np.load(out / NAME / folder / "trajectories.npz"))
        place = paths["obs"][0, 0, ..., 0]
        goal = paths["constants/goal"][0, 0]
        want = -np.abs(place - goal[:, None]).sum(-1)
        np.testing.assert_allclose(paths["returns"][0, 0], want, rtol=1e-5)
        logged = [x for x in runs.rows(out / NAME / folder) if x["task"] == task]
        np.testing.assert_allclose([row["return"] for row in logged], want, rtol=1e-5)
        assert [row["constants/goal"] for row in logged] == goal.tolist()


def test_a_reward_of_one_action_is_never_given_those_of_a_trial(out):
    """It adds up all entries of what it takes for one action."""
    paths = dict(np.load(out / NAME / "zero-shot-002" / "trajectories.npz"))
    rate, force = paths["obs"][0, 1, ..., 3], paths["action"][0, 1, ..., 0]
    want = (rate - 0.1 * force**2).sum(-1)
    np.testing.assert_allclose(paths["returns"][0, 1], want, rtol=1e-4, atol=1e-3)


def test_trials_of_a_task_start_where_the_robot_says(out):
    paths = np.load(out / NAME / "zero-shot-002" / "trajectories.npz")
    first = paths["obs"][0, :, :, 0, 1]  # the angle after a step
    assert paths["tasks"].tolist() == ["reach", "spin"]
    assert (np.abs(first[0]) < 0.3).all() and (np.abs(first[1] - 1.0) < 0.3).all()


def test_tasks_of_a_file_stand_beside_those_of_the_robot(out):
    (row,) = runs.rows(out / NAME / TUNED)
    assert (row["task"], set(row["returns"])) == ("near", {"near"})
    table = json.loads((out / "report" / "table1.json").read_text())
    assert list(table["own_robot-novelty"]) == ["reach", "spin"]
    text = (out / "report" / "report.md").read_text()
    assert "| near | no log |" in text and "\nnear:\n" in text


def test_the_report_is_of_the_robot_alone(out):
    text = (out / "report" / "report.md").read_text()
    assert text.startswith("# Report of preset `smoke-own_robot`\n")
    assert "paper: " not in text and "forward" not in text and "Flips" not in text
    assert "4 bins of 1 m (place) by 2 bins of 10 rad/s (rate)" in text
    assert {"figure4.png", "coverage.png"} <= {
        path.name for path in (out / "report").iterdir()
    }


@pytest.mark.parametrize("wanted", [ROBOT, ARM])
def test_a_file_runs_only_if_the_command_names_it(out, capsys, wanted):
    """And not because the folder of a run does, which may be a stranger's."""
    said = {*ROBOT, *ARM} - {*wanted}
    flags = [x for pair in (ROBOT, ARM) for x in pair if said >= {*pair}]
    assert main(["zero-shot", "--from", str(out / NAME), *flags]) == 2
    assert f"runs only if you name it: {' '.join(wanted)}." in capsys.readouterr().err


def test_a_run_goes_on_from_another_folder(tmp_path, monkeypatch, capsys):
    """With the file that the command names, though another is there of its old name."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    text = Path(FILE).read_text()
    for name in ("cart.py", "other.py"):
        (tmp_path / name).write_text(text)
    (elsewhere / "cart.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    begin = ["explore", *TINY, "--arm", "random", "--num-trials"]
    monkeypatch.chdir(tmp_path)
    assert main([*begin, "1", "--env", "cart.py", "--name", "begun"]) == 0
    monkeypatch.chdir(elsewhere)
    again = ("--env", "../cart.py", "--name", "begun", "--out", "../runs")
    assert main([*begin, "2", *again]) == 0
    assert "warning" not in capsys.readouterr().err  # nor is a checkpoint set aside
    rows = runs.rows(tmp_path / "runs/begun")
    assert [row["trial"] for row in rows] == [1, 2]
    perform = ["zero-shot", "--from", "../runs/begun", "--eval-trials", "1", "--env"]
    assert main([*perform, "../cart.py"]) == 0
    share_it = ("../runs/begun", "m.safetensors", "--env")
    assert share.main([*share_it, "../cart.py"]) == 0
    capsys.readouterr()
    for line in (perform, share_it):
        run = main if line is perform else share.main
        assert run([*line, "../other.py"]) == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert "error: --env ../other.py is not valid; it must be the file" in said
        assert "has, cart.py, seen from here or" in said
        assert run([*line, "../cart.py:wrong"]) == 2
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    line = ["zero-shot", "--from", "runs/begun", "--eval-trials", "1"]
    assert main([*line, "--env", "cart.py"]) == 0
    assert "already complete" in capsys.readouterr().err
    # A file that was moved is known by its name and content.
    moved = tmp_path / "new" / "cart.py"
    moved.parent.mkdir()
    (tmp_path / "cart.py").rename(moved)
    explore = [*begin, "2", "--name", "begun"]
    for command in (explore, line):
        assert main([*command, "--env", "new/cart.py"]) == 0
        said = capsys.readouterr().err
        assert "already complete" in said and "warning" not in said
    moved.write_text(f"{text}\n# edited")
    for command in (explore, line):
        assert main([*command, "--env", "new/cart.py"]) in (2, 3)
        assert "new/cart.py" in capsys.readouterr().err
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("said", "found"),
    [
        ("a/bot.py", "bot.py"),  # begun in a, where the run is
        ("a/bot.py:two", "bot.py:two"),
        ("link.py", "a/bot.py"),
        ("b/../a/bot.py", "./a/bot.py"),
        ("bot.py", "bot.py"),
    ],
)
def test_one_file_has_several_names(tmp_path, monkeypatch, said, found):
    """What runs is always what is said."""
    monkeypatch.chdir(tmp_path)
    for name in ("a/runs/mine", "b"):
        Path(name).mkdir(parents=True)
    Path("link.py").symlink_to("a/bot.py")
    where = Path("a/runs/mine/config.json")
    assert user_files.named("--env", said, found, where) == said
    others = ("b/bot.py", "a/bot.py:other", "a/other.py", "b/bot.py:two")
    for other in others:
        with pytest.raises(UsageError, match=f"^--env {other} is not valid; it must"):
            user_files.named("--env", other, found, where)
    for other in (None, "dmc/walker"):
        with pytest.raises(UsageError, match="runs only if you name it"):
            user_files.named("--env", other, found, where)
    with pytest.raises(UsageError, match="is not valid"):
        user_files.named("--env", said, "\0.py", where)


def test_a_file_that_was_changed_is_told(out, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("near.py").write_text(Path(FILE).read_text())
    line = ["zero-shot", "--from", str(out / NAME), *ROBOT, *ARM, "--tasks", "near.py"]
    assert main(line) == 0
    assert main(line) == 0
    assert "warning" not in capsys.readouterr().err
    with Path("near.py").open("a") as file:
        file.write("# other numbers\n")
    assert main(line) == 0
    said = capsys.readouterr().err
    assert "warning: the content of near.py was " in said and " and is now " in said


def test_a_zero_shot_is_no_exploration(out, capsys):
    folder = out / NAME / "zero-shot-002"
    assert main(["zero-shot", "--from", str(folder), *ROBOT, *ARM]) == 2
    words = (
        f"it must be an exploration; name the run that it began with, as {out / NAME}"
    )
    assert words in capsys.readouterr().err


def test_a_tool_runs_no_file_that_only_a_run_names(out, tmp_path, capsys):
    flags = (str(out / NAME), "--out", str(tmp_path / "error.json"))
    assert model_error.main(flags) == 2
    assert f"only if you name it: --env {FILE}." in capsys.readouterr().err
    assert share.main([str(out / NAME), str(tmp_path / "m.safetensors")]) == 2
    assert f"only if you name it: --env {FILE}." in capsys.readouterr().err


def test_a_robot_without_a_model_is_not_drawn():
    with pytest.raises(UsageError, match=f"{FILE} has no model that can be drawn"):
        video._robot(FILE)


def test_a_robot_that_hides_its_positions_is_not_drawn(monkeypatch):
    robot = robots.named("pets/half_cheetah", "mujoco")
    hidden = robot._replace(qpos_fn=lambda obs: obs + np.nan)
    monkeypatch.setattr(video, "open_renderer", lambda *_: None)
    with pytest.raises(UsageError, match="pets/half_cheetah does not observe posi"):
        video._opened(hidden, np.zeros((1, 4), np.float32), video.Look())


WRONG = {
    "def robot(backend:": "1: SyntaxError: ",
    "import os\n\nraise ValueError('far\\nout')": "3: ValueError: far.",
    "import sys\nsys.exit(1)": "2: SystemExit: 1.",
    "def act():\n    pass": "has no function robot.",
    "robot = 3": "has no function robot.",
    "\ndef robot(backend):\n    return 3": "2: TypeError: it must return a jaxpets.en",
    "def robot():\n    return 3": "1: TypeError: robot() takes 0 positional arguments",
    "def robot(backend):\n    return 1 / 0": "2: ZeroDivisionError: division by zero.",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_file_that_is_no_robot_is_one_line(tmp_path, capsys, text):
    file, out = tmp_path / "bad.py", tmp_path / "out"
    file.write_text(text)
    assert main(["explore", "--env", str(file), "--out", str(out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: --env {file} is not valid; {file}")
    assert WRONG[text] in line and not out.exists()


BAD_ENDS = {
    "lambda o: o[1] < 0.1": "bool [...] for observations [..., D], got bool (6, 4) for",
    "lambda o: o[..., 1]": "ValueError: env.terminal_fn must return bool[], got fl",
    "lambda o: (o < 0.1).any()": "got bool () for (5, 6, 4)",
    "lambda o: o @ o < 0.1": "4: TypeError: ",
}


@pytest.mark.parametrize("text", BAD_ENDS)
def test_an_end_that_knows_one_observation_is_one_line(tmp_path, text):
    """Plans and scores ask of many at once."""
    made = "own = own_robot.robot(backend)"
    lines = [f"import {own_robot.__name__}", "def robot(backend):", f"    {made}"]
    lines += [f"    end = {text}", "    env = own.env._replace(terminal_fn=end)"]
    file = tmp_path / "bad.py"
    file.write_text("\n".join([*lines, "    return own._replace(env=env)"]))
    with pytest.raises(UsageError) as error:
        robots.named(str(file), "mujoco")
    assert str(error.value).startswith(f"--env {file} is not valid; {file}:")
    assert BAD_ENDS[text] in str(error.value)
    file.write_text(file.read_text().replace(text, "lambda o: o[..., 1] < 0.1"))
    assert robots.named(str(file), "mujoco").env.terminal_fn is not None


BAD_TASKS = {
    "return {}": "rewards must have a task, got none",
    "return [1]": "it must return rewards by name, got list",
    "return {'all': lambda c, o, a, n: n[..., 0]}": "names of their own, not all",
    "return {'a/b': lambda c, o, a, n: n[..., 0]}": "task 'a/b' is not a valid name",
    "return {'far': lambda c, o, a, n: n[..., 0] - c.goal}": "2: AttributeError: ",
    "return {'past': lambda c, o, a, n: n[..., 4]}": "2: IndexError: rewards['past'] "
    "must read entries that there are: index 4 is out of bounds for axis 0 with size 4",
    "return {'past': lambda c, o, a, n: n[..., 0] * a[1]}": "2: IndexError: rewards['pa"
    "st'] must read entries that there are: index 1 is out of bounds for axis 0 with",
    "return {'wide': lambda c, o, a, n: n}": "1: ValueError: reward_fn must return",
}


@pytest.mark.parametrize("text", BAD_TASKS)
def test_tasks_that_are_none_are_one_line(tmp_path, text):
    file = tmp_path / "bad.py"
    file.write_text(f"def tasks():\n    {text}")
    with pytest.raises(UsageError) as error:
        robots.named(FILE, "mujoco", str(file))
    assert str(error.value).startswith(f"--tasks {file} is not valid; {file}:")
    assert BAD_TASKS[text] in str(error.value)


OWN_TASKS = [
    "o.at[..., 0].set(1.0)[..., 0]",
    "n.at[..., 9].get(mode='fill', fill_value=0.0)",
    "n[..., jnp.arange(4)].sum(-1) / n[..., 0] + c['goal']",
    "jax.lax.fori_loop(0, 4, lambda i, x: x + n[..., i], n[..., 0])",
    "jnp.log(n[..., -4]) / o[..., 3] + a.sum()",
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("text", OWN_TASKS)
def test_a_reward_of_jax_need_not_take_arrays_of_numpy(tmp_path, text):
    file = tmp_path / "good.py"
    file.write_text(
        "import jax\nimport jax.numpy as jnp\n\ndef tasks():\n"
        f"    return {{'good': lambda c, o, a, n: {text}}}"
    )
    assert robots.named(FILE, "mujoco", str(file)).tasks.names == ("good",)


def test_a_robot_whose_own_reward_reads_past_the_end_is_one_line(tmp_path):
    file = tmp_path / "bad.py"
    text = Path(FILE).read_text()
    assert text.count("next_obs[..., rate]") == 1
    file.write_text(text.replace("next_obs[..., rate]", "next_obs[..., 40]"))
    words = r"IndexError: rewards\['spin'\] must .* index 40 is out .* with size 4\.$"
    with pytest.raises(UsageError, match=words) as error:
        robots.named(str(file), "mujoco")
    assert str(error.value).startswith(f"--env {file} is not valid; {file}:")


BAD_ARMS = {
    "return 3": "1: TypeError: it must return (RewardFn, RewardData), got 3.",
    "return (lambda d, o, a, n: n / 0 * d.x), RewardData()": "3: AttributeError: ",
    "return (lambda d, o, a, n: n), RewardData()": "reward_fn must return shape",
}


@pytest.mark.parametrize("text", BAD_ARMS)
def test_an_objective_that_is_none_is_one_line(tmp_path, text):
    file = tmp_path / "bad.py"
    file.write_text(f"def arm(model):\n    from jaxpets import RewardData\n    {text}")
    with pytest.raises(UsageError) as error:
        cli.parse(["explore", *ROBOT, *TINY, "--arm", f"{file}:arm"])
    assert BAD_ARMS[text] in str(error.value)


@pytest.mark.parametrize("arm", ["oracle", "mixture"])
def test_an_arm_that_seeks_a_task_gets_the_constants_of_the_trial(arm):
    config = cli.parse(["explore", *ROBOT, *TINY, "--arm", arm])
    parts, goal = build(config), {"goal": jax.ShapeDtypeStruct((), "float32")}
    before = jax.eval_shape(parts.learner.init, jax.random.key(0)).reward
    after = parts.bind(before, goal)
    if arm == "mixture":
        before, after = before.extrinsic, after.extrinsic
    assert after == envs.with_constants(before, goal)


def test_robots_are_listed(capsys, monkeypatch):
    some = ("pets/half_cheetah", "dmc/walker", "gym/Hopper-v5")
    monkeypatch.setattr(envs, "names", lambda: some)
    assert main(["--list", "envs"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["name", "observation", "action", "tasks"]
    packages = ["brax/NAME", "playground/NAME"]
    assert [line.split()[0] for line in lines] == [*some, *packages]
    assert lines[-1].endswith("own, of any NAME in mujoco_playground.registry")
    assert "18" in lines[0] and lines[0].endswith("front-flip, back-flip")
    assert "stand, walk, run" in next(x for x in lines if x.startswith("dmc/walker"))
    assert main(["--list", "arms"]) == 2
    assert "--list arms is not valid; it must be envs." in capsys.readouterr().err


def test_a_robot_whose_package_is_missing_is_one_line(monkeypatch):
    def missing(name, **_):
        raise ImportError("this environment needs the extra jaxpets[dmc]")

    monkeypatch.setattr(envs, "make", missing)
    with pytest.raises(UsageError, match="dmc/hopper is not valid; this environment"):
        robots.named("dmc/hopper", "mjx")
    (line,) = [x for x in robots.listing("mjx").splitlines() if "dmc/hopper" in x]
    assert line.split(maxsplit=1)[1] == "needs the extra jaxpets[dmc]"


@pytest.mark.parametrize(
    ("text", "label"),
    [
        ("dmc/walker", "dmc-walker"),
        ("gym/Hopper-v5", "gym-Hopper-v5"),
        ("my_robot.py", "my_robot"),
        ("../a b/my_robot.py:other", "my_robot-other"),
        ("info-gain", "info-gain"),
        ("../\x1b/x", "x"),
        ("小车.py", "9b99d2db"),
    ],
)
def test_what_folders_call_it(text, label):
    assert rundir.label(text) == label
    rundir.check_name(label)
