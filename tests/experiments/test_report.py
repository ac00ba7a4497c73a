"""The report, from small logs whose every number is known."""

import json
import shutil

import numpy as np
import pytest
from small_logs import EXPLORED, explore_rows, report_in, write_run

from experiments.errors import CheckpointError, UsageError
from experiments.report import logs, report, task_sections
from experiments.report.report import load, write_report
from jaxpets.envs.half_cheetah import TASK_NAMES

# Zero-shot scores by seed; a task adds 10 times its place.
SCORES = {"epistemic": [400.0, 500.0, 900.0], "count": [100.0, 200.0, 150.0]}


def zero_shot_rows(arm, scores, explored=EXPLORED):
    """Two trials a seed, 7 above and below the score."""
    return [
        {
            "phase": "zero-shot",
            "arm": arm,
            "seed": seed,
            "task": task,
            "trial": trial,
            "explored_trials": explored,
            "return": score + 10.0 * i + (7.0 if trial == 1 else -7.0),
        }
        for seed, score in enumerate(scores)
        for i, task in enumerate(TASK_NAMES)
        for trial in (1, 2)
    ]


def finetune_rows(arm, seeds):
    return [
        {
            "phase": "finetune",
            "arm": arm,
            "seed": seed,
            "task": task,
            "trial": EXPLORED + k,
            "explored_trials": EXPLORED,
            "return": 1000.0 * k + seed,
        }
        for seed in seeds
        for task in TASK_NAMES
        for k in (1, 2)
    ]


def write_arm(out, arm, scores, **config):
    run = out / f"{config.get('preset', 'laptop')}-{arm}"
    common = {"arm": arm, "num_trials": EXPLORED, **config}
    seeds = range(len(scores))
    write_run(run, explore_rows(arm, seeds), phase="explore", **common)
    zero_shot = run / f"zero-shot-{EXPLORED:03d}"
    write_run(zero_shot, zero_shot_rows(arm, scores), phase="zero-shot", **common)
    return run


def write_out(out):
    for arm, scores in SCORES.items():
        run = write_arm(out, arm, scores)
    write_run(
        run / f"finetune-{EXPLORED:03d}",
        finetune_rows("count", range(2)),
        phase="finetune",
        arm="count",
    )
    return out


@pytest.fixture
def out(tmp_path):
    return write_out(tmp_path / "runs")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """What is reported of `out`, before a test changes it."""
    return report_of(write_out(tmp_path_factory.mktemp("plain") / "runs"))


def report_of(out):
    _, text = report_in(out)
    return text, json.loads((out / "report" / "table1.json").read_text())


def edit_rows(log, change):
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    rows = [change(row) or row for row in rows]
    log.write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_table_1_json_holds_the_scores_of_every_seed(plain):
    _, table = plain
    assert list(table) == ["epistemic", "count-16"]
    for arm, scores in SCORES.items():
        by_task = table["count-16" if arm == "count" else arm]
        assert tuple(by_task) == TASK_NAMES
        for i, task in enumerate(TASK_NAMES):
            entry = by_task[task]
            assert set(entry) == {"seeds", "mean", "iqm", "ci95"}
            np.testing.assert_allclose(entry["seeds"], np.array(scores) + 10.0 * i)
            assert entry["mean"] == pytest.approx(np.mean(scores) + 10.0 * i)
            assert entry["iqm"] == pytest.approx(entry["mean"])  # fewer than 4 seeds
            low, high = entry["ci95"]
            assert low < entry["mean"] < high


