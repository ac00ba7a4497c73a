"""Markdown of the report: every function returns lines."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..storage import rundir
from . import stats
from .logs import Points, Row, Scores

TASKS = ("forward", "backward", "front-flip", "back-flip")
ARMS = ("epistemic", "count", "random", "oracle", "one-step")

# Table 1 of the paper, in the order of TASKS; three seeds, no spread given.
PAPER_TABLE_1 = {
    "SU-PETS": (3890, 3831, 5916, 5093),
    "count": (798, 990, 1561, 699),
    "random": (2813, 582, 129, 369),
    "PETS-oracle": (6238, 512, 2532, 1843),
}

_MISSING = "no log"


def in_order(arms: Collection[str]) -> list[str]:
    """Sorts arms: `best` and what else the paper lacks last."""

    def place(arm: str) -> tuple[int, str]:
        family = arm.partition(",")[0]  # of "epistemic, no-refit" too
        family = "count" if family.startswith("count-") else family
        return (ARMS.index(family) if family in ARMS else len(ARMS), arm)

    return sorted(arms, key=place)


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Returns the leaves of nested dictionaries by dotted name; lists are leaves."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        leaves |= flat(value, f"{prefix}.{name}" if prefix else str(name))
    return leaves


def format_number(value: float) -> str:
    """Formats a return or a time; the number may be NaN."""
    if not np.isfinite(value):
        return "not finite"
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.1f}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Returns a table and an empty line."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def cell(scores: Mapping[int, float], *, full: bool = False) -> str:
    """Formats scores by seed: mean, spread, and if full the interval and the IQM."""
    summary = stats.summarize(np.array(list(scores.values()), float))
    if summary is None:
        return "not finite" if scores else _MISSING
    text = format_number(summary.mean)
    if summary.std is None or summary.ci95 is None:
        return f"{text} (1 seed)"
    text += f" ± {format_number(summary.std)}"
    if not full:
        return f"{text} ({summary.num_seeds} seeds)"
    low, high = map(format_number, summary.ci95)
    text += f"<br>[{low}, {high}]"
    few = summary.num_seeds < 4  # nothing to cut off
    return text if few else f"{text}<br>IQM {format_number(summary.iqm)}"


def tasks_of(rows: Iterable[Row]) -> list[str]:
    """Returns the tasks that runs of a robot speak of, those of the paper first."""
    found: dict[str, None] = {}
    for row in rows:
        own = [row.task] if row.task else []
        found |= dict.fromkeys([*(row.data.get("returns") or {}), *own])
    return tasks_in_order(found)


def tasks_in_order(tasks: Iterable[str]) -> list[str]:
    """Sorts tasks: those of the paper first, the others as they come."""
    return sorted(tasks, key=lambda x: TASKS.index(x) if x in TASKS else len(TASKS))


def table_1(
    tasks: Sequence[str], scores: Scores, *, with_paper: bool
) -> list[str]:  # fmt: skip
    """Returns the layout of the paper's Table 1: tasks by arms."""
    paper = PAPER_TABLE_1 if with_paper else {}
    header = ["task", *scores, *(f"paper: {name}" for name in paper)]
    rows = []
    for task in tasks:
        own = [cell(by_task.get(task, {}), full=True) for by_task in scores.values()]
        place = TASKS.index(task) if task in TASKS else None
        theirs = ["" if place is None else str(x[place]) for x in paper.values()]
        rows.append([task, *own, *theirs])
    counts = [
        len({s for t in by_task.values() for s in t}) for by_task in scores.values()
    ]
    rows.append(["seeds", *map(str, counts), *("3" for _ in paper)])
    return table(header, rows)


def every_seed(tasks: Sequence[str], scores: Scores) -> list[str]:
    """Returns the score of every seed."""
    rows = []
    for arm, by_task in scores.items():
        for seed in sorted({seed for task in by_task.values() for seed in task}):
            cells = [by_task.get(task, {}).get(seed) for task in tasks]
            shown = [_MISSING if x is None else format_number(x) for x in cells]
            rows.append([arm, str(seed), *shown])
    return table(["arm", "seed", *tasks], rows)


def improvement(tasks: Sequence[str], scores: Scores, arm: str) -> list[str]:
    """Returns the probability that a seed of `arm` beats one of another arm."""
    others = [other for other in scores if other != arm]
    rows = []
    for task in tasks:
        ours = _finite(scores[arm].get(task, {}))
        row = [task]
        for other in others:
            theirs = _finite(scores[other].get(task, {}))
            both = len(ours) and len(theirs)
            chance = stats.probability_of_improvement(ours, theirs) if both else None
            row.append(_MISSING if chance is None else f"{chance:.2f}")
        rows.append(row)
    return table([f"P({arm} > ...)", *others], rows)


def _finite(scores: Mapping[int, float]) -> np.ndarray:
    values = np.array(list(scores.values()), float)
    return values[np.isfinite(values)]


def differences(
    tasks: Sequence[str], scores: Scores, pairs: Iterable[tuple[str, str]]
) -> list[str]:
    """Returns the mean of one arm minus that of another, with Welch's interval."""
    rows = []
    for ours, theirs in pairs:
        row = [ours, theirs]
        for task in tasks:
            a, b = (_finite(scores[arm].get(task, {})) for arm in (ours, theirs))
            found = stats.difference(a, b) if len(a) and len(b) else None
            row.append(_MISSING if found is None else _difference(found))
        rows.append(row)
    return table(["mean of", "minus that of", *tasks], rows)


