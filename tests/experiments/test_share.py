"""A run's model as one file: what comes with the library is what performed."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

import jaxpets
from experiments import cli, exploration
from experiments.build import build
from experiments.storage.folder import RunFolder
from experiments.tools import card, share
from jaxpets import models


@pytest.mark.skipif(not cli.PRETRAINED.exists(), reason="not in this copy of the code")
def test_the_shipped_model_acts_as_its_run(tmp_path, monkeypatch):
    built = []

    def build_without_kernels(config):
        slow = {
            name: dataclasses.replace(getattr(config, name), fused=False)
            for name in ("planner", "task_planner")
        }
        built.append(build(dataclasses.replace(config, **slow)))
        return built[0]

    monkeypatch.setattr(exploration, "build", build_without_kernels)
    source, path = cli.PRETRAINED / "best", tmp_path / "best.safetensors"
    assert share.main([str(source), str(path)]) == 0
    said = path.with_suffix(".md").read_text()
    assert "60 trials of 1,000 steps" in said and "not performed a task yet" in said
    model, params = jaxpets.load_model(path)
    shipped, same = jaxpets.pretrained("best")
    jax.tree.map(np.testing.assert_array_equal, params, same)
    assert (model.config, models.about(path)) == (
        shipped.config,
        models.about(models.path("best")),
    )
    config = exploration.config_of(RunFolder(source))
    found = models.about(path)["search"]
    settings = found["settings"]
    assert {k: getattr(config.task_planner, k) for k in settings} == settings
    # The run's own model and its file, from where the cheetah starts.
    (parts,) = built
    template = exploration.model_of(exploration.template(config, parts))
    _, state = RunFolder(source).restore(template)
    weights = jax.tree.map(lambda x: x[0], state.params)
    obs, action = np.zeros((5, 1, 18), np.float32), np.ones((1, 6), np.float32)
    want = jax.jit(parts.model.predict)(weights, obs, action)
    got = jax.jit(model.predict)(params, obs, action)
    jax.tree.map(np.testing.assert_array_equal, got, want)


def test_a_run_without_what_is_asked_is_an_error(tmp_path, capsys):
    source = str(cli.PRETRAINED / "best")
    assert share.main([source, str(tmp_path / "m"), "--seed", "7"]) == 2
    assert "--seed 7 is not valid; it must be one of 1." in capsys.readouterr().err


def test_a_file_that_only_a_run_speaks_of_does_not_run(tmp_path, capsys):
    """The run may be a stranger's."""
    run, file = tmp_path / "run", tmp_path / "robot.py"
    file.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    shutil.copytree(cli.PRETRAINED / "best", run)
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"env": str(file)}))
    assert share.main([str(run), str(tmp_path / "m")]) == 2
    assert f"name it: --env {file}." in capsys.readouterr().err
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(not cli.PRETRAINED.exists(), reason="not in this copy of the code")
@pytest.mark.parametrize("name", models.names())
def test_a_card_that_comes_along_is_what_the_logs_say(name):
    assert models.path(name).with_suffix(".md").read_text() == card.shipped(name)
