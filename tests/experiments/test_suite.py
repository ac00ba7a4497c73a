"""Twenty tasks of the suite beside others' numbers."""

import json
from pathlib import Path

import pytest
from small_logs import write_run

from experiments.storage import rundir
from experiments.storage.archive import unpack
from experiments.tools import peers as published
from experiments.tools import suite

PEERS_FILE = Path(__file__).parents[2] / published.FILE
OTHERS = ("opax", "plan2explore", "jensen-renyi")  # objectives that are not ours
PEERS = {
    "systems": [
        {"name": "Rival", "reward": True, "steps": [100_000, 500_000, 1_000_000],
         "source": "their page", "about": "It counts otherwise."}
    ],
    "returns": {"Rival": {name: [10, 20, 31] for name in suite.NAMES}},
}  # fmt: skip


def performed(folder, env, returns, tag=None, explored=4):
    """A run whose seeds 0, 1, ... returned these, by task, in two trials each."""
    rows = [
        {"phase": "zero-shot", "arm": "best", "explored_trials": explored,
         "seed": seed, "task": task, "trial": trial, "return": value + trial}
        for task, values in returns.items()
        for seed, value in enumerate(values)
        for trial in (-1, 1)
    ]  # fmt: skip
    name = f"zero-shot-004{f'-{tag}' if tag else ''}"
    config = {"phase": "zero-shot", "arm": "best", "env": env, "trial_length": 250}
    write_run(folder / name, rows, tag=tag, **config)


@pytest.fixture
def runs(tmp_path):
    folder = tmp_path / "runs"
    performed(folder / "cheetah", "dmc/cheetah", {"run": [500, 700], "jump": [1, 1]})
    performed(folder / "spin", "dmc/finger-spin", {"spin": [100, 300]})
    performed(folder / "spin", "dmc/finger-spin", {"spin": [0, 0]}, tag="actor")
    performed(folder / "other", "gym/Hopper-v5", {"run": [9, 9]})
    return folder


@pytest.fixture
def peers(tmp_path):
    path = tmp_path / "peers.json"
    path.write_text(json.dumps(PEERS))
    return str(path)


def test_results_are_of_the_tasks_that_others_have(runs, tmp_path, peers, capsys):
    path = tmp_path / "suite.json"
    flags = ["--explored", "4", "--peers", peers, "--json", str(path)]
    assert suite.main([str(runs), *flags]) == 0
    found = json.loads(path.read_text())["best"]
    assert set(found) == {"cheetah/run", "finger/spin"}
    run = found["cheetah/run"]
    assert run["seeds"] == {"0": 500, "1": 700} and run["mean"] == 600
    # 4 trials of 250 steps, of which each holds its action for four of the suite's.
    assert run["steps"] == 4000
    assert run["interval"] == pytest.approx([600 - 1270.6, 600 + 1270.6], abs=0.1)
    text = capsys.readouterr().out
    assert "| task | `best` | Rival, 0.1M | Rival, 1M |" in text
    assert "| cheetah/run | 600 [-671, 1871] | 10 | 31 |" in text
    assert "| walker/run | - | 10 | 31 |" in text
    # Of a seed's mean, 300 and 500: the interval is over seeds, not over tasks.
    assert "| **mean** | 400 [-871, 1671] (of 2) | 10 | 31 |" in text
    assert "| the 2 tasks that every arm has | 400 [-871, 1671] | 10 | 31 |" in text
    # One of the two is of a domain that settings were chosen on.
    assert "| domains that settings were chosen on | 600 [-671, 1871] (of 1) |" in text
    assert "| the other domains | 200 [-1071, 1471] (of 1) | 10 | 31 |" in text
    assert "- Rival (with the reward): their page. It counts otherwise." in text


