"""A model as a file in place of a run: it acts as its run does, and cannot learn."""

import shutil
import time
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
import runs

import jaxpets
from experiments import cli, exploration, model_file
from experiments.build import build, ensemble_config
from experiments.config import Config
from experiments.entries import to_json
from experiments.errors import UsageError
from experiments.presets import PRESETS
from experiments.run import main
from experiments.storage.folder import RunFolder
from experiments.tools import share
from jaxpets import coordinates, models

SMALL = (
    "--task", "front-flip", "--engine", "mujoco", "--eval-trials", "1",
    "--task-length", "20", "--chunk-length", "10",
    "--task-planner.horizon", "3", "--task-planner.num-samples", "8",
    "--task-planner.num-elites", "2", "--task-planner.num-iterations", "2",
    "--task-planner.num-particles", "15",
)  # fmt: skip


@pytest.fixture(scope="module")
def explored(explored_copy):
    """A run that has performed after a refit, with the search of what is shipped."""
    folder = explored_copy(0)
    planner = PRESETS["laptop"].task_planner
    search = {
        "optimizer": planner.optimizer,
        "noise-beta": str(planner.noise_beta),
        "precision": planner.precision,
    }
    flags = [x for f, v in search.items() for x in (f"--task-planner.{f}", v)]
    command = [
        "--phase",
        "zero-shot",
        "--from",
        str(folder),
        *SMALL,
        *runs.REFIT,
        *flags,
    ]
    assert main(command) == 0
    return folder


@pytest.fixture(scope="module")
def file(explored, tmp_path_factory):
    """The model that performed, as a file with the search that it performed with."""
    path = tmp_path_factory.mktemp("files") / "mine.safetensors"
    assert share.main([str(explored / "zero-shot-003-front-flip"), str(path)]) == 0
    return path


def zero_shot(source, out, *flags):
    command = ["zero-shot", "--from", str(source), "--out", str(out), *SMALL, *flags]
    return main(command)


def returns(folder):
    (row,) = runs.rows(folder / "zero-shot-003-front-flip")
    return row["returns"]


def test_a_file_acts_as_the_run_that_it_is_of(explored, file, tmp_path):
    before = sorted(file.parent.iterdir())
    assert zero_shot(file, tmp_path / "out") == 0
    # Nothing is written beside the model.
    assert sorted(file.parent.iterdir()) == before
    want = returns(explored)
    assert returns(tmp_path / "out" / "mine") == want
    assert all(np.isfinite(list(want.values())))


def test_a_file_does_not_perform_in_the_folder_of_a_run(
    explored, file, tmp_path, capsys
):
    """Whose own zero-shot it would then be refused."""
    (tmp_path / "mine").symlink_to(explored)
    (tmp_path / "theirs").touch()
    theirs = tmp_path / "models" / "theirs.safetensors"
    theirs.parent.mkdir()
    theirs.write_bytes(file.read_bytes())
    for source, words in (
        (file, f"goes to {tmp_path / 'mine'}, which is an exploration's"),
        (theirs, f"goes to {tmp_path / 'theirs'}, which is a file"),
    ):
        assert zero_shot(source, tmp_path) == 2
        assert words in capsys.readouterr().err.splitlines()[-1]


def test_a_file_says_how_its_model_came_to_be(explored, file):
    training = models.about(file)["training"]
    performed = exploration.config_of(RunFolder(explored / "zero-shot-003-front-flip"))
    assert training["refit"] == to_json(performed.refit)
    assert (training["arm"], training["seed"], training["num_trials"]) == (
        "epistemic", 0, 3,
    )  # fmt: skip
    card = file.with_suffix(".md").read_text()
    assert "3 trials of 20 steps" in card and "| front-flip | " in card
    sought = exploration.config_of(RunFolder(explored)).planner
    assert sought.num_particles != performed.task_planner.num_particles
    assert f"{sought.num_particles} particles and horizon {sought.horizon}.\n" in card


