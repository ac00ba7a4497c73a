"""Runs side by side: what differs in settings, on what they ran, and in returns."""

import json
from pathlib import Path

import pytest

from experiments import compare
from experiments.entries import to_json
from experiments.presets import PRESETS

TASKS = ("forward", "backward")


def run(out, name, returns, **changes):
    """Writes a run that has explored, and performed tasks with these returns."""
    config = to_json(PRESETS["smoke"]) | changes
    common = {"arm": config["arm"], "trial": 1, "value": 0.5}
    explored = [
        common
        | {"phase": "explore", "seed": seed, "returns": dict.fromkeys(TASKS, 1.0)}
        for seed in config["seeds"]
    ]
    performed = [
        common
        | {"phase": "zero-shot", "seed": seed, "task": task, "explored_trials": 1}
        | {"returns": {task: value}, "return": value}
        for seed, value in zip(config["seeds"], returns, strict=True)
        for task in TASKS
    ]
    for folder, phase, rows in (
        (out / name, "explore", explored),
        (out / name / "zero-shot-001", "zero-shot", performed),
    ):
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(json.dumps(config | {"phase": phase}))
        lines = [json.dumps(row) + "\n" for row in rows]
        (folder / "metrics.jsonl").write_text("".join(lines))
    return out / name


def said(capsys, *words):
    code = compare.main([*map(str, words)])
    return code, capsys.readouterr()


def test_what_differs_is_shown_and_no_more(tmp_path, capsys):
    planner = to_json(PRESETS["smoke"])["planner"] | {"horizon": 9}
    a = run(tmp_path, "a", (10.0, 20.0), seeds=[0, 1])
    b = run(tmp_path, "b", (50.0, 70.0), seeds=[2, 3], planner=planner)
    (a / "env.json").write_text(json.dumps({"jax": "1", "numpy": "2"}))
    (b / "env.json").write_text(json.dumps({"jax": "3", "numpy": "2"}))
    code, out = said(capsys, a, b, "--out", tmp_path / "c")
    assert code == 0
    rows = [line for line in out.out.splitlines() if line.startswith("| `")]
    assert rows == [
        "| `seeds` | [0, 1] | [2, 3] |",
        "| `planner.horizon` | 3 | 9 |",
        "| `jax` | 1 | 3 |",
    ]
    assert "| task | a (1 trials) | b (1 trials) |" in out.out
    # Means of 15 and 60; 45 apart, Welch's interval of two and two seeds.
    assert "| forward | 15 ± 7.1 [-49, 79] | 60 ± 14 [-67, 187] |" in out.out
    assert "| b | a | 45 [" in out.out
    page = tmp_path / "c" / "compare.md"
    assert page.read_text().replace("<br>", " ") == out.out.removesuffix("\n")
    assert (tmp_path / "c" / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_runs_of_one_name_are_told_apart(tmp_path, capsys):
    a, b = (run(tmp_path / x, "same", (1.0,)) for x in "ab")
    code, out = said(capsys, a, b, "--out", tmp_path / "c")
    assert code == 0 and f"| task | {a} (1 trials) | {b} (1 trials) |" in out.out


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("a",), "two runs or more"),
        (("a", "a"), "two runs or more"),
        (("a", "none"), "none is no folder"),
        (("a", "empty"), "no metrics.jsonl"),
    ],
)
def test_what_cannot_be_compared_is_one_line(tmp_path, capsys, names, words):
    run(tmp_path, "a", (1.0,))
    (tmp_path / "empty").mkdir()
    code, out = said(capsys, *(tmp_path / name for name in names))
    assert code == 2 and words in out.err and out.err.count("\n") == 1
    assert not Path("runs/compare").exists()


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, capsys):
    run(tmp_path, "a", (1.0,))
    run(tmp_path, "b", (1.0,))
    (tmp_path / "file").touch()
    words = (tmp_path / "a", tmp_path / "b", "--out", tmp_path / "file" / "x")
    code, out = said(capsys, *words)
    assert code == 5 and out.err.startswith("error: cannot make ")