def test_arms_are_compared_on_the_tasks_that_all_have(tmp_path, peers, capsys):
    def arm(**by_task):
        return {
            name.replace("_", "/"): suite.numbers(dict(enumerate(seeds)), 4000)
            for name, seeds in by_task.items()
        }

    path = tmp_path / "results.json"
    found = {
        "best": arm(cheetah_run=[500, 700], finger_spin=[300, 300], hopper_hop=[9, 9]),
        "random": arm(cheetah_run=[100, 100, 100], finger_spin=[0, 150, 300]),
        "opax": arm(cheetah_run=[300], finger_spin=[0, 100], walker_run=[9]),
    }
    path.write_text(json.dumps(found))
    flags = [str(path), "--peers", peers]
    assert suite.main([*flags, "--than", "random"]) == 0
    text = capsys.readouterr().out
    # Of hop, which one arm has, nothing is in these means.
    assert "| the 2 tasks that every arm has | 125 [-61, 311] | 450 [-185," in text
    _, text = text.split("| task | `random` | `best` less `random` | `opax` less ")
    assert "| cheetah/run | 100 [100, 100] | 500 [-771, 1771] | 200 |" in text
    assert "hopper/hop" not in text and "walker/run" not in text
    # Seeds' means are 400 and 500 for best, and 50, 125 and 200 for random: an error
    # of 66 and 2.4 degrees of freedom. Of opax they are unknown: its tasks have other
    # seeds.
    assert "| **mean** (of 2) | 125 [-61, 311] | 325 [81, 569] | - |" in text
    assert "| the other domains (of 1) | 150 [-223, 523] | 150 [-223, 523] |" in text
    assert suite.main([*flags, "--than", "oracle"]) == 2
    assert "oracle: it is none of best, random, opax" in capsys.readouterr().err


def test_what_is_not_finite_is_said(tmp_path, peers, capsys):
    """By what was read from logs as by the file of it."""
    nan = float("nan")
    tasks = {
        "cheetah/run": {0: 500.0, 1: 700.0, 2: nan},
        "finger/spin": {0: 100.0, 1: 300.0, 2: nan},
        "hopper/hop": {0: nan, 1: 9.0, 2: 9.0},
        "walker/run": {0: nan, 1: nan, 2: nan},
    }
    all_of = {name: suite.numbers(seeds, 4000) for name, seeds in tasks.items()}
    whole = {name: all_of[name] for name in ("cheetah/run", "finger/spin")}
    uneven = whole | {"hopper/hop": all_of["hopper/hop"]}
    path, figure = tmp_path / "results.json", tmp_path / "tasks.svg"
    for own, mean in (
        (whole, "400 [-871, 1671] (of 2)"),  # of the seeds 0 and 1
        (uneven, "270 (of 3)"),  # whose seeds are not the same
        (all_of, "not finite (of 4)"),
    ):
        rundir.write_json(path, {"best": own, "random": own})
        flags = [str(path), "--peers", peers, "--figure", str(figure)]
        assert suite.main([*flags, "--than", "random"]) == 0
        text = capsys.readouterr().out
        assert f"| **mean** | {mean} | {mean} |" in text and "nan" not in text
        for found in ({"best": own}, suite.read(path)):
            assert suite._mean(found["best"], suite.NAMES) == mean
    assert "| walker/run | not finite | - |" in text
    assert suite._less(all_of, all_of, ["cheetah/run"]).startswith("0 [")


def test_a_variant_is_asked_for(runs, tmp_path, peers, capsys):
    flags = ["--explored", "4", "--peers", peers, "--tag", "actor"]
    assert suite.main([str(runs), *flags]) == 0
    assert "| finger/spin | 0 [0, 0] | 10 | 31 |" in capsys.readouterr().out


