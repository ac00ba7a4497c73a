"""Sections of the report on the tasks: zero-shot, its variants, fine-tuning."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from . import figures, tables
from .logs import Row, Scores, named_by_tag, number, scores, steps, tuning

_OURS = ("best", "epistemic")  # what the other arms are baselines of

_TABLE_1 = (
    "The jump-start: the return of a trial{} under the task's reward before anything "
    "is learned from it. A seed's score is the mean of its evaluation trials. Cells: "
    "mean ± standard deviation over seeds, [95 % interval of the mean, Student's t "
    "over seeds], interquartile mean (IQM) from four seeds on."
)
_FLIPS = (
    " Flips are named by "
    "physics: a front flip turns nose down. The paper's Figure 3 has the names the "
    "other way round, so its two flip rows may be exchanged."
)
_ZERO_SHOT = (
    "Small dots: seeds. Large dot and line: their mean and its 95 % interval. After "
    "the comma stands the tag of a variant."
)
_REFERENCE = " Dashed: the paper's SU-PETS, mean of three seeds."
_DIFFERENCES = (
    "Differences of means over seeds, [95 % interval, Welch's t]. Seeds count as "
    "independent, also where both sides share them. No correction is made for the "
    "number of comparisons."
)
_VARIANTS = (
    "Zero-shot with other settings (`--tag`). Table 1 and the sections on it leave "
    "them out."
)


def zero_shot(rows: Sequence[Row], found: Scores, explored: int) -> list[str]:
    """Returns the sections on tasks that are performed without learning them.

    Args:
      rows: without those of variants.
      found: their scores after `explored` trials.
      explored: the exploration trials that Table 1 is about.
    """
    counts = sorted({row.explored for row in rows if row.phase == "zero-shot"})
    lines = [f"## Table 1: zero-shot return after {explored} exploration trials", ""]
    if not found:
        return [*lines, "No zero-shot log.", ""]
    found = {arm: found[arm] for arm in tables.in_order(found)}
    tasks, is_paper = tables.tasks_of(rows), rows[0].preset == "paper"
    lines += tables.table_1(tasks, found, with_paper=is_paper)
    performed = [row for row in rows if row.phase == "zero-shot"]
    lines += [
        _TABLE_1.format(_of(steps(performed, "task_length")))
        + _FLIPS * (tables.TASKS[2] in tasks),
        "",
        *_random_actions(rows),
        "### Every seed",
        "",
        *tables.every_seed(tasks, found),
    ]
    for ours in (arm for arm in _OURS if arm in found and len(found) > 1):
        lines += ["### Probability of improvement", ""]
        lines += tables.improvement(tasks, found, ours)
    if len(counts) > 1:
        lines += ["## Data efficiency: zero-shot return by exploration trials", ""]
        by_count = {count: scores(rows, count) for count in counts}
        lines += tables.by_trials(tasks, by_count)
    return lines


def variants(rows: Sequence[Row]) -> list[str]:
    """Returns the section on zero-shots with other settings, each under its tag."""
    tagged = [row for row in rows if row.phase == "zero-shot" and row.tag]
    if not tagged:
        return []
    length = _steps_by_run(tagged)
    by_variant: dict[tuple[str, str, int, str], list[Row]] = {}
    for row in tagged:
        key = row.tag, row.arm, row.explored, length[row.run]
        by_variant.setdefault(key, []).append(row)
    found = {key: scores(own, key[2]) for key, own in by_variant.items()}
    table = tables.variants(tables.tasks_of(tagged), found)
    return ["## Variants", "", _VARIANTS, "", *table]


def compared(rows: Sequence[Row], explored: int, picture: Path) -> list[str]:
    """Draws Table 1 with its variants, and returns the section on their differences.

    Variants whose trials are longer or shorter return other numbers, and are left out.

    Args:
      rows: with those of variants.
      explored: the exploration trials that Table 1 is about.
      picture: file to write, if there is a score.
    """
    performed = [row for row in rows if row.phase == "zero-shot"]
    length = _steps_by_run(performed)
    plain = {length[row.run] for row in performed if not row.tag} - {""}
    as_long = {"", *(plain or length.values())}  # empty where no config says it
    alike = [row for row in performed if not row.tag or length[row.run] in as_long]
    found = scores(named_by_tag(alike), explored)
    found = {name: found[name] for name in tables.in_order(found)}
    if not found:
        return []
    tasks = tables.tasks_of(rows)
    whole = {
        name: {task: np.array(list(by_task[task].values())) for task in tasks}
        for name, by_task in found.items()
        if set(tasks) <= set(by_task)
    }
    is_paper = rows[0].preset == "paper"
    reference: dict[str, float] = {}
    if is_paper:
        paper = tables.PAPER_TABLE_1["SU-PETS"]
        reference = dict(zip(tables.TASKS, paper, strict=True))
    lines = ["## Arms and variants side by side", ""]
    if whole:
        figures.zero_shot(picture, whole, reference)
        text = _ZERO_SHOT + _REFERENCE * is_paper
        lines += [f"![zero-shot returns]({picture.name})", "", text, ""]
    if pairs := _pairs(list(found)):
        lines += [_DIFFERENCES, "", *tables.differences(tasks, found, pairs)]
    return lines


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Returns which differences to show: what, and what is subtracted from it.

    These are our arms in any variant with each other, our arms with the others in the
    same variant, and a variant with what it varies.
    """
    pairs = []
    for first, second in itertools.combinations(names, 2):
        arm, _, tag = first.partition(", ")
        other, _, other_tag = second.partition(", ")
        if arm == other or (arm in _OURS and other in _OURS):
            if arm in _OURS or not tag:
                pairs.append((second, first))
        elif tag == other_tag and arm in _OURS:
            pairs.append((first, second))
        elif tag == other_tag and other in _OURS:
            pairs.append((second, first))
    return pairs


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
    for task in tables.tasks_of(rows):
        values = [(row.data.get("returns") or {}).get(task) for row in random]
        values = np.array([*map(number, values)])
        if np.isfinite(values).any():
            mean = tables.format_number(float(np.nanmean(values)))
            means.append(f"{task} {mean}")
    if not means:
        return []
    length = _of(steps(random, "trial_length"))
    text = f"Random actions, mean of {len(random)} trials{length}: {', '.join(means)}."
    return [text, ""]


def _of(steps: str) -> str:
    return f" of {steps} steps" if steps else ""


def _steps_by_run(performed: Iterable[Row]) -> dict[Path, str]:
    last = {row.run: row for row in performed}
    return {run: steps([row], "task_length") for run, row in last.items()}


def fine_tuning(rows: Sequence[Row], explored: int) -> list[str]:
    """Returns the section on fine-tuning; variants are columns of their own."""
    lines = [f"## Fine-tuning after {explored} exploration trials", ""]
    named = named_by_tag(rows)
    by_task = [
        tables.fine_tuning(task, {arm: tuned[arm] for arm in tables.in_order(tuned)})
        for task in tables.tasks_of(rows)
        if (tuned := tuning(named, task, explored))
    ]
    if not by_task:
        return [*lines, "No fine-tuning log.", ""]
    lines += ["Return of each trial; the first is planned with the explored model.", ""]
    return lines + [line for table in by_task for line in table]