def test_a_file_has_no_data_to_learn_on(file, tmp_path, capsys):
    for flags, words in (
        (["finetune"], "--phase finetune is not valid; it must be zero-shot"),
        (["zero-shot", *runs.REFIT], "--refit.num-epochs 1 is not valid"),
        (["zero-shot", "--critic.num-updates", "9"], "--critic.num-updates 9 is not"),
        (["zero-shot", "--env", "dmc/walker"], "--env dmc/walker is not valid"),
        (["zero-shot", "--at-trial", "2"], "--at-trial 2 is not valid; it must be one"),
    ):
        command = [*flags, "--from", str(file), *SMALL, "--out", str(tmp_path)]
        assert main(command) == 2
        assert words in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_policy_is_distilled_from_a_file(file, tmp_path):
    distill = {"num-rounds": 1, "num-trials": 2, "horizon": 4, "num-updates": 3}
    flags = [x for name, n in distill.items() for x in (f"--distill.{name}", str(n))]
    command = ["distill", "--from", str(file), *SMALL, *flags, "--out", str(tmp_path)]
    assert main(command) == 0
    policy = tmp_path / "mine/distill-003-front-flip/policy-0.safetensors"
    training, own = (models.about(x)["training"] for x in (policy, file))
    assert training["model"] == file.name
    assert training["refit"] == own["refit"] and own["refit"]["num_epochs"] == 1


def test_a_model_that_came_along_is_called_by_its_name():
    path = models.path("best")
    assert model_file.origin(model_file.ModelFile(path.resolve())) == {
        "model": "pretrained/best", "refit": models.about(path)["training"]["refit"],
    }  # fmt: skip


def again(file, path, **changes):
    """Writes the model once more, as somebody else who says something else of it."""
    model, params = jaxpets.load_model(file)
    jaxpets.save_model(path, model, params, about=models.about(file) | changes)
    return path


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({"environment": None}, 2, "does not say of which robot it is"),
        ({"environment": "cart"}, 2, "is of cart, which is no robot of the library"),
        ({"environment": "gym/Ant-v5"}, 2, "is of another robot"),
        ({"environment": "evil.py"}, 2, "runs only if you name it: --env evil.py"),
        ({"training": {"arm": "evil.py:arm"}}, 2, "you name it: --arm evil.py:arm"),
        ({"training": {"arm": "mine"}}, 2, "an arm of its own, 'mine': name its file"),
        ({"training": {"num_trials": "x"}}, 3, "num_trials is 'x', not 1 to"),
        ({"training": {"seed": -1}}, 3, "seeds is [-1], not a list"),
        ({"search": {"optimizer": "adam"}}, 3, "cannot be planned with"),
        ({"search": 3}, 3, "cannot be planned with (it says no search)"),
    ],
)
def test_what_a_file_says_is_checked(file, tmp_path, capsys, changes, code, words):
    path = again(file, tmp_path / "theirs.safetensors", **changes)
    assert zero_shot(path, tmp_path / "out") == code
    assert words in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_a_file_that_says_little_performs(file, tmp_path):
    path, robot = tmp_path / "theirs.safetensors", models.about(file)["environment"]
    jaxpets.save_model(path, *jaxpets.load_model(file), about={"environment": robot})
    assert zero_shot(path, tmp_path / "out") == 0
    folder = tmp_path / "out" / "theirs" / "zero-shot-000-front-flip"
    (row,) = runs.rows(folder)
    assert row["explored_trials"] == 0


def test_results_are_of_one_file(file, tmp_path, capsys):
    """Of the same name are another file, and the same one saved again."""
    assert zero_shot(file, tmp_path / "out") == 0
    (folder,) = (tmp_path / "out" / "mine").iterdir()
    before = (folder / "metrics.jsonl").read_bytes()
    path = again(file, tmp_path / "mine.safetensors", note="of somebody else")
    assert zero_shot(path, tmp_path / "out") == 3
    said = capsys.readouterr().err.splitlines()[-1]
    assert f"another model than that of {path}: with that of {file}" in said
    shutil.copy(file, path)  # which is the same model, wherever it is
    assert zero_shot(path, tmp_path / "out") == 0
    assert "already complete" in capsys.readouterr().err
    assert (folder / "metrics.jsonl").read_bytes() == before


