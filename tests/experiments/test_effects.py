"""Arms and variants of a study: one score, what is beside it, what each part brings."""

import json
import runpy
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from small_logs import write_run

from experiments.report import stats, tables
from experiments.storage.archive import unpack
from experiments.tools import effects
from jaxpets.envs import half_cheetah as cheetah

LENGTH = 20
TASKS = Path(effects.__file__).parents[1] / "sweeps/half_cheetah_tasks.py"
RESULTS = Path(__file__).parents[2] / "results"
STUDY = RESULTS / "study"


def performed(folder, arm, tag, returns, upright=10.0):
    """A run whose seeds 0, 1, ... returned these, by task; it planned twice as much."""
    rows = [
        {"phase": "zero-shot", "arm": arm, "explored_trials": 60, "seed": seed,
         "task": task, "trial": 1, "return": value, "value": 2 * value / LENGTH,
         "returns": {task: value, "upright": upright}}
        for task, values in returns.items()
        for seed, value in enumerate(values)
    ]  # fmt: skip
    config = {"phase": "zero-shot", "arm": arm, "task_length": LENGTH}
    write_run(folder / arm / f"zero-shot-060-{tag}", rows, tag=tag, **config)


@pytest.fixture
def runs(tmp_path):
    folder = tmp_path / "runs"
    performed(folder, "best", "cem", {"forward": [20, 40], "jump": [10, 10]})
    performed(folder, "best", "icem", {"forward": [40, 60], "jump": [20, 20]})
    performed(folder, "best", "refit-icem", {"forward": [80, 80], "jump": [30, 50]})
    performed(folder, "random", "icem", {"forward": [10, 30], "jump": [0, 0]}, 20.0)
    return folder


@pytest.fixture
def ceilings(tmp_path):
    path = tmp_path / "simulator.jsonl"
    rows = [{"task": "forward", "return": x, "steps": 10} for x in (40, 60)]
    rows += [{"task": "jump", "return": 20, "steps": 10}]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_a_score_is_a_share_of_what_the_simulator_reaches(runs, ceilings, tmp_path):
    path = tmp_path / "effects.json"
    flags = ["--ceilings", str(ceilings), "--json", str(path)]
    assert effects.main([str(runs), *flags]) == 0
    found = json.loads(path.read_text())
    forward = found["icem"]["best"]["forward"]
    # The simulator has 5 a step, so 100 in 20 steps.
    assert forward["score"] == {"0": 0.4, "1": 0.6}
    assert forward["seeds"] == {"0": 40, "1": 60} and forward["steps"] == 600
    assert forward["kept"] == 0.5 and forward["upright"] == 0.5
    assert found["icem"]["random"]["jump"]["kept"] is None  # it planned nothing


def test_scores_are_shown_by_arm_and_variant(runs, ceilings, capsys):
    assert effects.main([str(runs), "--ceilings", str(ceilings)]) == 0
    shown = sections(capsys.readouterr().out)
    papers, others = shown["known tasks"], shown["other tasks"]
    assert papers[0] == "| arm | cem | icem | refit-icem |"
    # IQM of what two seeds have of 5 and 2 a step.
    best = "0.30 [0.20, 0.40] | 0.50 [0.40, 0.60] | 0.80 [0.80, 0.80]"
    assert f"| `best` | {best} |" in papers
    assert "| `random` | - | 0.20 [0.10, 0.30] | - |" in papers
    best = "0.25 [0.25, 0.25] | 0.50 [0.50, 0.50] | 1.00 [0.75, 1.25]"
    assert f"| `best` | {best} |" in others
    beside = shown["share of upright steps, and return over the value of the plans"]
    assert "| `random` | - | 1.00, 0.50 | - |" in beside


