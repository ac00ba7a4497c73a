"""Models that come with the code: what is shipped, and that it acts as its run does."""

import json
import shutil
import time
from pathlib import Path

import chex
import jax
import numpy as np
import pytest
import runs

from experiments import cli, exploration
from experiments.build import build
from experiments.config import Config
from experiments.errors import UsageError
from experiments.presets import PRESETS
from experiments.run import main
from experiments.storage import checkpoint
from experiments.storage.folder import RunFolder
from experiments.tools import pretrained

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


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "PRETRAINED", tmp_path / "shelf")
    return tmp_path / "shelf"


def zero_shot(source, out):
    return main(
        ["--phase", "zero-shot", "--from", str(source), "--out", str(out), *SMALL]
    )


def returns(folder):
    (row,) = runs.rows(folder / "zero-shot-003-front-flip")
    return row["returns"]


def test_a_shipped_model_acts_as_its_run(explored, shelf, tmp_path, capsys):
    assert pretrained.main([str(explored), "mine"]) == 0
    folder = shelf / "mine"
    assert capsys.readouterr().out == f"wrote {folder}\n"
    assert checkpoint.steps(folder / "checkpoints") == [3]
    meta = json.loads((folder / "checkpoints/3/meta/metadata").read_text())
    assert all(name.startswith("params/") for name in meta["leaves"])
    assert (folder / "metrics.jsonl").read_text() == (
        explored / "metrics.jsonl"
    ).read_text()

    assert zero_shot("pretrained/mine", tmp_path / "out") == 0
    # Nothing is written beside the model.
    assert not list(folder.glob("zero-shot*"))
    want = returns(explored)
    assert returns(tmp_path / "out" / "pretrained-mine") == want
    assert all(np.isfinite(list(want.values())))


def test_a_shipped_model_says_how_it_came_to_be(explored, shelf):
    pretrained.ship(explored, "mine")
    performed = explored / "zero-shot-003-front-flip"
    for file in ("config.json", "env.json"):
        kept = shelf / "mine" / f"performed-{file}"
        assert kept.read_bytes() == (performed / file).read_bytes()


def test_only_the_model_is_there(explored, shelf, tmp_path, capsys):
    pretrained.main([str(explored), "mine"])
    for flags, words in (
        (
            ["--phase", "finetune"],
            "--phase finetune is not valid; it must be zero-shot",
        ),
        (["--phase", "zero-shot", *runs.REFIT], "--refit.num-epochs 1 is not valid"),
    ):
        command = [*flags, "--from", "pretrained/mine", *SMALL]
        assert main([*command, "--out", str(tmp_path)]) == 2
        assert words in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_another_attempt_is_not_what_is_shipped(explored, shelf, tmp_path):
    run = tmp_path / runs.NAME
    shutil.copytree(explored, run)
    pretrained.ship(run, "before")
    again = ["--phase", "zero-shot", "--from", str(run), *SMALL, "--tag", "xs"]
    assert main(again) == 0  # without a refit
    pretrained.ship(run, "after")
    sums = [
        (shelf / name / "checkpoints/3/meta/metadata").read_text()
        for name in ("before", "after")
    ]
    assert sums[0] == sums[1]


def test_a_name_is_taken_once(explored, shelf, capsys):
    assert pretrained.main([str(explored), "mine"]) == 0
    assert pretrained.main([str(explored), "mine"]) == 2
    line = f"error: there is a model in {shelf / 'mine'} already; remove it first.\n"
    assert capsys.readouterr().err == line


def test_only_a_model_that_performed_is_shipped(explored, shelf, tmp_path, capsys):
    idle = tmp_path / runs.NAME
    shutil.copytree(explored, idle, ignore=shutil.ignore_patterns("zero-shot*"))
    assert pretrained.main([str(idle), "mine"]) == 2
    line = f"error: {idle} has not performed; run --phase zero-shot first.\n"
    assert capsys.readouterr().err == line
    assert not shelf.exists()


def test_an_unknown_name_is_an_error(shelf, tmp_path, capsys):
    assert zero_shot("pretrained/other", tmp_path) == 3
    assert f"no exploration run in {shelf / 'other'}" in capsys.readouterr().err


def test_a_folder_called_pretrained_comes_first(explored, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pretrained").symlink_to(explored)
    for name, folder in (("", explored), ("/x", cli.PRETRAINED / "x")):
        config = Config(source=Path(f"pretrained{name}"))
        assert cli.explored_run(config) == folder.resolve()


@pytest.mark.skipif(not cli.PRETRAINED.exists(), reason="not in this copy of the code")
def test_what_is_shipped_can_be_read(tmp_path):
    names = [folder.name for folder in cli.PRETRAINED.iterdir()]
    assert "epistemic" in names
    for name in names:
        folder = cli.PRETRAINED / name
        command = ["--phase", "zero-shot", "--from", f"pretrained/{name}", *SMALL]
        assert main([*command, "--out", str(tmp_path)]) == 0
        size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
        assert size < 4e6


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