def test_layers_of_several_widths_are_refused(tmp_path, capsys):
    env = jaxpets.envs.make("pets/half_cheetah", backend="mujoco")
    sizes = jaxpets.EnsembleConfig(num_members=2, hidden_sizes=(4, 8))
    model = jaxpets.ensemble(sizes, env.space, obs_size=18, action_size=6)
    path = tmp_path / "m.safetensors"
    params = jax.jit(model.init)(jax.random.key(0))
    jaxpets.save_model(path, model, params, about={"environment": env.name})
    assert zero_shot(path, tmp_path / "out") == 2
    assert "has hidden layers of several widths: (4, 8)" in capsys.readouterr().err


def network(path, space, **config):
    """Writes a model of HalfCheetah's sizes that has learned nothing."""
    sizes = jaxpets.EnsembleConfig(num_members=3, hidden_sizes=(4, 4), **config)
    model = jaxpets.ensemble(sizes, space, obs_size=18, action_size=6)
    params = jax.jit(model.init)(jax.random.key(0))
    about = {"environment": "pets/half_cheetah"}
    jaxpets.save_model(path, model, params, about=about)
    return model


def test_a_model_plans_with_its_own_activation(tmp_path, capsys):
    robot = jaxpets.envs.make("pets/half_cheetah", backend="mujoco")
    path = tmp_path / "m.safetensors"
    model = network(path, robot.space, activation="tanh")
    command = ["zero-shot", "--from", str(path), "--task-planner.num-particles", "3"]
    config = cli.parse(command)
    assert ensemble_config(config.model).activation == "tanh"
    assert model.config.activation == "tanh"
    assert main([*command, "--model.activation", "relu"]) == 2
    assert (
        "it must be tanh, which goes with what --from names" in capsys.readouterr().err
    )


def test_a_model_in_other_coordinates_than_the_robots_is_refused(tmp_path, capsys):
    """The features of the plain space are 18 here, as those of the robot."""
    robot = jaxpets.envs.make("pets/half_cheetah", backend="mujoco")
    path = tmp_path / "m.safetensors"
    for space, words in (
        (
            jaxpets.delta_space(),
            "only the file has none, only the robot has mean_qvel/rootx, qpos/rootz",
        ),
        (
            coordinates.space(robot.space.coordinates[::-1]),
            "the order differs: entry 0 is qvel/ffoot in the file, mean_qvel/rootx in "
            "the robot.",
        ),
    ):
        network(path, space)
        assert zero_shot(path, tmp_path / "out") == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert f"{path} is of another robot: the coordinates must be the" in said
        assert f"in the same order; {words}" in said


def test_a_text_file_is_an_error(tmp_path, capsys):
    (tmp_path / "m.safetensors").write_text("no model")
    assert zero_shot(tmp_path / "m.safetensors", tmp_path / "out") == 3
    assert "must be a safetensors file" in capsys.readouterr().err


def test_an_unknown_name_is_an_error(tmp_path, capsys):
    assert zero_shot("pretrained/bst", tmp_path) == 2
    assert "name must be a model, as best, got 'bst'" in capsys.readouterr().err