def test_arms_are_compared_with_one_of_them(runs, ceilings, capsys):
    def shown(*flags):
        flags = ["--ceilings", str(ceilings), *flags]
        assert effects.main([str(runs), *flags]) == 0
        return sections(capsys.readouterr().out)

    # 10 and 30 % less 40 and 60 %: Welch's interval of four numbers.
    less = shown()["known tasks, less `best`, %"]
    assert "| `random` | - | -30.0 [-90.8, 30.8] | - |" in less
    assert not any("`best`" in line for line in less)
    less = shown("--than", "random")["known tasks, less `random`, %"]
    assert "| `best` | - | 30.0 [-30.8, 90.8] | - |" in less


def test_which_tasks_were_known_can_be_said(runs, ceilings, capsys):
    flags = [str(runs), "--ceilings", str(ceilings), "--known"]
    assert effects.main([*flags, "jump"]) == 0
    shown = sections(capsys.readouterr().out)
    best = "0.25 [0.25, 0.25] | 0.50 [0.50, 0.50] | 1.00 [0.75, 1.25]"
    assert f"| `best` | {best} |" in shown["known tasks"]
    assert "| `random` | - | 0.20 [0.10, 0.30] | - |" in shown["other tasks"]
    assert effects.main([*flags, "jump,jum"]) == 2
    expected = "--known jump,jum is not valid; it must be some of forward,jump."
    assert expected in capsys.readouterr().err


def test_arms_of_a_second_folder_are_named_after_it(runs, ceilings, tmp_path, capsys):
    performed(tmp_path / "more", "best", "icem", {"forward": [50], "jump": [20]})
    flags = [str(tmp_path / "more"), "--ceilings", str(ceilings)]
    assert effects.main([str(runs), *flags]) == 0
    papers = sections(capsys.readouterr().out)["known tasks"]
    assert "| `best, more` | - | 0.50 [0.50, 0.50] | - |" in papers


def test_arms_of_folders_of_one_name_are_not_one_arm(runs, ceilings, tmp_path, capsys):
    a, b = tmp_path / "a" / "more", tmp_path / "b" / "more"
    performed(a, "best", "icem", {"forward": [50], "jump": [20]})
    performed(b, "best", "icem", {"forward": [10], "jump": [20]})
    flags = [str(a), str(b), "--ceilings", str(ceilings)]
    assert effects.main([str(runs), *flags]) == 0
    papers = sections(capsys.readouterr().out)["known tasks"]
    assert f"| `best, {a}` | - | 0.50 [0.50, 0.50] | - |" in papers
    assert f"| `best, {b}` | - | 0.10 [0.10, 0.10] | - |" in papers


def test_variants_are_compared_where_one_thing_differs(runs, ceilings, capsys):
    assert effects.main([str(runs), "--ceilings", str(ceilings)]) == 0
    pairs = sections(capsys.readouterr().out)["one variant less another, %"]
    assert pairs[0] == "| variant | less | `random` | `best` |"
    # By seed 0.45 and 0.55 less 0.225 and 0.325: the same for both, and so no chance.
    assert "| icem | cem | - | 22.5 [22.5, 22.5] |" in pairs
    assert [x.split(" | ")[:2] for x in pairs[3:]] == [["| refit-icem", "icem"]]


def sections(text):
    """The lines of every table, by its heading."""
    found = (part.splitlines() for part in text.split("## ")[1:])
    return {title: [x for x in lines if x] for title, *lines in found}


def test_what_cannot_be_read_is_said(runs, ceilings, tmp_path, capsys):
    def said(*flags):
        assert effects.main([str(runs), *map(str, flags)]) == 2
        return capsys.readouterr().err

    assert "nothing for jump" in said("--ceilings", _without(ceilings, "jump"))
    assert "no trials of the simulator" in said("--ceilings", tmp_path / "none")
    assert "no run has performed" in said("--ceilings", ceilings, "--explored", 5)
    ceilings.write_text('{"task": "jump", "return": 1, "steps": 0}')
    assert "Expected `int` >= 1" in said("--ceilings", ceilings)


def _without(path, task):
    lines = [line for line in path.read_text().splitlines() if task not in line]
    path.write_text("\n".join(lines))
    return path


def test_a_trial_whose_physics_diverged_is_no_ceiling(tmp_path):
    path = tmp_path / "simulator.jsonl"
    rows = [{"task": "jump", "return": x, "steps": 10} for x in (20, None)]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert effects.ceilings(path) == {"jump": 2.0}