def test_report_shows_means_spread_and_every_seed(plain):
    text, _ = plain
    # 400, 500, 900: mean 600, standard deviation sqrt(70000).
    assert "| forward | 600 ± 265<br>[" in text
    assert "| count-16 | 2 | 150 | 160 | 170 | 180 |" in text
    assert "| P(epistemic > ...) | count-16 |" in text
    assert "| forward | 1.00 |" in text
    assert "paper: SU-PETS" not in text
    # Trials 4 and 5 of two seeds.
    assert "| 4 | 1000 ± 0.7 (2 seeds) |" in text
    assert "| 5 | 2000 ± 0.7 (2 seeds) |" in text
    assert "| laptop-epistemic | 3 | 3 | 4.00 | 1.00 | 5.00 |" in text
    assert "jax 9.9, device_kind abacus" in text
    # Trial 1 of 3 seeds, the same in both arms: -(1 + seed).
    assert "mean of 3 trials of 10 steps: forward -2.0" in text


def test_all_trials_of_the_random_arm_are_random(tmp_path):
    write_arm(tmp_path / "runs", "random", [1.0])
    text, _ = report_of(tmp_path / "runs")
    assert "mean of 3 trials of 10 steps: forward -2.0" in text  # -(trial + seed)


def test_noise_is_neither_a_plan_nor_a_random_trial(tmp_path, monkeypatch):
    """Its first trial is that of all arms; the others have turns, but no value."""
    write_arm(tmp_path / "runs", "pink-noise", [1.0])
    log = tmp_path / "runs" / "laptop-pink-noise" / "metrics.jsonl"
    log.write_text(log.read_text().replace('"plan"', '"noise"'))
    drawn, draw = [], report.figures.exploration

    def exploration(target, value, turns):
        drawn.append((list(value), list(turns)))
        draw(target, value, turns)

    monkeypatch.setattr(report.figures, "exploration", exploration)
    text, _ = report_of(tmp_path / "runs")
    assert drawn == [([], ["pink-noise"])]
    assert "mean of 1 trials of 10 steps: forward -1.0" in text


def test_a_variant_is_a_row_of_its_own(plain, out):
    scores = {"epistemic": [40.0, 50.0, 90.0]}
    rows = zero_shot_rows("epistemic", scores["epistemic"])
    before, table = plain
    folder = out / "laptop-epistemic" / "zero-shot-003-short"
    config = {"phase": "zero-shot", "arm": "epistemic", "tag": "short"}
    write_run(folder, rows, **config, task_planner={"horizon": 2})
    text, again = report_of(out)
    assert again == table and "## Variants" not in before
    assert "| short | epistemic | 3 |  | 0 1 2 | 60 ± 26<br>[" in text
    assert "| epistemic, short | epistemic | -540 [" in text
    assert "Unequal settings" not in text


def test_returns_of_trials_of_other_lengths_are_told_apart(tmp_path):
    run = write_arm(tmp_path, "epistemic", [400.0, 500.0], task_length=20)
    config = {"phase": "zero-shot", "arm": "epistemic"}
    told = ("long", 30), ("same", 20), ("untold", None), ("odd", [30])
    for tag, length in told:
        rows = zero_shot_rows("epistemic", [40.0, 50.0])
        lasts = {"task_length": length} if length else {}
        write_run(run / f"zero-shot-003-{tag}", rows, **config, **lasts, tag=tag)
    text, _ = report_of(tmp_path)
    assert "the return of a trial of 20 steps under" in text
    assert "trials of 10 steps: forward" in text
    assert "A trial has 10 steps on the left and 20 on the right." in text
    for name, length in (("long", "30"), ("same", "20"), ("untold", ""), ("odd", "")):
        assert f"| {name} | epistemic | 3 | {length} | 0 1 |" in text
        assert (f"| epistemic, {name} | epistemic |" in text) == (name != "long")


def test_fine_tuning_of_a_variant_is_a_column_of_its_own(out):
    config = {"phase": "finetune", "arm": "count", "tag": "short"}
    folder = out / "laptop-count" / f"finetune-{EXPLORED:03d}-short"
    write_run(folder, finetune_rows("count", range(3)), **config)
    text, _ = report_of(out)
    assert "| trial | count-16 | count-16, short |" in text
    assert "| 4 | 1000 ± 0.7 (2 seeds) | 1001 ± 1.0 (3 seeds) |" in text


