"""What a reader of the report must know: what is missing, unequal or not finite."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from ..config import Config, Evaluation, Exploration, Mark, Science, Tuning
from ..entries import entries
from ..storage import rundir
from .logs import Row, Scores, number
from .tables import ARMS, flat, in_order, tasks_of

# What a phase depends on; the rest it keeps in its config for the phases after it.
_DEPENDS_ON = {
    "explore": (Exploration,),
    "zero-shot": (Exploration, Evaluation),
    "finetune": (Exploration, Evaluation, Tuning),
    "distill": (Science,),
}


def sentences(rows: Sequence[Row], found: Scores, explored: int) -> list[str]:
    """Returns sentences on the logs of one preset.

    Args:
      rows: of that preset.
      found: the zero-shot scores of Table 1.
      explored: the exploration trials that Table 1 is about.
    """
    return [
        *_trials(rows),
        *_missing(rows, found, explored),
        *_not_finite(rows),
        *_diverged(rows),
        *_torn({row.run for row in rows}),
        *_robots({row.run: row.phase for row in rows}),
        *_unequal({row.run: row.phase for row in rows}),
    ]


def _trials(rows: Sequence[Row]) -> Iterator[str]:
    """Says how far each arm explored and how often it was evaluated."""
    for arm in in_order({row.arm for row in rows}):
        own = [row for row in rows if row.arm == arm]
        done: dict[int, int] = {}
        for row in own:
            if row.phase == "explore":
                done[row.seed] = max(done.get(row.seed, 0), row.trial)
        groups = [
            f"{trials} trials (seeds {_list(seed for seed, _ in items)})"
            for trials, items in _grouped(done)
        ]
        explored = (
            "explored " + " and ".join(groups) if groups else "no log of exploring"
        )
        evaluations = Counter(
            (row.explored, row.seed, row.task)
            for row in own
            if row.phase == "zero-shot"
        )
        counts = sorted(set(evaluations.values()))
        evaluated = f"; {_list(counts)} zero-shot trials per seed and task" * bool(
            counts
        )
        yield f"`{arm}`: {explored}{evaluated}."


def _grouped(done: dict[int, int]) -> Iterator[tuple[int, list[tuple[int, int]]]]:
    pairs = sorted(done.items(), key=lambda pair: (-pair[1], pair[0]))
    for trials, items in groupby(pairs, key=lambda pair: pair[1]):
        yield trials, list(items)


def _list(items: Iterable[object]) -> str:
    return ", ".join(map(str, items))


def _missing(rows: Sequence[Row], found: Scores, explored: int) -> Iterator[str]:
    """Says which arms, tasks and seeds Table 1 and Figure 4 lack."""
    arms = {row.arm for row in rows}
    absent = [
        arm
        for arm in ARMS[:4]  # those of the paper
        if arm not in arms and not any(a.startswith(f"{arm}-") for a in arms)
    ]
    if absent:
        yield f"Missing: no log of {_list(absent)}."
    none, every = f"no zero-shot after {explored} trials", tasks_of(rows)
    for arm in in_order(arms):
        seeds = {row.seed for row in rows if row.arm == arm}
        lacks = [task for task in every if not found.get(arm, {}).get(task)]
        if lacks:
            yield f"Missing: `{arm}` has {none} on {_list(lacks)}."
        tasks_without: dict[tuple[int, ...], list[str]] = {}
        for task in (task for task in every if task not in lacks):
            left = tuple(sorted(seeds - set(found[arm][task])))
            tasks_without.setdefault(left, []).append(task)
        for left, tasks in tasks_without.items():
            if left:
                of = f"on {_list(tasks)} of seeds {_list(left)}"
                yield f"Missing: `{arm}` has {none} {of}."
    tuned = {
        row.arm for row in rows if row.phase == "finetune" and row.explored == explored
    }
    untuned = in_order(arms - tuned)
    if untuned:
        yield f"Missing: no fine-tuning after {explored} trials of {_list(untuned)}."


def _not_finite(rows: Sequence[Row]) -> Iterator[str]:
    """Counts the returns that the tables leave out."""
    for arm in in_order({row.arm for row in rows}):
        for phase in _DEPENDS_ON:
            own = [r.data for r in rows if (r.arm, r.phase) == (arm, phase)]
            if phase == "explore":
                values = [
                    x for data in own for x in (data.get("returns") or {}).values()
                ]
            else:
                values = [data["return"] for data in own]
            bad = sum(not np.isfinite(number(value)) for value in values)
            if bad:
                share = f"{bad} of {len(values)} returns"
                yield f"`{arm}`: {share} of {phase} are not finite; left out."


def _diverged(rows: Sequence[Row]) -> Iterator[str]:
    """Counts the trials that ended where physics diverged."""
    trials = Counter((row.arm, row.phase) for row in rows)
    lost: dict[tuple[str, str], list[int]] = {}
    for row in rows:
        if count := row.data.get("lost_steps"):
            lost.setdefault((row.arm, row.phase), []).append(count)
    for (arm, phase), counts in sorted(lost.items()):
        share = f"{len(counts)} of {trials[arm, phase]} trials of {phase}"
        yield (
            f"`{arm}`: physics diverged in {share}; {sum(counts)} steps are lost, and "
            "returns count what was earned before."
        )


def _torn(runs: Iterable[Path]) -> Iterator[str]:
    for run in sorted(runs):
        if not (run / rundir.METRICS).read_bytes().endswith(b"\n"):
            yield f"The last line of {run.name}/metrics.jsonl is cut off; left out."


def _robots(runs: dict[Path, str]) -> Iterator[str]:
    """Says if robots that share a name, as two files may, observe other things."""
    found: dict[tuple[str, ...], set[str]] = {}
    for run, phase in runs.items():
        entries = rundir.find_json(run / rundir.IDENTITY).get("entries")
        if isinstance(entries, list):
            names = found.setdefault(tuple(map(str, entries)), set())
            names.add(_label(run, phase))
    if len(found) > 1:
        each = "; ".join(_list(sorted(names)) for names in found.values())
        yield f"Unequal robots, which observe other entries: {each}."


def _label(run: Path, phase: str) -> str:
    """Returns the name of the exploration that a run is, or is in."""
    return run.name if phase == "explore" else run.parent.name


def _unequal(runs: dict[Path, str]) -> Iterator[str]:
    """Says which settings differ between runs of a phase that share a table."""
    for phase in sorted(set(runs.values())):
        settings = _settings(phase)
        values: dict[str, dict[str, set[str]]] = {}
        labels = set()
        for run in sorted(run for run in runs if runs[run] == phase):
            label = _label(run, phase)
            labels.add(label)
            for name, value in flat(rundir.find_json(run / rundir.CONFIG)).items():
                if settings.get(name, True):
                    by_value = values.setdefault(name, {})
                    by_value.setdefault(str(value), set()).add(label)
        for name, by_value in values.items():
            if len(by_value) > 1:
                if silent := labels.difference(*by_value.values()):
                    by_value["not recorded"] = silent
                each = "; ".join(
                    f"{v} ({_list(sorted(r))})" for v, r in by_value.items()
                )
                yield f"Unequal settings in {phase}: {name} is {each}."


def _settings(phase: str) -> dict[str, bool]:
    """Tells of every entry of a config if it says how the numbers of a phase came."""
    found = dict.fromkeys((entry.name for entry in entries(Config)), False)
    for role in _DEPENDS_ON[phase]:
        for entry in entries(role):
            found[entry.name] = Mark.COUNTED not in entry.marks
    found["policy"] = phase == "zero-shot"  # which a search then begins with
    return found