def test_arms_of_more_folders_are_named_after_them(runs, tmp_path, peers, capsys):
    """Of each folder what explored most, unless it is said how many trials."""
    more, path = tmp_path / "more", tmp_path / "suite.json"
    performed(more / "early", "dmc/cheetah", {"run": [1, 1]}, explored=2)
    performed(more / "late", "dmc/cheetah", {"run": [900, 900]}, explored=8)
    flags = ["--peers", peers, "--json", str(path)]
    assert suite.main([str(runs), str(more), *flags, "--than", "best, more"]) == 0
    text = capsys.readouterr().out
    assert "| task | `best` | `best, more` | Rival, 0.1M | Rival, 1M |" in text
    assert "| cheetah/run | 900 [900, 900] | -300 [-1571, 971] |" in text
    found = json.loads(path.read_text())
    assert found["best, more"]["cheetah/run"]["steps"] == 8000
    assert suite.main([str(path), str(more), "--explored", "2", "--peers", peers]) == 0
    assert "| cheetah/run | 600 [-671, 1871] | 1 [1, 1] |" in capsys.readouterr().out


def test_folders_of_one_name_are_told_apart_by_their_paths(
    runs, tmp_path, peers, capsys, monkeypatch
):
    """What two folders have is never shown as one of them, nor left out."""
    monkeypatch.chdir(tmp_path)
    for folder, value in (("a", 1), ("b", 900)):
        performed(Path(folder, "more.v2"), "dmc/cheetah", {"run": [value] * 2})
    assert suite.main([str(runs), "a/more.v2", "b/more.v2", "--peers", peers]) == 0
    text = capsys.readouterr().out
    assert "| task | `best` | `best, a/more.v2` | `best, b/more.v2` |" in text
    assert "| cheetah/run | 600 [-671, 1871] | 1 [1, 1] | 900 [900, 900] |" in text
    monkeypatch.chdir("a/more.v2")
    assert suite.main([str(runs), ".", "--peers", peers]) == 0
    assert "| `best` | `best, more.v2` |" in capsys.readouterr().out
    assert suite.main([str(runs), ".", ".", "--peers", peers]) == 2
    assert "given twice" in capsys.readouterr().err


def test_what_cannot_be_read_is_said(runs, tmp_path, peers, capsys):
    assert suite.main([str(tmp_path / "none"), "--peers", peers]) == 2
    assert "there is no metrics.jsonl" in capsys.readouterr().err
    path = tmp_path / "peers.json"
    path.write_text("{}")
    assert suite.main([str(runs), "--explored", "4", "--peers", peers]) == 2
    assert f"{path} has no numbers of others" in capsys.readouterr().err


def test_a_file_of_results_is_not_replaced_by_nothing(runs, tmp_path, peers, capsys):
    path = tmp_path / "suite.json"
    path.write_text("kept")
    flags = ["--peers", peers, "--json", str(path)]
    for other in (["--tag", "acter"], ["--explored", "5"], ["--figure", "x.xyz"]):
        assert suite.main([str(runs), *flags, *other]) == 2
    said = capsys.readouterr().err
    assert "has performed tasks of the suite as variant acter." in said
    assert "after 5 trials." in said and "must end in .png, .svg" in said
    assert path.read_text() == "kept"


def test_the_committed_numbers_of_others_are_of_every_task():
    peers = published.read(PEERS_FILE)
    assert {x.name for x in peers.systems} == set(peers.returns)
    for system in peers.systems:
        returns = peers.returns[system.name]
        assert set(returns) == set(suite.NAMES)
        assert all(len(x) == len(system.steps) for x in returns.values())


def test_committed_results_are_those_of_the_committed_logs(tmp_path, capsys):
    results = Path(__file__).parents[2] / "results"
    for arm in ("best", "epistemic", "random", *OTHERS):
        unpack(results / "dmc20" / f"{arm}.tar.xz", tmp_path)
    found = suite.results(tmp_path, 100, "")
    assert found == json.loads((results / "dmc20.json").read_text())
    assert suite.main([str(results / "dmc20.json"), "--peers", str(PEERS_FILE)]) == 0
    page = (results / "dmc20.md").read_text()
    front = (results.parent / "README.md").read_text()
    for line in capsys.readouterr().out.splitlines():
        summary = line.startswith(("| **mean**", "| the other domains"))
        if summary or line.startswith(tuple(f"| {name}" for name in suite.NAMES)):
            task, epistemic, random, best, renyi, opax, control, *others = _cells(line)
            own = [task, best, epistemic, control, opax, renyi, random]
            assert " | ".join([*own, *others[:4]]) in page
        if summary:
            own = [best, epistemic, control, random]
            assert " | ".join([*own, *others[:3]]) in front