def test_differences_of_means_are_of_our_arms_and_of_variants(plain):
    text, _ = plain
    assert "| epistemic | count-16 | 450 [" in text  # 600 less 150
    assert "| count-16 | epistemic |" not in text


@pytest.mark.parametrize("tasks", ["forward", "forward,backward"])
def test_some_tasks_alone_do_not_count_beside_all(out, tasks):
    run = out / "laptop-epistemic"
    found = zero_shot_rows("epistemic", [1.0])
    rows = [row for row in found if row["task"] in tasks.split(",")]
    config = {"phase": "zero-shot", "arm": "epistemic"}
    name = f"zero-shot-003-{tasks.replace(',', '-')}"
    write_run(run / name, rows, task=tasks, **config)
    _, table = report_of(out)
    assert table["epistemic"]["forward"]["seeds"] == [400.0, 500.0, 900.0]
    (run / "zero-shot-003" / "metrics.jsonl").unlink()
    _, table = report_of(out)
    assert table["epistemic"]["forward"]["seeds"] == [1.0]


def test_what_all_tasks_lack_is_that_of_some(out):
    """As after a finetune of one task, and then one of all that was killed."""
    part = out / "laptop-count" / "finetune-003-forward"
    rows = [x for x in finetune_rows("count", [0]) if x["task"] == "forward"]
    write_run(part, rows, phase="finetune", arm="count", task="forward")
    log = out / "laptop-count" / "finetune-003" / "metrics.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(x for x in lines if json.loads(x)["trial"] == EXPLORED + 1))
    tuned = logs.tuning(load(out), "forward", EXPLORED)["count-16"]
    assert tuned[EXPLORED + 1] == {0: 1000.0, 1: 1001.0}  # each once
    assert tuned[EXPLORED + 2] == {0: 2000.0}


def test_a_task_that_is_performed_again_beside_another_counts_once(out):
    run = out / "laptop-epistemic"
    shutil.rmtree(run / "zero-shot-003")
    for tasks in ("forward", "forward,backward"):
        found = zero_shot_rows("epistemic", [1.0])
        rows = [row for row in found if row["task"] in tasks.split(",")]
        name = f"zero-shot-003-{tasks.replace(',', '-')}"
        config = {"phase": "zero-shot", "arm": "epistemic", "task": tasks}
        write_run(run / name, rows, **config)
    _, table = report_of(out)
    assert table["epistemic"]["forward"]["seeds"] == [1.0]
    edit_rows(run / name / "metrics.jsonl", lambda row: row | {"return": 5.0})
    with pytest.raises(UsageError, match="both hold trial 1 of seed 0, task forward"):
        load(out)


def test_a_run_that_is_called_all_counts(out):
    rows = [{**row, "seed": 7} for row in explore_rows("epistemic", [0])]
    write_run(out / "laptop-epistemic-all", rows, phase="explore", task="all")
    assert {row.seed for row in load(out) if row.arm == "epistemic"} == {0, 1, 2, 7}


def test_report_says_what_is_missing(plain, out):
    text, _ = plain
    assert "no log of random, oracle." in text
    assert "no fine-tuning after 3 trials of epistemic" in text
    log = out / "laptop-count" / "zero-shot-003" / "metrics.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    kept = [line for line in lines if '"backward"' not in line]
    log.write_text("".join(line for line in kept if '"seed": 2' not in line))
    text, table = report_of(out)
    assert "`count-16` has no zero-shot after 3 trials on backward." in text
    lacks = "on forward, front-flip, back-flip of seeds 2."
    assert f"`count-16` has no zero-shot after 3 trials {lacks}" in text
    assert "backward" not in table["count-16"]
    assert len(table["count-16"]["forward"]["seeds"]) == 2
    log.unlink()
    text, table = report_of(out)
    assert list(table) == ["epistemic"]
    assert "on forward, backward, front-flip, back-flip." in text


