"""`python -m experiments.tools.effects RUNS`: what arms, refit and search each bring.

Reads the zero-shot logs of a study, whose variants are its tags, and prints tables in
Markdown. A score is a return over that of the simulator as the model, which
`experiments.tools.simulator --json` has measured. Beside it: what share of the steps
was upright, and the return over the value of the plans, which is that of their elites.
"""

import argparse
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from .. import calling, signals
from ..errors import RunError, UsageError, last_line, storage_errors
from ..report import logs, stats, tables
from ..storage import rundir
from ..storage.metrics import Row, number
from ..validate import require
from . import suite

UPRIGHT = "upright"  # a task that measures
_GROUPS = ("known tasks", "other tasks")
_AS_SET = "as the runs are set"
Results = dict[str, dict[str, dict[str, dict[str, Any]]]]  # variant, arm, task
Ceilings = dict[str, float]  # of a step, by task


class _Trial(msgspec.Struct):
    """What is read of a trial of the simulator; no return if physics diverged."""

    task: str
    steps: Annotated[int, msgspec.Meta(gt=0)]
    reward: float | None = msgspec.field(name="return")


_TRIAL = msgspec.json.Decoder(_Trial)


def main(argv: Sequence[str] | None = None) -> int:
    """Writes the results, and prints the tables; returns an exit code."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("tools.effects"), description=__doc__
    )
    words = "a folder with runs below it; arms of a second one are named after it"
    parser.add_argument("runs", type=Path, nargs="+", help=words)
    parser.add_argument("--ceilings", type=Path, required=True, help="the simulator's")
    parser.add_argument("--explored", type=int, default=60, help="exploration trials")
    parser.add_argument(
        "--than", default="best", metavar="ARM", help="the others are compared with it"
    )
    words = "known when settings were chosen, as walk,run; by default the paper's"
    parser.add_argument("--known", metavar="TASKS", help=words)
    parser.add_argument("--json", type=Path, help="file for the results")
    args = parser.parse_args(argv)
    try:
        rows = [
            row._replace(arm=row.arm + name)
            for folder, name in zip(args.runs, suite.suffixes(args.runs), strict=True)
            for row in logs.load(folder)
            if row.explored == args.explored
        ]
        found = results(rows, ceilings(args.ceilings))
        known = _known(args.known, found)
        if args.json is not None:
            with storage_errors(f"write {args.json}"):
                rundir.write_json(args.json, found)
    except RunError as error:
        signals.say(last_line(error))
        return error.exit_code
    print("\n".join(report(found, args.than, known)))
    return 0


def ceilings(path: Path) -> Ceilings:
    """Returns the simulator's mean reward of a step, by task.

    Raises:
      RunError: if the file cannot be read.
    """
    found: dict[str, list[float]] = {}
    try:
        lines = path.read_bytes().splitlines()
        for trial in map(_TRIAL.decode, lines):
            if trial.reward is not None:
                found.setdefault(trial.task, []).append(trial.reward / trial.steps)
    except (OSError, msgspec.MsgspecError) as error:
        raise UsageError(f"{path} has no trials of the simulator: {error}") from error
    return {task: float(np.mean(rewards)) for task, rewards in found.items()}


def results(rows: Iterable[Row], ceiling: Ceilings) -> Results:
    """Returns numbers by variant, arm and task; `score` is a share of the ceiling.

    Raises:
      UsageError: if nothing has performed, or a task has no ceiling above zero.
    """
    performed = [row for row in rows if row.phase == "zero-shot"]
    if not performed:
        raise UsageError("no run has performed after so many trials of exploration.")
    found: Results = {}
    for tag in sorted({row.tag for row in performed}):
        own = [row for row in performed if row.tag == tag]
        for arm, by_task in logs.scores(own, own[0].explored).items():
            of_arm = [row for row in own if row.arm == arm]
            config = logs.config(of_arm[0].run)
            explored = own[0].explored * int(config["trial_length"])
            for task, scores in by_task.items():
                if not ceiling.get(task, 0.0) > 0.0:
                    raise UsageError(f"the simulator has earned nothing for {task}.")
                length = int(config["task_length"])
                seen = [row for row in of_arm if row.task == task]
                found.setdefault(tag, {}).setdefault(arm, {})[task] = {
                    **suite.numbers(scores, explored),
                    **_beside(seen, length),
                    "score": {
                        str(seed): round(score / length / ceiling[task], 4)
                        for seed, score in scores.items()
                    },
                }
    return found


def _known(text: str | None, found: Results) -> Sequence[str]:
    if text is None:
        return tables.TASKS
    performed = {x for arms in found.values() for own in arms.values() for x in own}
    chosen = text.split(",")
    valid = f"some of {','.join(sorted(performed))}"
    require(performed.issuperset(chosen), "--known", text, valid)
    return chosen


def report(found: Results, than: str, known: Sequence[str]) -> list[str]:
    """Returns the tables: scores by arm and variant, differences, and every task.

    Args:
      found: as `results` has it.
      than: the arm that the others are compared with.
      known: tasks that are shown apart from the others.
    """
    arms = tables.in_order({arm for by_arm in found.values() for arm in by_arm})
    lines: list[str] = []
    for group, chosen in zip(_GROUPS, (True, False), strict=True):
        scores = {
            tag: {
                arm: _by_seed({y: x[y] for y in x if (y in known) is chosen})
                for arm, x in by_arm.items()
            }
            for tag, by_arm in found.items()
        }
        lines += [f"## {group}", "", *_by_variant(scores, arms, _iqm)]
        lines += [f"## {group}, less `{than}`, %", ""]
        others = [arm for arm in arms if arm != than]
        lines += _by_variant(_less(scores, than), others, _interval)
    lines += ["## share of upright steps, and return over the value of the plans", ""]
    lines += _by_variant(found, arms, _shares)
    lines += ["## one variant less another, %", "", *_effects(found, arms)]
    for tag, by_arm in found.items():
        lines += [f"## every task, {tag or _AS_SET}", "", *_every(by_arm)]
    return lines


def _by_variant(
    found: Mapping[str, Mapping[str, Any]], arms: Iterable[str],
    cell: Callable[[Any], str],
) -> list[str]:  # fmt: skip
    """Returns a table of arms by variants."""
    rows = [
        [f"`{arm}`", *(cell(x[arm]) if arm in x else "-" for x in found.values())]
        for arm in arms
    ]
    return tables.table(["arm", *(tag or _AS_SET for tag in found)], rows)


def _less(
    scores: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]], than: str
) -> dict[str, dict[str, stats.Difference]]:
    """Returns how far arms are from one of them, in means over tasks of seeds."""
    apart: dict[str, dict[str, stats.Difference]] = {}
    for tag, by_arm in scores.items():
        means = {
            arm: 100.0 * np.mean(list(by_seed.values()), axis=1)
            for arm, by_seed in by_arm.items()
            if by_seed
        }
        apart[tag] = {
            arm: stats.difference(mean, means[than])
            for arm, mean in means.items()
            if arm != than and than in means
        }
    return apart


def _beside(rows: Sequence[Row], length: int) -> dict[str, Any]:
    """Returns the share of upright steps, and of what was planned the share that came.

    Of all trials together: a trial that plans nothing has no share of its own.
    """
    planned = sum(number(row.data["value"]) * length for row in rows)
    came = sum(number(row.data["return"]) for row in rows)
    measures = {"kept": round(came / planned, 3) if planned > 0 else None}
    if all(UPRIGHT in row.data["returns"] for row in rows):
        upright = [number(row.data["returns"][UPRIGHT]) / length for row in rows]
        measures[UPRIGHT] = round(float(np.mean(upright)), 3)
    return measures


def _shares(by_task: Mapping[str, Mapping[str, Any]]) -> str:
    """Returns means over tasks of what is beside a score; `upright` is no task here."""
    tasks = [x for name, x in by_task.items() if name != UPRIGHT]
    return ", ".join(_mean(x.get(measure) for x in tasks) for measure in _BESIDE)


_BESIDE = (UPRIGHT, "kept")


def _mean(values: Iterable[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.2f}" if known else "-"


def _by_seed(by_task: Mapping[str, Mapping[str, Any]]) -> dict[str, list[float]]:
    """Returns the scores of tasks by seed, of seeds that performed all."""
    chosen = [x for name, x in by_task.items() if name != UPRIGHT]
    seeds = set.intersection(*(set(x["score"]) for x in chosen)) if chosen else set()
    every = {seed: [x["score"][seed] for x in chosen] for seed in sorted(seeds)}
    return {seed: scores for seed, scores in every.items() if np.isfinite(scores).all()}


def _iqm(by_seed: Mapping[str, Sequence[float]]) -> str:
    """Returns the interquartile mean of scores over tasks and seeds."""
    if not by_seed:
        return "-"
    scores = np.array(list(by_seed.values())).T
    low, high = stats.stratified_interval(scores)
    return f"{float(stats.iqm(scores.reshape(-1))):.2f} [{low:.2f}, {high:.2f}]"


def _effects(found: Results, arms: Sequence[str]) -> list[str]:
    """Returns differences of a seed's mean score over tasks between two variants.

    The two have their model in common, so a seed's difference is one number.
    """
    pairs = [
        (one, other)
        for other, one in itertools.combinations(found, 2)
        if _one_apart(one, other)
    ]

    def cell(arm: str, one: str, other: str) -> str:
        if not (arm in found[one] and arm in found[other]):
            return "-"
        ours, theirs = (_by_seed(found[tag][arm]) for tag in (one, other))
        both = [seed for seed in ours if seed in theirs]
        if not both:
            return "-"
        gaps = np.array([np.mean(ours[x]) - np.mean(theirs[x]) for x in both])
        gaps *= 100.0
        return _interval(stats.Difference(float(gaps.mean()), stats.t_interval(gaps)))

    return tables.table(
        ["variant", "less", *(f"`{arm}`" for arm in arms)],
        [
            [one, other, *(cell(arm, one, other) for arm in arms)]
            for one, other in pairs
        ],
    )


def _interval(found: stats.Difference) -> str:
    beside = " [{:.1f}, {:.1f}]".format(*found.ci95) if found.ci95 else ""
    return f"{found.mean:.1f}{beside}"


def _every(by_arm: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> list[str]:
    """Returns the returns of every task, and their intervals."""
    arms = tables.in_order(by_arm)
    tasks = dict.fromkeys(task for x in by_arm.values() for task in x)
    return tables.table(
        ["task, return", *(f"`{arm}`" for arm in arms)],
        [
            [task, *(suite.cell(by_arm[arm].get(task)) for arm in arms)]
            for task in tables.tasks_in_order(tasks)
        ],
    )


def _one_apart(one: str, other: str) -> bool:
    """Returns whether one word of a variant's was added to the other's, or changed."""
    ours, theirs = set(one.split("-")), set(other.split("-"))
    return max(len(ours - theirs), len(theirs - ours)) == 1


if __name__ == "__main__":
    signals.as_program(main)