def _difference(found: stats.Difference) -> str:
    text = format_number(found.mean)
    if found.ci95 is None:
        return text
    low, high = map(format_number, found.ci95)
    return f"{text} [{low}, {high}]"


def variants(
    tasks: Sequence[str], scores_at: Mapping[tuple[str, str, int, str], Scores]
) -> list[str]:
    """Returns zero-shot scores by tag, arm, explored trials and steps of a trial."""
    rows = []
    for (tag, arm, explored, steps), scores in sorted(scores_at.items()):
        by_task = scores[arm]
        cells = [cell(by_task.get(task, {}), full=True) for task in tasks]
        seeds = sorted({seed for task in by_task.values() for seed in task})
        told = [tag, arm, str(explored), steps, " ".join(map(str, seeds))]
        rows.append([*told, *cells])
    header = ["variant", "arm", "explored trials", "steps of a trial", "seeds"]
    return table([*header, *tasks], rows)


def by_trials(tasks: Sequence[str], scores_at: Mapping[int, Scores]) -> list[str]:
    """Returns zero-shot scores by the number of exploration trials."""
    arms = in_order({arm for scores in scores_at.values() for arm in scores})
    rows = [
        [arm, str(trials), *(cell(scores[arm].get(task, {})) for task in tasks)]
        for arm in arms
        for trials, scores in sorted(scores_at.items())
        if arm in scores
    ]
    return table(["arm", "explored trials", *tasks], rows)


def fine_tuning(task: str, tuning: Mapping[str, Points]) -> list[str]:
    """Returns returns by trial and arm."""
    trials = sorted({trial for by_trial in tuning.values() for trial in by_trial})
    rows = [
        [str(trial), *(cell(by_trial.get(trial, {})) for by_trial in tuning.values())]
        for trial in trials
    ]
    return [f"{task}:", "", *table(["trial", *tuning], rows)]


def ablation(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Returns mean zero-shot returns of recipes that were tried.

    Args:
      rows: with the texts `exploration`, `refit` and `search`, `seeds`, and `returns`
        by task: a list of returns per seed.
    """
    lines = []
    for row in rows:
        means = [
            format_number(float(np.mean(np.concatenate(row["returns"][t]))))
            for t in TASKS
        ]
        seeds = " ".join(map(str, row["seeds"]))
        lines.append([row["exploration"], row["refit"], row["search"], seeds, *means])
    return table(["exploration", "refit", "search", "seeds", *TASKS], lines)


def measures(by_arm: Mapping[str, Mapping[int, Mapping[str, float]]]) -> list[str]:
    """Returns any measures of seeds: arms by measures, which all seeds have."""
    columns = list(
        dict.fromkeys(x for s in by_arm.values() for m in s.values() for x in m)
    )
    rows = [
        [arm, *(cell({seed: m[name] for seed, m in seeds.items()}) for name in columns)]
        for arm, seeds in by_arm.items()
    ]
    return table(["arm", *columns], rows)


def pairs(by_model: Mapping[str, Mapping[str, Mapping[str, Any] | None]]) -> list[str]:
    """Returns a measure of models on data: the model's arm by the data's arm.

    Args:
      by_model: by both arms the mean, std and number of pairs, or None without a pair;
        None for a number is one that is not finite.
    """
    arms = in_order(by_model)
    rows = [
        [model, *(_pairs(by_model[model][data]) for data in arms)] for model in arms
    ]
    return table(["model of", *(f"data of {arm}" for arm in arms)], rows)


def _pairs(entry: Mapping[str, Any] | None) -> str:
    if entry is None:
        return "no pair"
    if entry["mean"] is None:
        return "not finite"
    spread = "" if entry["std"] is None else f" ± {entry['std']:.2g}"
    count = "1 pair" if entry["pairs"] == 1 else f"{entry['pairs']} pairs"
    return f"{entry['mean']:.3g}{spread} ({count})"


def seconds(by_run: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """Returns the median seconds of a trial by run; an item per trial."""
    rows = []
    for run, trials in by_run.items():
        parts = [
            _median([trial["seconds"].get(part) for trial in trials])
            for part in ("act", "fit")
        ]
        total = [
            sum(x for x in trial["seconds"].values() if x is not None)
            for trial in trials
        ]
        seeds = str(max(len(trial["seeds"]) for trial in trials))
        rows.append([run, seeds, str(len(trials)), *parts, _median(total)])
    header = ["run", "seeds at once", "trials", "act", "fit", "together"]
    return table(header, rows)


def _median(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.median(known):.2f}" if known else "not logged"


def environments(runs: Mapping[str, Path]) -> list[str]:
    """Returns device and versions, as env.json says, and how each run stands."""
    groups: dict[str, list[list[str]]] = {}
    for run, folder in runs.items():
        env = flat(rundir.find_json(folder / rundir.ENVIRONMENT))
        text = ", ".join(f"{k} {v}" for k, v in env.items() if v not in (None, ""))
        status = rundir.find_json(folder / rundir.STATUS)
        state, time = (str(status.get(k, "not logged")) for k in ("state", "time"))
        groups.setdefault(text, []).append([f"`{run}`", state, time])
    lines = []
    for text, rows in groups.items():
        lines += [f"{text or 'Without env.json'}:", ""]
        lines += table(["run", "state", "time of that"], rows)
    return lines
