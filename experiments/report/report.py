"""The report: Table 1 and Figure 4 of the paper, from the logs of any runs."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.report import coverage, coverage_section, figures, stats, tables
from experiments.report.caveats import notes
from experiments.report.coverage import Counts
from experiments.report.figures import Curve, TaskPanels
from experiments.report.logs import (
    Points,
    Row,
    Scores,
    exploring,
    load,
    number,
    scores,
    tuning,
)
from experiments.report.tables import TASKS

__all__ = ["load", "write_report"]

_PAPER_TRIALS = 60
_OURS = ("best", "epistemic")  # what the other arms are baselines of

_TABLE_1 = (
    "The jump-start: the return of a trial under the task's reward before anything is "
    "learned from it. A seed's score is the mean of its evaluation trials. Cells: mean "
    "± standard deviation over seeds, [95 % bootstrap interval of the mean, seeds "
    "resampled], interquartile mean (IQM) from four seeds on. Flips are named by "
    "physics: a front flip turns nose down. The paper's Figure 3 has the names the "
    "other way round, so its two flip rows may be exchanged."
)
_FIGURE_4 = (
    "Left: return under each task while exploring without it (the oracle has "
    "forward's). Right: zero-shot (dot: mean of all its seeds) and fine-tuning. Bold: "
    "mean of the seeds, where all have a number; thin: one seed; dotted: mean of each "
    "seed's best so far."
)


class _Files(NamedTuple):
    report: Path
    table_1: Path
    figure_4: Path
    exploration: Path
    coverage: Path  # only if a run has its coverage


def write_report(out: Path, target: Path) -> list[Path]:
    """Writes report.md, table1.json and the figures from all logs under a folder.

    With logs of several presets each has files of its own: `paper` (or else the first)
    under these names, the others with the preset in the name.

    Args:
      out: holds runs at any depth, and model_error.json if there is one.
      target: folder to write into; made if it is not there.

    Returns:
      The files written.

    Raises:
      UsageError: as `load`, for coverage.json and model_error.json too.
    """
    rows = load(out)
    seen = coverage.load(out)
    target.mkdir(parents=True, exist_ok=True)
    presets = {row.preset for row in rows}
    written: list[Path] = []
    for i, preset in enumerate(
        sorted(presets, key=lambda name: (name != "paper", name))
    ):
        suffix = f"-{preset}" if i else ""
        files = _Files(
            report=target / f"report{suffix}.md",
            table_1=target / f"table1{suffix}.json",
            figure_4=target / f"figure4{suffix}.png",
            exploration=target / f"exploration{suffix}.png",
            coverage=target / f"coverage{suffix}.png",
        )
        counts = seen.get(preset, {})
        _write([row for row in rows if row.preset == preset], counts, out, files)
        written += files if counts else files[:-1]
    return written


def _write(
    rows: Sequence[Row], counts: Mapping[str, Counts], out: Path, files: _Files
) -> None:
    """Writes the files of one preset."""
    every, rows = rows, [row for row in rows if not row.tag] or rows
    explored = _explored(rows)
    found = scores(rows, explored)
    _write_json(files.table_1, found)
    figures.figure_4(files.figure_4, _panels(rows, found, explored), explored)
    # Random actions are of no value to anyone, whatever a log says.
    planned = [r for r in rows if "random" not in (r.arm, r.data.get("planner"))]
    figures.exploration(
        files.exploration,
        _curves(exploring(planned, "value")),
        _curves(exploring(rows, "turns")),
    )
    lines = [
        f"# Report of preset `{rows[0].preset}`",
        "",
        *(f"- {note}" for note in notes(rows, found, explored)),
        "",
        *_zero_shot(rows, found, explored),
        *_attempts(every),
        *_fine_tuning(rows, explored),
        "## Figure 4",
        "",
        f"![returns over trials]({files.figure_4.name})",
        "",
        _FIGURE_4,
        "",
        "## Exploration",
        "",
        f"![value and turns]({files.exploration.name})",
        "",
        "The arms value different things; compare their turns, not their values.",
        "",
        *coverage_section.covered(counts, files.coverage),
        *coverage_section.model_error(out / "model_error.json", rows[0].preset),
        *_ablation(out / "ablation.jsonl"),
        *_runs(every, out),
    ]
    files.report.write_text("\n".join(lines))


def _explored(rows: Sequence[Row]) -> int:
    """Returns the number of exploration trials that Table 1 is about."""
    counts = {row.explored for row in rows if row.phase != "explore"}
    if rows[0].preset == "paper" and _PAPER_TRIALS in counts:
        return _PAPER_TRIALS
    return max(counts, default=max(row.trial for row in rows))


def _write_json(path: Path, found: Scores) -> None:
    """Writes `{arm: {task: {seeds, mean, iqm, ci95}}}`; null is not finite, or none."""
    table: dict[str, Any] = {}
    for arm in tables.in_order(found):
        table[arm] = {}
        for task in (task for task in TASKS if task in found[arm]):
            values = np.array(list(found[arm][task].values()), float)
            summary = stats.summarize(values)
            table[arm][task] = {
                "seeds": [float(x) if np.isfinite(x) else None for x in values],
                "mean": summary.mean if summary else None,
                "iqm": summary.iqm if summary else None,
                "ci95": list(summary.ci95) if summary and summary.ci95 else None,
            }
    path.write_text(json.dumps(table, indent=1, allow_nan=False) + "\n")


def _curves(points: Mapping[str, Points]) -> dict[str, Curve]:
    """Returns a curve by arm, a line per seed."""
    return {arm: _curve(points[arm]) for arm in tables.in_order(points)}


def _curve(points: Points) -> Curve:
    seeds = sorted({seed for by_seed in points.values() for seed in by_seed})
    trials = sorted(points)
    values = [[points[t].get(seed, np.nan) for t in trials] for seed in seeds]
    return Curve(np.array(trials), np.array(values, float))


def _panels(rows: Sequence[Row], found: Scores, explored: int) -> dict[str, TaskPanels]:
    """Returns Figure 4 by task."""
    panels = {}
    for task in TASKS:
        starts = {
            arm: found[arm][task]
            for arm in tables.in_order(found)
            if task in found[arm]
        }
        tuned = tuning(rows, task, explored)
        for arm, points in tuned.items():
            # Lines begin at the zero-shot score of the seeds that went on.
            went_on = {seed for by_seed in points.values() for seed in by_seed}
            start = starts.get(arm, {})
            points[explored] = {s: start[s] for s in start if s in went_on}
        panels[task] = TaskPanels(
            exploring=_curves(exploring(rows, "returns", task)),
            tuning=_curves(tuned),
            jump_start={arm: np.array(list(x.values())) for arm, x in starts.items()},
        )
    return panels


def _zero_shot(rows: Sequence[Row], found: Scores, explored: int) -> list[str]:
    """Returns the sections on tasks done without learning."""
    counts = sorted({row.explored for row in rows if row.phase == "zero-shot"})
    lines = [f"## Table 1: zero-shot return after {explored} exploration trials", ""]
    if not found:
        return [*lines, "No zero-shot log.", ""]
    found = {arm: found[arm] for arm in tables.in_order(found)}
    lines += tables.table_1(found, with_paper=rows[0].preset == "paper")
    lines += [
        _TABLE_1,
        "",
        *_random_actions(rows),
        "### Every seed",
        "",
        *tables.every_seed(found),
    ]
    for ours in (arm for arm in _OURS if arm in found and len(found) > 1):
        lines += ["### Probability of improvement", ""]
        lines += tables.improvement(found, ours)
    if len(counts) > 1:
        lines += ["## Data efficiency: zero-shot return by exploration trials", ""]
        lines += tables.by_trials({count: scores(rows, count) for count in counts})
    return lines


def _attempts(rows: Sequence[Row]) -> list[str]:
    """Returns the section on zero-shots with other numbers, each under its tag."""
    tagged = [row for row in rows if row.phase == "zero-shot" and row.tag]
    if not tagged:
        return []
    lines = []
    for tag, arm, explored in sorted({(r.tag, r.arm, r.explored) for r in tagged}):
        own = [r for r in tagged if (r.tag, r.arm, r.explored) == (tag, arm, explored)]
        by_task = scores(own, explored)[arm]
        cells = [tables.cell(by_task.get(task, {}), full=True) for task in TASKS]
        seeds = " ".join(map(str, sorted({row.seed for row in own})))
        lines.append([tag, arm, str(explored), seeds, *cells])
    text = "Zero-shot with other numbers (`--tag`), which the sections above leave out."
    header = ["attempt", "arm", "explored trials", "seeds", *TASKS]
    return ["## Other attempts", "", text, "", *tables.table(header, lines)]


def _random_actions(rows: Sequence[Row]) -> list[str]:
    """Returns what a trial of random actions returns, for scale."""
    # The random trials at the start are the same in all arms of a seed.
    random = {
        (row.seed, row.trial): row
        for row in rows
        if row.data.get("planner") == "random"
        or (row.phase, row.arm) == ("explore", "random")
    }.values()
    means = []
    for task in TASKS:
        values = np.array([number(row.data["returns"][task]) for row in random])
        if np.isfinite(values).any():
            means.append(f"{task} {tables.number(float(np.nanmean(values)))}")
    if not means:
        return []
    text = f"Random actions, mean of {len(random)} trials: {', '.join(means)}."
    return [text, ""]


def _fine_tuning(rows: Sequence[Row], explored: int) -> list[str]:
    lines = [f"## Fine-tuning after {explored} exploration trials", ""]
    tables_by_task = [
        tables.fine_tuning(task, {arm: tuned[arm] for arm in tables.in_order(tuned)})
        for task in TASKS
        if (tuned := tuning(rows, task, explored))
    ]
    if not tables_by_task:
        return [*lines, "No fine-tuning log.", ""]
    lines += ["Return of each trial; the first is planned with the explored model.", ""]
    return lines + [line for table in tables_by_task for line in table]


def _ablation(path: Path) -> list[str]:
    """Returns the section on recipes that were tried, if there is a file of them."""
    if not path.exists():
        return []
    text = (
        "Zero-shot returns, means over seeds and trials. Seeds 100 and 101 are those "
        "on which `best` was chosen; they are in no other table."
    )
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return ["## Ablation", "", text, "", *tables.ablation(rows)]


def _runs(rows: Sequence[Row], out: Path) -> list[str]:
    """Returns what the runs took and ran on."""
    folders = {str(row.run.relative_to(out)): row.run for row in rows}
    timed: dict[str, dict[int, dict[str, Any]]] = {}
    for row in rows:
        if row.data.get("seconds"):
            # Rows of one trial share its time.
            trials = timed.setdefault(str(row.run.relative_to(out)), {})
            item = trials.setdefault(
                row.trial, {"seconds": row.data["seconds"], "seeds": set()}
            )
            item["seeds"].add(row.seed)
    lines = ["## Seconds per trial", ""]
    if timed:
        lines += [
            "Medians over the trials of a run, all its seeds and tasks at once.",
            "",
        ]
        lines += tables.seconds({run: list(x.values()) for run, x in timed.items()})
    else:
        lines += ["No run logged them.", ""]
    return [*lines, "## Runs", "", *tables.environments(folders)]