def test_a_policy_beside_is_no_score_and_is_missed_where_it_is_not_finite(tmp_path):
    run = write_arm(tmp_path, "epistemic", [1.0])
    rows = [
        {**row, "phase": "distill", "planner": "policy", "return": None}
        for row in zero_shot_rows("epistemic", [1.0])
    ]
    config = {"arm": "epistemic", "num_trials": EXPLORED, "phase": "distill"}
    write_run(run / f"distill-{EXPLORED:03d}", rows, **config)
    _, text = report_in(tmp_path)
    assert "8 of 8 returns of distill are not finite" in text


def test_exploration_alone_makes_a_report(tmp_path):
    write_run(
        tmp_path / "a", explore_rows("random", [0]), phase="explore", arm="random"
    )
    text, table = report_of(tmp_path)
    assert table == {}
    assert "No zero-shot log." in text
    assert "No fine-tuning log." in text
    assert "`random`: explored 3 trials (seeds 0)." in text


def test_one_seed_has_no_interval(tmp_path):
    write_arm(tmp_path, "epistemic", [250.0])
    text, table = report_of(tmp_path)
    entry = table["epistemic"]["forward"]
    assert entry == {"seeds": [250.0], "mean": 250.0, "iqm": 250.0, "ci95": None}
    assert "| forward | 250 (1 seed) |" in text


def test_paper_numbers_stand_beside_the_preset_paper(tmp_path):
    write_arm(tmp_path, "epistemic", [1.0], preset="paper")
    write_arm(tmp_path, "epistemic", [2.0], preset="smoke")
    written, text = report_in(tmp_path)
    names = {path.name for path in written}
    assert {"report.md", "table1.json", "report-smoke.md", "table1-smoke.json"} < names
    assert "| front-flip | 21 (1 seed) | 5916 | 1561 | 129 | 2532 |" in text
    other = json.loads((tmp_path / "report" / "table1-smoke.json").read_text())
    assert other["epistemic"]["forward"]["mean"] == 2.0


def test_robots_of_one_preset_are_kept_apart(tmp_path):
    """The tasks of each are those of its logs, and the paper is about one of them."""
    write_arm(tmp_path, "epistemic", [1.0], preset="paper")
    other = {"preset": "paper", "arm": "epistemic", "env": "dmc/walker"}
    rows = [
        {**row, "task": f"walk-{row['task']}"}
        for row in zero_shot_rows("epistemic", [7.0])
        if row["task"] == "forward"
    ]
    write_run(tmp_path / "walker" / "zero-shot-003", rows, phase="zero-shot", **other)
    _, table = report_of(tmp_path)
    assert list(table["epistemic"]) == list(TASK_NAMES)
    text = (tmp_path / "report" / "report-paper-dmc-walker.md").read_text()
    assert "| walk-forward | 7.0 (1 seed) |\n" in text and "paper: SU" not in text


def test_robots_that_share_a_name_alone_are_named(tmp_path):
    for seed, entries in enumerate((["x"], ["x"], ["x", "hinge"])):
        run = tmp_path / f"run-{seed}"
        write_run(run, explore_rows("epistemic", [seed]), phase="explore")
        written = {"id": str(seed), "model": None, "entries": entries}
        (run / "run.json").write_text(json.dumps(written))
    text, _ = report_of(tmp_path)
    assert "- Unequal robots, which observe other entries: run-0, run-1; run-2." in text