@pytest.mark.parametrize(
    "results", sorted(RESULTS.glob("study*.json")), ids=lambda path: path.stem
)
def test_a_study_is_what_its_logs_say(results, tmp_path):
    of_robot = results.stem.removeprefix("study")
    names = [of_robot.strip("-")] if of_robot else _half_cheetahs()
    for name in names:
        unpack(STUDY / f"{name}.tar.xz", tmp_path)
    found = tmp_path / "found.json"
    kind = "most" if of_robot == "-quadruped" else "simulator"
    ceilings = f"{kind}{of_robot}.jsonl"
    flags = ["--ceilings", str(STUDY / ceilings), "--json", str(found)]
    assert effects.main([str(tmp_path), *flags]) == 0
    assert json.loads(found.read_text()) == json.loads(results.read_text())


def _half_cheetahs():
    others = {"stopped", "margin", "models", "walker", "quadruped"}
    return {path.name.removesuffix(".tar.xz") for path in STUDY.glob("*.xz")} - others


@pytest.mark.parametrize("robot", ["walker", "quadruped"])
def test_a_page_has_what_the_study_of_two_more_robots_found(robot):
    found = json.loads((RESULTS / f"study-{robot}.json").read_text())
    page = (RESULTS / "study-robots.md").read_text()
    known = ("stand", "walk", "run")[robot == "quadruped" :]
    shown = sections("\n".join(effects.report(found, "best", known)))
    for title in ("known tasks", "other tasks", "every task, refit-icem"):
        assert "\n".join(shown[title]) in page


def test_the_page_has_what_the_study_found():
    found = json.loads((RESULTS / "study.json").read_text())
    page = (RESULTS / "study.md").read_text()
    lines = effects.report(found, "best", tables.TASKS)
    shown = sections("\n".join(lines))
    place = 0
    for title, lines in shown.items():  # in the order in which they are printed
        if title not in _NOT_ON_THE_PAGE and not title.startswith("every task"):
            place = page.index("\n".join(lines), place) + 1
    assert "\n".join(shown["every task, refit-icem"]) in page
    rows = [line.strip("| ").split(" | ") for line in shown["other tasks"]]
    variants = rows[0]
    held_out = {row[0]: row for row in rows}
    front = (RESULTS.parent / "README.md").read_text()
    for words, variant in (
        ("CEM, no refit", "cem"),
        ("iCEM, after a refit", "refit-icem"),
    ):
        at = variants.index(variant)
        cells = [held_out[f"`{arm}`"][at] for arm in _ON_THE_FRONT]
        assert f"| {words} | {' | '.join(cells)} |" in front


def test_the_page_has_what_the_margin_brings(tmp_path, capsys):
    runs, margin = tmp_path / "runs", tmp_path / "study-margin"
    for name, folder in (("best", runs), ("margin", tmp_path)):
        unpack(STUDY / f"{name}.tar.xz", folder)
    flags = ["--ceilings", str(STUDY / "simulator.jsonl")]
    assert effects.main([str(runs), str(margin), *flags]) == 0
    shown = sections(capsys.readouterr().out)
    variants = shown["other tasks, less `best`, %"][0].strip("| ").split(" | ")
    at = variants.index("refit-icem")
    held_out, papers = (
        shown[f"{group}, less `best`, %"][-1].strip("| ").split(" | ")
        for group in ("other tasks", "known tasks")
    )
    assert held_out[0] == "`best, study-margin`" and held_out[at] == "-0.2 [-3.2, 2.8]"
    assert papers[at] == "1.1 [-4.1, 6.3]"
    means = [float(x.split()[0]) for x in (*held_out[1:], *papers[1:])]
    assert max(map(abs, means)) == 1.5
    page = (RESULTS / "study.md").read_text()
    assert "`best` scores 0.2 [-2.8, 3.2] less on held-out tasks" in page