def test_committed_steps_are_those_of_the_committed_logs(tmp_path, capsys):
    results = Path(__file__).parents[2] / "results"
    unpack(results / "dmc20" / "steps.tar.xz", tmp_path)
    path = results / "dmc20" / "steps.json"
    found = {"best": json.loads((results / "dmc20.json").read_text())["best"]}
    for name in ("dmc20-50k", "dmc20-200k", "dmc20-500k"):
        found[f"best, {name}"] = suite.results(tmp_path / name, None, "")["best"]
    assert found == json.loads(path.read_text())
    flags = ["--peers", str(PEERS_FILE), "--than", "best, dmc20-50k"]
    assert suite.main([str(path), *flags]) == 0
    table, compared = capsys.readouterr().out.split("| task | `best, dmc20-50k` |")
    page = " ".join((results / "dmc20.md").read_text().split())
    for line in table.splitlines()[2:25]:
        task, best, early, *_ = _cells(line)
        late = found["best, dmc20-200k"].get(task)
        late = "" if late is None else suite.cell(late)
        assert f"| {task} | {early} | {best} | {late} |".replace("  |", " |") in page
    gains = {_cells(x)[0]: _cells(x)[-1] for x in compared.splitlines() if x}
    assert f"**Half of the steps lose {gains['**mean** (of 20)']}.**" in page
    for task in ("quadruped/walk", "quadruped/run", "cheetah/run", "walker/run"):
        assert f"`{task}` by {gains[task]}" in page
    for task, scores in found["best, dmc20-500k"].items():
        assert f"`{task.partition('/')[2]}` {suite.cell(scores)}" in page


@pytest.mark.parametrize("arm", OTHERS)
def test_the_page_compares_another_objective_with_ours(arm, capsys):
    results = Path(__file__).parents[2] / "results"
    flags = ["--peers", str(PEERS_FILE), "--than", arm]
    assert suite.main([str(results / "dmc20.json"), *flags]) == 0
    page = (results / "dmc20.md").read_text()
    _, compared = capsys.readouterr().out.split(f"| task | `{arm}` |")
    overall, chosen, others = (_cells(x) for x in compared.splitlines()[-4:] if x)
    # The table has the arm less `random`, and the tool what `random` is less the arm.
    epistemic, best = overall[2], overall[4]
    assert f"| `{arm}` | {best} | {epistemic} |" in page
    pairs = [f"{x}, {y}" for x, y in zip(chosen, others, strict=True)]
    assert f"where settings were chosen, elsewhere | {pairs[4]} | {pairs[2]} |" in page


def _cells(line: str) -> list[str]:
    return line.strip("| ").split(" | ")


def test_a_figure_is_of_the_file_of_results(tmp_path, peers):
    results = Path(__file__).parents[2] / "results" / "dmc20.json"
    figure = tmp_path / "tasks.svg"
    assert suite.main([str(results), "--peers", peers, "--figure", str(figure)]) == 0
    said = figure.read_text()
    assert all(f"<!-- {name} -->" in said for name in suite.NAMES)


@pytest.mark.parametrize("flags", [("--tag", "actor"), ("--explored", "3")])
def test_no_variant_is_asked_of_a_file_of_results(tmp_path, peers, capsys, flags):
    path = tmp_path / "results.json"
    path.write_text("{}")
    assert suite.main([str(path), "--peers", peers, *flags]) == 2
    assert f"{path} is a file of results" in capsys.readouterr().err


def test_a_file_that_has_no_results_is_refused(tmp_path, peers, capsys):
    path = tmp_path / "results.json"
    path.write_text('{"best": 3}')
    assert suite.main([str(path), "--peers", peers]) == 2
    assert f"{path} has no results" in capsys.readouterr().err