def test_what_a_model_of_a_file_did_is_a_report_of_its_own(tmp_path):
    """Of the same seed, and after more trials than a run that was explored here."""
    write_arm(tmp_path, "epistemic", [2.0])
    folder = tmp_path / "shown" / "zero-shot-060"
    rows = zero_shot_rows("epistemic", [9.0], explored=60)
    write_run(folder, rows, phase="zero-shot", arm="epistemic")
    (folder / "run.json").write_text(json.dumps({"id": "0", "model": "a digest"}))
    text, table = report_of(tmp_path)
    assert table["epistemic"]["forward"]["seeds"] == [2.0]
    assert "after 3 exploration trials" in text
    theirs = (tmp_path / "report" / "report-models.md").read_text()
    assert theirs.startswith("# Report of preset `models`\n")
    assert "| forward | 9.0 (1 seed) |" in theirs


def test_data_efficiency_is_a_table_of_its_own(out):
    rows = zero_shot_rows("epistemic", [50.0, 60.0, 70.0], explored=1)
    folder = out / "laptop-epistemic" / "zero-shot-001"
    write_run(folder, rows, phase="zero-shot", arm="epistemic")
    text, table = report_of(out)
    assert "| epistemic | 1 | 60 ± 10 (3 seeds) |" in text
    assert table["epistemic"]["forward"]["mean"] == 600.0


def test_the_ablation_is_a_table_of_means_over_seeds_and_trials(plain, out):
    assert "## Ablation" not in plain[0]
    returns = {
        task: [[10.0 * i, 20.0], [30.0, 40.0]] for i, task in enumerate(TASK_NAMES)
    }
    row = {
        "exploration": "curiosity",
        "refit": "none",
        "search": "CEM",
        "seeds": [8, 9],
    }
    (out / "ablation.jsonl").write_text(json.dumps(row | {"returns": returns}) + "\n")
    text, table = report_of(out)
    assert "| curiosity | none | CEM | 8 9 | 22 | 25 | 28 | 30 |" in text
    assert "curiosity" not in json.dumps(table)
    (out / "ablation.jsonl").write_text("{")
    with pytest.raises(UsageError, match="jsonl holds no rows of an ablation"):
        report_of(out)


def test_null_returns_are_left_out_and_counted(out):
    def lose(row):
        if row["task"] == "forward" and (row["seed"] == 2 or row["trial"] == 1):
            row["return"] = None

    edit_rows(out / "laptop-epistemic" / "zero-shot-003" / "metrics.jsonl", lose)
    text, table = report_of(out)
    entry = table["epistemic"]["forward"]
    assert entry["seeds"] == [393.0, 493.0, None]
    assert entry["mean"] == 443.0
    assert "`epistemic`: 4 of 24 returns of zero-shot are not finite" in text
    assert "| epistemic | 2 | not finite | 910 |" in text

    def lose_all(row):
        row["returns"] = dict.fromkeys(TASK_NAMES)

    edit_rows(out / "laptop-epistemic" / "metrics.jsonl", lose_all)
    text, _ = report_of(out)
    assert "36 of 36 returns of explore" in text


def test_runs_of_other_seeds_are_pooled(out):
    rows = [
        {**row, "seed": row["seed"] + 3}
        for row in zero_shot_rows("epistemic", [600.0, 700.0])
    ]
    folder = out / "more" / "zero-shot-003"
    write_run(folder, rows, phase="zero-shot", arm="epistemic", learning_rate=0.5)
    other = out / "laptop-epistemic" / "zero-shot-003" / "config.json"
    config = json.loads(other.read_text())
    other.write_text(json.dumps({**config, "learning_rate": 0.1}))
    text, table = report_of(out)
    seeds = table["epistemic"]["forward"]["seeds"]
    assert seeds == [400.0, 500.0, 900.0, 600.0, 700.0]
    # Of five, one is cut off at each end.
    assert table["epistemic"]["forward"]["iqm"] == pytest.approx(600.0)
    assert "learning_rate is 0.1 (laptop-epistemic); 0.5 (more)" in text


