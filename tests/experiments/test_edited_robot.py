"""A robot of the user's that becomes another one between two commands."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import own_robot
import pytest
from test_own_robot import TINY

from experiments import robots
from experiments.run import main
from experiments.storage import rundir
from experiments.tools import model_error, share

EXPLORE = ("explore", "--env", "bug.py", *TINY, "--out", "out")
RUN = Path("out/smoke-bug-epistemic")
LATER = ("--from", str(RUN), "--env", "bug.py")
ROBOT = """
from jaxpets.envs import mujoco_robot

def robot(backend):
    return mujoco_robot(
        "cart", "cart.xml", lambda entry: {"fast": lambda c, o, a, n: n[..., 1]},
        observe=("qpos/x", "qvel/x", "qpos/turn", "qvel/turn"), backend=backend,
    )
"""
SWAPPED = ('"qpos/x", "qvel/x"', '"qvel/x", "qpos/x"')
OTHER = ('"qvel/x"', '"mean_qvel/x"')


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explored")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("bug.py").write_text(ROBOT)
        Path("cart.xml").write_text(own_robot.XML)
        assert main(EXPLORE) == 0
    return folder


@pytest.fixture
def here(explored, tmp_path, monkeypatch):
    """Stands beside a copy of the robot and of its exploration."""
    monkeypatch.chdir(shutil.copytree(explored, tmp_path / "here"))
    robots.named.cache_clear()


def edit(name, old, new):
    """Edits a file as a user does, who starts another process then."""
    text = Path(name).read_text()
    assert old in text
    Path(name).write_text(text.replace(old, new))
    robots.named.cache_clear()


@pytest.mark.parametrize(
    ("edited", "words"),
    [
        (
            SWAPPED,
            "the order differs: entry 0 is qpos/x in the run, qvel/x in the robot.",
        ),
        (OTHER, "only the run has qvel/x, only the robot has mean_qvel/x."),
    ],
)
def test_a_robot_that_observes_something_else_is_refused(here, capsys, edited, words):
    edit("bug.py", *edited)
    files = (rundir.STATUS, rundir.METRICS, rundir.CONFIG, rundir.IDENTITY)
    before = [(RUN / name).read_text() for name in files]
    for command in (
        (*EXPLORE, "--num-trials", "3"),
        *((phase, *LATER) for phase in ("zero-shot", "finetune", "distill")),
    ):
        assert main(command) == 3
        said = capsys.readouterr().err.splitlines()[-1]
        assert f"{RUN.name} was started with another robot than --env bug.py is" in said
        assert words in said
    assert [(RUN / name).read_text() for name in files] == before
    assert not list(RUN.glob("*/" + rundir.CONFIG))


def test_a_model_is_not_read_with_another_robot(here, capsys):
    """The file of a model would say entries that it has not learned."""
    edit("bug.py", *SWAPPED)
    assert share.main([str(RUN), "m.safetensors", "--env", "bug.py"]) == 3
    assert model_error.main([str(RUN), "--env", "bug.py", "--out", "e.json"]) == 3
    for line in capsys.readouterr().err.splitlines():
        assert f"{RUN} was started with another robot than --env bug.py is now" in line
    assert not Path("m.safetensors").exists() and not Path("e.json").exists()


def test_a_later_phase_goes_on_with_the_robot_that_it_began_with(here, capsys):
    """Where the exploration is of a version that did not keep what it observed."""
    own = json.loads((RUN / rundir.IDENTITY).read_text())
    assert own.pop("entries") == ["qpos/x", "qvel/x", "qpos/turn", "qvel/turn"]
    (RUN / rundir.IDENTITY).write_text(json.dumps(own))
    assert main(["zero-shot", *LATER]) == 0
    edit("bug.py", *SWAPPED)
    assert main(["zero-shot", *LATER]) == 3
    assert "zero-shot-002 was started with another robot" in capsys.readouterr().err
    assert main(["zero-shot", *LATER, "--tag", "other"]) == 0


@pytest.mark.parametrize(
    ("edited", "what"),
    [
        (("cart.xml", 'mass="1"', 'mass="1.5"'), ["the compiled robot"]),
        (("cart.xml", 'range="-2 2"', 'range="-2 3"'), ["the compiled robot"]),
        (
            ("bug.py", "backend=backend", "backend=backend, control_step=0.1"),
            ["the content of bug.py", "the compiled robot"],
        ),
        # A new task is no new robot: only a folder that knows the old file tells it.
        (("bug.py", "n[..., 1]", "n[..., 3]"), ["the content of bug.py"]),
    ],
)
def test_a_robot_that_is_compiled_to_another_is_told(here, capsys, edited, what):
    assert main(["zero-shot", *LATER, "--tag", "before"]) == 0
    assert main([*EXPLORE, "--num-trials", "3"]) == 0
    assert "warning" not in capsys.readouterr().err
    edit(*edited)
    for command in (
        ("zero-shot", *LATER),  # new, so that only the exploration knows of the other
        ("zero-shot", *LATER, "--at-trial", "2", "--tag", "before"),
        (*EXPLORE, "--num-trials", "4"),
    ):
        assert main(command) == 0
        said = capsys.readouterr().err.splitlines()
        lines = [x for x in said if "warning" in x]
        wanted = what
        if command == ("zero-shot", *LATER):
            wanted = [x for x in what if "robot" in x]
        for line, start in zip(lines, wanted, strict=True):
            assert line.startswith(f"warning: {start} was ")


def test_a_compiled_model_is_the_same_in_every_process(here):
    """Its bytes hold nothing of the process that compiled it."""
    known = json.loads((RUN / rundir.ENVIRONMENT).read_text())
    code = (
        "from experiments import robots, config; "
        "print(robots.digests(config.Config(env='bug.py', engine='mujoco')))"
    )
    place = {**os.environ, "PYTHONPATH": str(Path(robots.__file__).parents[1])}
    for seed in "12":
        place["PYTHONHASHSEED"] = seed
        line = [sys.executable, "-c", code]
        said = subprocess.run(line, env=place, capture_output=True, check=True)
        name = "the compiled robot"
        assert said.stdout.decode().strip() == str({name: known[name]})