def test_a_folder_called_pretrained_comes_first(explored, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pretrained").symlink_to(explored)
    for name, found in (("", explored), ("/best", models.path("best"))):
        config = Config(source=Path(f"pretrained{name}"))
        assert cli.explored_run(config) == found.resolve()


@pytest.mark.parametrize("name", models.names())
def test_what_is_shipped_can_perform(name):
    config = cli.parse(["zero-shot", "--from", f"pretrained/{name}"])
    want = name if name.startswith("dmc/") else "pets/half_cheetah"
    assert (config.env, config.eval_trials, config.refit.num_epochs) == (want, 1, 0)
    learns = cli.parse(["distill", "--from", f"pretrained/{name}"])
    assert learns.eval_trials == 5  # all that a policy of a file learns from
    assert config.task_planner.horizon >= 20
    assert cli.results_folder(config).name == f"pretrained-{name.replace('/', '-')}"
    assert models.path(name).stat().st_size < 3e6


def test_one_seed_of_several_is_shared(tmp_path, explored_copy, capsys):
    run, path = explored_copy(0, 7), tmp_path / "new" / "m.safetensors"
    assert share.main([str(run), str(path), "--seed", "7"]) == 0
    config = cli.parse(["zero-shot", "--from", str(path)])
    assert (config.seeds, config.refit.num_epochs) == ((7,), 0)
    _, params = jaxpets.load_model(path)
    known = exploration.explored(run, seed=7, env=None)
    chex.assert_trees_all_equal(params, known.params)


def test_a_page_plans_with_the_model_of_a_run(explored):
    pytest.importorskip("viser", reason="the extra jaxpets[play] is not installed")
    from experiments.play import source

    found = source.found(str(explored))
    assert found.title == f"{explored.name}, trial 3"
    assert found.robot.name == "pets/half_cheetah"
    folder = RunFolder(explored)
    config = exploration.config_of(folder)
    _, state = folder.restore(exploration.template(config, build(config)))
    saved = jax.tree.map(lambda x: x[0], state.params)
    chex.assert_trees_all_equal(found.params, saved)
    with pytest.raises(UsageError, match="--seed 9"):
        source.found(str(explored), seed=9)


def test_a_run_is_watched_while_it_explores(explored, tmp_path):
    pytest.importorskip("viser", reason="the extra jaxpets[play] is not installed")
    from experiments.play import serve, server
    from experiments.play.command import NOTHING
    from experiments.play.watch import Replay, Watched

    begun = tmp_path / explored.name  # before a trial is saved, and then after it
    shutil.copytree(explored, begun, ignore=lambda *_: ["checkpoints"])
    run = Watched(begun, env=None, seed=None)
    replay = Replay(run)
    first = replay.start(NOTHING)
    assert replay.trial == 0 and replay.step(first, NOTHING, None)[1]
    shutil.copytree(explored / "checkpoints", begun / "checkpoints")
    before = {x: x.stat().st_mtime_ns for x in begun.rglob("*")}
    frames = [replay.start(NOTHING)]
    while not (found := replay.step(frames[-1], NOTHING, None))[1]:
        frames.append(found[0])
    assert replay.trial == runs.LAST and len(frames) == runs.STEPS
    assert found[1] == "It is shown again."
    assert frames[-1].obs[0] != frames[0].obs[0]
    with server.serving() as site:
        session, page = serve._watching(site, serve.Options("", watch=begun))
        session.restart()
        page._speak(time.monotonic())
        for chart in (page._part._value, page._part._error, page._part._returns):
            np.testing.assert_array_equal(chart.data[0], [1, 2, 3])
        assert "Trial 3 is shown. The run is " in page._part._text.content
    assert before == {x: x.stat().st_mtime_ns for x in begun.rglob("*")}


@pytest.mark.slow
def test_a_plan_begins_with_a_policy(tmp_path):
    """Eight candidates find little, and do not lose what they are given."""
    found = {}
    for name, flags in (("alone", ()), ("begun", ("--policy", "pretrained/best"))):
        more = ("--tag", name, "--task-length", "100")
        assert zero_shot("pretrained/best", tmp_path, *flags, *more) == 0
        (folder,) = (tmp_path / "pretrained-best").glob(f"zero-shot-060-*{name}")
        (row,) = runs.rows(folder)
        found[name] = row["returns"]["front-flip"]
    assert found["begun"] > 2 * abs(found["alone"])


def test_a_policy_that_will_not_do_is_refused_before_work_begins(
    explored, tmp_path, capsys
):
    """And before a folder is made, which would refuse the corrected command."""
    other = tmp_path / "policy-0.onnx"
    other.write_bytes(b"another format")
    out = tmp_path / "out"
    for source, path, words in (
        ("best", "none.safetensors", "--policy none.safetensors is not valid"),
        ("best", "pretrained/bst", "best"),
        ("best", str(other), "must be a safetensors file"),
        ("dmc/walker", "pretrained/best", "policy of pets/half_cheetah, not of dmc/wa"),
    ):
        assert zero_shot(f"pretrained/{source}", out, "--policy", path) != 0
        last = capsys.readouterr().err.splitlines()[-1]
        assert words in last and last.startswith("error: --policy")
    assert not list(tmp_path.rglob("metrics.jsonl")) and not out.exists()
    critic = ("--critic.num-updates", "9", "--policy", "pretrained/best")
    assert zero_shot(explored, tmp_path, *critic, "--tag", "both") == 2
    assert "None with a critic" in capsys.readouterr().err.splitlines()[-1]