def test_a_setting_that_a_run_did_not_record_is_named(tmp_path):
    for arm, refit in (("count", {"bootstrap": True}), ("best", {"bootstrap": False})):
        write_arm(tmp_path / "runs", arm, [1.0], refit=refit)
    write_arm(tmp_path / "runs", "random", [1.0])
    text, _ = report_of(tmp_path / "runs")
    assert (
        "zero-shot: refit.bootstrap is False (laptop-best); True (laptop-count" in text
    )
    assert "); not recorded (laptop-random)." in text


def test_random_trials_without_returns_are_left_out(out):
    log = out / "laptop-count" / "metrics.jsonl"
    edit_rows(log, lambda row: row | {"returns": None})
    rows = [row for row in load(out) if row.arm == "count-16"]
    lines = task_sections.zero_shot(rows, logs.scores(rows, EXPLORED), EXPLORED)
    assert "### Every seed" in lines and not any("Random" in line for line in lines)


def test_what_a_phase_does_not_use_may_differ_in_it(tmp_path):
    for arm, horizon in (("epistemic", 20), ("best", 30)):
        write_arm(tmp_path / "runs", arm, [1.0], task_planner={"horizon": horizon})
    text, _ = report_of(tmp_path / "runs")
    assert "Unequal settings in zero-shot: task_planner.horizon is" in text
    assert "Unequal settings in explore" not in text


def test_a_seed_in_two_runs_is_an_error(out):
    rows = zero_shot_rows("epistemic", [1.0])
    write_run(out / "again" / "zero-shot", rows, phase="zero-shot", arm="epistemic")
    with pytest.raises(UsageError, match=r"both hold trial 1 of seed 0, task forward"):
        load(out)


def test_a_line_cut_off_is_left_out_and_so_is_a_damaged_one(out, capsys):
    log = out / "laptop-count" / "metrics.jsonl"
    whole = log.read_text()
    log.write_text(whole[:-20])
    text, _ = report_of(out)
    assert "last line of laptop-count/metrics.jsonl is cut off" in text
    assert "explored 3 trials (seeds 0, 1) and 2 trials (seeds 2)" in text
    rows = load(out)
    log.write_text("{]\n" + whole[:-20])
    assert load(out) == rows
    assert f"warning: {log}:1 is no row of a run (Exp" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, r"does not exist or is not a file"),
        ("[]", r"is no config of a run \(Expected `object`, got `array`\)\. Restore"),
        ('{"arm": "best"}', r"is no config of a run \(.* missing required field `pres"),
        ('{"preset": "x/../../y"}', r"is no config of a run \(.* at `\$\.preset`\)"),
        ('{"preset": "x", "tag": "/y"}', r"is no config of a run \(.* at `\$\.tag`\)"),
        ('{"preset": "x", "preset": "y"}', r"cannot be read \('preset' is there twice"),
    ],
)
def test_a_config_that_is_none_is_named(out, text, words):
    """And never the row, which is good; nor is anything written elsewhere."""
    path = out / "laptop-count" / "config.json"
    path.unlink() if text is None else path.write_text(text)
    before = sorted(out.rglob("*"))
    with pytest.raises(CheckpointError, match=f"{path} {words}"):
        write_report(out, out / "report")
    assert sorted(out.rglob("*")) == before


@pytest.mark.parametrize("made", [True, False])
def test_no_log_is_an_error(tmp_path, made):
    out = tmp_path / "runs"
    if made:
        (out / ".hidden").mkdir(parents=True)
        (out / ".hidden" / "metrics.jsonl").write_text("{}\n")
    with pytest.raises(UsageError, match="no metrics"):
        write_report(out, tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_figures_show_something(out):
    from PIL import Image

    paths = write_report(out, out / "report")
    pictures = [path for path in paths if path.suffix == ".png"]
    assert len(pictures) == 3
    # Colours of the arms: epistemic's blue, count's vermillion.
    for path in pictures:
        pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
        for color in ([0x00, 0x72, 0xB2], [0xD5, 0x5E, 0x00]):
            assert (pixels == color).all(axis=-1).sum() > 200
