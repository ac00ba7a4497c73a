"""The report: Table 1 and Figure 4 of the paper, from the logs of any runs."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..config import UNPLANNED
from ..errors import UsageError
from ..storage import disk, rundir
from . import (
    caveats,
    coverage,
    coverage_section,
    figures,
    stats,
    tables,
    task_sections,
)
from .coverage import Seen
from .figures import Curve, TaskPanels
from .logs import (
    Points,
    Row,
    Scores,
    exploring,
    load,
    scores,
    steps,
    tuning,
)

__all__ = ["load", "write_report"]

_PAPER_TRIALS = 60

_FIGURE_4 = (
    "Left: return under each task while exploring without it (the oracle has that of "
    "the first). Right: zero-shot (dot: mean of all its seeds) and fine-tuning. Bold: "
    "mean of the seeds, where all have a number; thin: one seed; dotted: mean of each "
    "seed's best so far."
)


class _Files(NamedTuple):
    report: Path
    table_1: Path
    zero_shot: Path  # only if a run has performed every task
    figure_4: Path
    exploration: Path  # only if a run has explored by plans, or turns are counted
    coverage: Path  # only if a run has its coverage


def write_report(out: Path, target: Path) -> list[Path]:
    """Writes report.md, table1.json and the figures from all logs under a folder.

    With logs of several presets or robots each has files of its own: `paper` (or else
    the first) under these names, the others with the preset, and with the robot if that
    is not the paper's, in the name. What models of files did is the preset `models`,
    the last.

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
    presets = sorted({row.preset for row in rows}, key=_place)
    written: list[Path] = []
    for i, preset in enumerate(presets):
        suffix = f"-{preset}" if i else ""
        files = _Files(
            report=target / f"report{suffix}.md",
            table_1=target / f"table1{suffix}.json",
            zero_shot=target / f"zero-shot{suffix}.png",
            figure_4=target / f"figure4{suffix}.png",
            exploration=target / f"exploration{suffix}.png",
            coverage=target / f"coverage{suffix}.png",
        )
        covered = seen.get(preset)
        own = [row for row in rows if row.preset == preset]
        for optional in (files.zero_shot, files.exploration, files.coverage):
            optional.unlink(missing_ok=True)  # of a report on other logs
        _write(own, covered, out, files)
        written += [file for file in files if file.exists()]
    return written


def _place(preset: str) -> tuple[bool, bool, str]:
    """Returns the place of a preset among others: `paper` first, `models` last."""
    return preset != "paper", preset.partition("-")[0] == rundir.MODELS, preset


def _write(rows: Sequence[Row], covered: Seen | None, out: Path, files: _Files) -> None:
    """Writes the files of one preset."""
    every, rows = rows, [row for row in rows if not row.tag] or rows
    explored = _explored(rows)
    found = scores(rows, explored)
    _write_json(files.table_1, tables.tasks_of(rows), found)
    _draw(rows, found, explored, files)
    lines = [
        f"# Report of preset `{rows[0].preset}`",
        "",
        *(f"- {text}" for text in caveats.sentences(rows, found, explored)),
        "",
        *task_sections.zero_shot(rows, found, explored),
        *task_sections.variants(every),
        *task_sections.compared(every, explored, files.zero_shot),
        *task_sections.fine_tuning(every, explored),
        "## Figure 4",
        "",
        f"![returns over trials]({files.figure_4.name})",
        "",
        _FIGURE_4 + _lengths(rows),
        "",
        *_exploration(files.exploration),
        *coverage_section.covered(covered, files.coverage),
        *coverage_section.model_error(out / "model_error.json", rows[0].preset),
        *_ablation(out / "ablation.jsonl"),
        *_runs(every, out),
    ]
    disk.write(files.report, "\n".join(lines).encode())


def _draw(rows: Sequence[Row], found: Scores, explored: int, files: _Files) -> None:
    """Draws Figure 4 and what exploration was like."""
    figures.figure_4(files.figure_4, panels(rows, found, explored), explored)
    # Random actions are of no value to anyone, whatever a log says.
    at_random = {*UNPLANNED, *UNPLANNED.values()}
    planned = [r for r in rows if not at_random & {r.arm, r.data.get("planner")}]
    value = _curves(exploring(planned, "value"))
    turns = _curves(exploring(rows, "turns"))
    if value or turns:
        figures.exploration(files.exploration, value, turns)


def _lengths(rows: Sequence[Row]) -> str:
    """Returns a sentence on the two panels, if their trials are not equally long."""
    explored = steps((row for row in rows if row.phase == "explore"), "trial_length")
    later = steps((row for row in rows if row.phase != "explore"), "task_length")
    if not (explored and later) or explored == later:
        return ""
    return f" A trial has {explored} steps on the left and {later} on the right."


def _exploration(picture: Path) -> list[str]:
    """Returns the section on what exploration was like, if there is a picture of it."""
    if not picture.exists():
        return []
    text = "The arms value different things; compare their turns, not their values."
    lines = ["## Exploration", "", f"![value and turns]({picture.name})"]
    return [*lines, "", text, ""]


def _explored(rows: Sequence[Row]) -> int:
    """Returns the number of exploration trials that Table 1 is about."""
    counts = {row.explored for row in rows if row.phase != "explore"}
    if rows[0].preset == "paper" and _PAPER_TRIALS in counts:
        return _PAPER_TRIALS
    return max(counts, default=max(row.trial for row in rows))


def _write_json(path: Path, tasks: Sequence[str], found: Scores) -> None:
    """Writes `{arm: {task: {seeds, mean, iqm, ci95}}}`; null is not finite, or none."""
    table: dict[str, Any] = {}
    for arm in tables.in_order(found):
        table[arm] = {}
        for task in (task for task in tasks if task in found[arm]):
            values = np.array(list(found[arm][task].values()), float)
            summary = stats.summarize(values)
            table[arm][task] = {
                "seeds": [float(x) if np.isfinite(x) else None for x in values],
                "mean": summary.mean if summary else None,
                "iqm": summary.iqm if summary else None,
                "ci95": list(summary.ci95) if summary and summary.ci95 else None,
            }
    text = json.dumps(table, indent=1, allow_nan=False) + "\n"
    disk.write(path, text.encode())


def _curves(points: Mapping[str, Points]) -> dict[str, Curve]:
    """Returns a curve by arm, a line per seed."""
    return {arm: _curve(points[arm]) for arm in tables.in_order(points)}


def _curve(points: Points) -> Curve:
    seeds = sorted({seed for by_seed in points.values() for seed in by_seed})
    trials = sorted(points)
    values = [[points[t].get(seed, np.nan) for t in trials] for seed in seeds]
    return Curve(np.array(trials), np.array(values, float))


def panels(rows: Sequence[Row], found: Scores, explored: int) -> dict[str, TaskPanels]:
    """Returns Figure 4 by task."""
    panels = {}
    for task in tables.tasks_of(rows):
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


def _ablation(path: Path) -> list[str]:
    """Returns the section on recipes that were tried, if there is a file of them."""
    if not path.exists():
        return []
    text = (
        "Zero-shot returns, means over seeds and trials. Seeds 100 and 101 are those "
        "on which `best` was chosen; they are in no other table."
    )
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
    except ValueError as error:
        raise UsageError(f"{path} holds no rows of an ablation: {error}") from error
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
