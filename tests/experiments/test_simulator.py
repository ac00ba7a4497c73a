"""Performing with the simulator as the model: what a search can reach."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.tools import simulator
from jaxpets.envs.half_cheetah import TASK_NAMES

TINY = (
    "--task-planner.horizon", "10", "--task-planner.num-samples", "24",
    "--task-planner.num-elites", "4", "--task-planner.num-iterations", "2",
)  # fmt: skip


def test_it_searches_as_the_shipped_models_do():
    assert simulator.Arguments().task_planner.optimizer == "icem"


def test_a_task_that_there_is_not_is_refused(capsys):
    assert simulator.main(["--task", "forward,swim"]) == 2
    assert "--task forward,swim is not valid; it must be all" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--num-trials", "0"), 2, "--num-trials 0 is not valid; it must be 1 to"),
        (("--trial-length", "-3"), 2, "--trial-length -3 is not valid"),
        (("--task-planner.horizon", "0"), 2, "--task-planner.horizon 0 is not valid"),
        (("--task-planner.num-elites", "999"), 2, "--task-planner.num-elites 999"),
        (("--json", "file/rows.jsonl"), 5, "cannot write file/rows.jsonl"),
        (("--json", "folder"), 5, "folder is a link, or no file"),
    ],
)
def test_what_cannot_be_is_refused_before_it_performs(
    words, code, said, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(simulator, "perform", None)
    Path("file").touch()
    Path("folder").mkdir()
    assert simulator.main(words) == code
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_one_task_is_performed_as_among_all(capsys):
    """Keys are those of trials, not of tasks."""
    common = ("--trial-length", "5", *TINY)
    simulator.main(common)
    line = capsys.readouterr().out.splitlines()[2]
    simulator.main(["--task", TASK_NAMES[2], *common])
    assert capsys.readouterr().out.splitlines() == [line]


@pytest.mark.slow
def test_every_task_is_performed_and_logged(tmp_path, capsys):
    """Even a search this small knows what comes next: no task goes backwards."""
    path = tmp_path / "rows.jsonl"
    simulator.main(
        ["--num-trials", "2", "--trial-length", "30", "--json", str(path), *TINY]
    )
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(TASK_NAMES)
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert [(row["task"], row["trial"]) for row in rows] == [
        (task, trial) for task in TASK_NAMES for trial in (1, 2)
    ]
    returns = np.array([row["return"] for row in rows]).reshape(4, 2)
    assert np.isfinite(returns).all()
    assert (returns.mean(1) > 0).all()
    assert (returns[:, 0] != returns[:, 1]).all()
    assert rows[0]["task_planner"]["horizon"] == 10
    assert all(row["date"] and row["env"]["device_kind"] == "cpu" for row in rows)
    assert {row["robot"] for row in rows} == {"pets/half_cheetah"}