_NOT_ON_THE_PAGE = (
    "known tasks, less `best`, %",
    "other tasks, less `best`, %",
    "share of upright steps, and return over the value of the plans",
)
_ON_THE_FRONT = ("best", "epistemic", "info-gain", "random")


def test_the_page_has_what_models_know_of_all_data():
    page = (RESULTS / "study.md").read_text()
    found = {
        name: json.loads((STUDY / f"{name}.json").read_text())
        for name in ("open_loop", "model_error")
    }
    assert found["open_loop"]["trials"] == found["model_error"]["trials"]
    for arm, by_step in found["open_loop"]["arms"].items():
        cells = [f"`{arm}`"]
        cells += [f"{by_step[step]['error']['mean']:.3f}" for step in ("1", "10", "30")]
        cells += [
            f"{by_step[step]['coverage']['mean']:.2f}" for step in ("1", "10", "30")
        ]
        nll = [x["mean"] for x in found["model_error"]["nll"][arm].values()]
        assert f"| {' | '.join(cells)} | {np.mean(nll):.2f} |" in page


def test_the_interval_of_an_iqm_draws_seeds_within_tasks():
    """Tasks that differ and seeds that do not: nothing is left to chance."""
    same = np.repeat([[0.0], [1.0], [2.0], [7.0]], 5, axis=1)
    assert stats.stratified_interval(same) == (1.5, 1.5)
    scores = np.random.default_rng(0).normal(size=(10, 10))
    low, high = stats.stratified_interval(scores)
    # About two standard errors of a mean of 100 to each side; an IQM has a tenth more.
    assert low < stats.iqm(scores.reshape(-1)) < high
    assert 0.3 < high - low < 0.6


@pytest.fixture(scope="module")
def tasks():
    return runpy.run_path(str(TASKS))["tasks"]()


@pytest.mark.parametrize(
    ("task", "entries"),
    [
        ("run-upright", {cheetah.FORWARD_VELOCITY: 5.0}),
        ("back-upright", {cheetah.FORWARD_VELOCITY: -5.0}),
        ("slow", {cheetah.FORWARD_VELOCITY: 2.0}),
        ("fast-back", {cheetah.FORWARD_VELOCITY: -4.0}),
        ("jump", {cheetah.HEIGHT: 0.6}),
        ("crouch", {cheetah.HEIGHT: -0.25}),
        ("on-back", {cheetah.PITCH: np.pi}),
        ("rear-up", {cheetah.PITCH: -np.pi / 2}),
        ("nose-stand", {cheetah.PITCH: np.pi / 2}),
        ("hind-walk", {cheetah.PITCH: -np.pi / 2, cheetah.FORWARD_VELOCITY: 1.0}),
        ("turn-a-second", {cheetah.PITCH_RATE: 2 * np.pi}),
        ("upright", {cheetah.PITCH: 2 * np.pi}),
    ],
)
def test_a_task_is_worth_most_where_it_is_done(tasks, task, entries):
    """More than in another posture; more than standing still, which is upright too."""

    def reward(entries):
        obs = jnp.zeros(cheetah.OBS_SIZE)
        for entry, value in entries.items():
            obs = obs.at[entry].set(value)
        actions = jnp.zeros(cheetah.ACTION_SIZE)
        return float(tasks[task](None, jnp.zeros_like(obs), actions, obs))

    done, on_its_side = reward(entries), reward({cheetah.PITCH: np.pi / 4})
    assert done >= 0.99
    assert done > on_its_side
    assert done > reward({}) or task == "upright"


def test_the_papers_tasks_are_those_of_the_robot(tasks):
    weights = cheetah.tasks()
    obs = jnp.linspace(-1.0, 2.0, cheetah.OBS_SIZE)
    action = jnp.linspace(-1.0, 1.0, cheetah.ACTION_SIZE)
    for i, name in enumerate(cheetah.TASK_NAMES):
        own = cheetah.TaskWeights(*(weight[i] for weight in weights))
        wanted = cheetah.task_reward(own, obs, action, obs)
        assert tasks[name](None, obs, action, obs) == pytest.approx(float(wanted))
