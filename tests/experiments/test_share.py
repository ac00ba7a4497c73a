"""A run's model as one file: what comes with the library is what performed."""

import json
import shutil

import jax
import numpy as np
import pytest

import jaxpets
from experiments import exploration
from experiments.tools import share, shipped
from jaxpets import models


@pytest.fixture(scope="module")
def explored(explored_copy):
    return explored_copy(0)


def test_a_file_predicts_as_its_run(explored, tmp_path):
    path = tmp_path / "new" / "m.safetensors"
    assert share.main([str(explored), str(path)]) == 0
    said = path.with_suffix(".md").read_text()
    assert "3 trials of 20 steps" in said and "not performed a task yet" in said
    model, params = jaxpets.load_model(path)
    known = exploration.explored(explored, seed=None, env=None)
    settings = models.about(path)["search"]["settings"]
    search = known.config.task_planner
    assert {k: getattr(search, k) for k in settings} == settings
    obs = np.zeros((model.num_members, 1, 18), np.float32)
    action = np.ones((1, 6), np.float32)
    want = jax.jit(known.parts.model.predict)(known.params, obs, action)
    got = jax.jit(model.predict)(params, obs, action)
    jax.tree.map(np.testing.assert_array_equal, got, want)


def test_the_robot_is_that_of_the_run(explored, tmp_path, capsys):
    path = tmp_path / "m.safetensors"
    robot = ("--env", "pets/half_cheetah")  # as the run has it anyway
    assert share.main([str(explored), str(path), *robot]) == 0
    assert models.about(path)["environment"] == robot[1]
    other = ("--env", "dmc/walker")
    assert share.main([str(explored), str(tmp_path / "n.safetensors"), *other]) == 2
    words = "--env dmc/walker is not valid; it must be pets/half_cheetah, the robot of"
    assert words in capsys.readouterr().err
    assert not (tmp_path / "n.safetensors").exists()


def test_half_the_size_is_said(explored, tmp_path):
    path = tmp_path / "m.safetensors"
    assert share.main([str(explored), str(path), "--half"]) == 0
    assert "weights are rounded to float16" in path.with_suffix(".md").read_text()


def test_a_run_without_what_is_asked_is_an_error(explored, tmp_path, capsys):
    path = str(tmp_path / "m.safetensors")
    assert share.main([str(explored), path, "--seed", "7"]) == 2
    assert "--seed 7 is not valid; it must be one of 0." in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert share.main([str(explored), str(tmp_path / "file" / "m.safetensors")]) == 5
    assert f"cannot write {tmp_path / 'file'}" in capsys.readouterr().err


def test_the_card_never_takes_the_place_of_the_model(explored, tmp_path, capsys):
    assert share.main([str(explored), str(tmp_path / "m.md")]) == 2
    assert "m.md is where the card goes" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    (tmp_path / "n.md").mkdir()
    assert share.main([str(explored), str(tmp_path / "n.safetensors")]) == 5
    assert f"cannot write {tmp_path / 'n.md'}" in capsys.readouterr().err
    assert [x.name for x in tmp_path.iterdir()] == ["n.md"]


def test_a_zero_shot_without_a_log_is_not_in_the_card(explored, tmp_path, capsys):
    """As one that was stopped; where it is asked for, no model is written either."""
    run, path = tmp_path / "run", tmp_path / "m.safetensors"
    shutil.copytree(explored, run)
    (run / "zero-shot-003").mkdir()
    shutil.copy(run / "config.json", run / "zero-shot-003")
    flags = (str(run), str(path))
    assert share.main([*flags, "--returns", str(run / "zero-shot-003")]) == 2
    log = run / "zero-shot-003" / "metrics.jsonl"
    assert f"there is no {log}." in capsys.readouterr().err
    assert [x.name for x in tmp_path.iterdir()] == ["run"]
    assert share.main(flags) == 0
    said = path.with_suffix(".md").read_text()
    assert said.startswith("---") and "# m: a model of" in said
    assert 'load_model("m.safetensors")' in said and "not performed a task yet" in said
    assert {x.name for x in tmp_path.iterdir()} == {"run", path.name, "m.md"}


def test_a_card_is_of_the_model_that_is_shared(explored, tmp_path, capsys):
    """What performed after a refit, or from a policy on, is another matter."""
    run, path = tmp_path / "run", tmp_path / "m.safetensors"
    shutil.copytree(explored, run)
    config = json.loads((run / "config.json").read_text()) | {"phase": "zero-shot"}
    changes = {"a": {}, "b": {"refit": {"num_epochs": 9}}, "c": {"policy": "p"}}
    for i, (tag, change) in enumerate(changes.items()):
        folder = run / f"zero-shot-003-{tag}"
        folder.mkdir()
        refit = config["refit"] | change.get("refit", {"num_epochs": 0})
        own = config | change | {"refit": refit}
        (folder / "config.json").write_text(json.dumps(own))
        row = {
            "phase": "zero-shot", "arm": "epistemic", "seed": 0, "task": "forward",
            "trial": 1, "explored_trials": 3, "return": 100.0 + i,
        }  # fmt: skip
        (folder / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    assert share.main([str(run), str(path)]) == 0
    said = path.with_suffix(".md").read_text()
    assert "| forward | 100 " in said and "101" not in said and "102" not in said
    capsys.readouterr()
    learned = json.dumps(config | {"phase": "distill"})
    (run / "zero-shot-003-a" / "config.json").write_text(learned)
    assert share.main([str(run / "zero-shot-003-a"), str(path)]) == 2
    assert "is of distill; share an exploration, or a" in capsys.readouterr().err


def test_a_folder_is_no_file_of_a_model(explored, tmp_path, capsys):
    folder = tmp_path / "models"
    folder.mkdir()
    assert share.main([str(explored), str(folder)]) == 2
    assert f"{folder} is a folder; name a file in it." in capsys.readouterr().err
    assert [x.name for x in tmp_path.iterdir()] == ["models"]


def test_a_file_that_only_a_run_speaks_of_does_not_run(explored, tmp_path, capsys):
    """The run may be a stranger's."""
    run, file = tmp_path / "run", tmp_path / "robot.py"
    file.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    shutil.copytree(explored, run)
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"env": str(file)}))
    assert share.main([str(run), str(tmp_path / "m")]) == 2
    assert f"name it: --env {file}." in capsys.readouterr().err
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(not shipped.RESULTS.exists(), reason="not in this copy of the code")
@pytest.mark.parametrize("name", models.names())
def test_a_card_that_comes_along_is_what_the_logs_say(name):
    assert models.path(name).with_suffix(".md").read_text() == shipped.text(name)
