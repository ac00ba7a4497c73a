"""`python -m experiments.tools.suite RUNS`: the suite's twenty tasks, beside others'.

Reads the zero-shot logs of `dmc/...` robots, or the file of results that was made of
them, and prints a table in Markdown: means over seeds with 95 % intervals, means of the
tasks, and what others have published. If an arm lacks tasks, a row has the means of
those that every arm has. With `--than ARM` the arms are those that have all its tasks.
"""

import argparse
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import calling, robots, signals
from ..config import Config
from ..errors import RunError, UsageError, last_line, storage_errors
from ..report import logs, stats, tables
from ..storage import rundir
from . import peers, suite_figure

# Of Plan2Explore's ten domains. A finger that spins has another damping: two robots.
TASKS = {
    "acrobot": ("swingup",),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance-sparse", "swingup", "swingup-sparse"),
    "cheetah": ("run",),
    "finger": ("turn-easy", "turn-hard"),
    "finger-spin": ("spin",),
    "hopper": ("stand", "hop"),
    "pendulum": ("swingup",),
    "quadruped": ("walk", "run"),
    "reacher": ("easy", "hard"),
    "walker": ("stand", "walk", "run"),
}
# On whose development seeds the settings of `dmc20.toml` were chosen.
CHOSEN_ON = ("ball_in_cup", "cartpole", "cheetah", "pendulum", "walker")


def _name(domain: str, task: str) -> str:
    return f"{domain.partition('-')[0]}/{task}"


NAMES = tuple(_name(domain, task) for domain in TASKS for task in TASKS[domain])
_CHOSEN = tuple(x for x in NAMES if x.partition("/")[0] in CHOSEN_ON)
_HALVES = {
    "domains that settings were chosen on": _CHOSEN,
    "the other domains": tuple(x for x in NAMES if x not in _CHOSEN),
}
_FIGURES = (".png", ".svg", ".pdf")
Results = dict[str, dict[str, dict[str, Any]]]  # arm -> domain/task -> numbers


def main(argv: Sequence[str] | None = None) -> int:
    """Writes the results, and prints the table; returns an exit code."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("tools.suite"), description=__doc__
    )
    words = "a folder with runs below it, or a file of results; "
    words += "arms of a second one are named after it"
    parser.add_argument("runs", type=Path, nargs="+", help=words)
    words = "exploration trials; by default the most"
    parser.add_argument("--explored", type=int, help=words)
    parser.add_argument("--tag", default="", help="the variant of phase 2")
    parser.add_argument(
        "--peers", type=Path, default=peers.FILE, help="others' numbers"
    )
    parser.add_argument("--json", type=Path, help="file for the results")
    parser.add_argument("--figure", type=Path, help="file for them as a figure")
    words = "also by how much the others return more than this one"
    parser.add_argument("--than", metavar="ARM", help=words)
    args = parser.parse_args(argv)
    try:
        if args.figure is not None and args.figure.suffix not in _FIGURES:
            valid = f"it must end in {', '.join(_FIGURES)}"
            raise UsageError(f"--figure {args.figure} is not valid; {valid}.")
        found: Results = {}
        variant = args.explored, args.tag
        if variant != (None, "") and all(path.is_file() for path in args.runs):
            flags = "--explored and --tag choose among runs"
            raise UsageError(f"{flags}; {args.runs[0]} is a file of results.")
        for path, name in zip(args.runs, suffixes(args.runs), strict=True):
            own = read(path) if path.is_file() else results(path, *variant)
            found |= {arm + name: x for arm, x in own.items()}
        others = peers.read(args.peers)
        if args.than is not None and args.than not in found:
            raise UsageError(f"--than {args.than}: it is none of {', '.join(found)}.")
        if args.json is not None:
            with storage_errors(f"write {args.json}"):
                rundir.write_json(args.json, found)
        if args.figure is not None:
            with storage_errors(f"write {args.figure}"):
                labels = peers.labels(others)
                suite_figure.draw(args.figure, found, others.returns, labels, _HALVES)
    except RunError as error:
        signals.say(last_line(error))
        return error.exit_code
    if args.than is None:
        lines = table(found, others)
    else:
        has = found[args.than].keys()
        arms = {x: own for x, own in found.items() if own.keys() >= has}
        lines = [*table(arms, others), "", *differences(arms, args.than)]
    print("\n".join(lines))
    return 0


def suffixes(paths: Sequence[Path]) -> list[str]:
    """Returns what is added to the arms of folders and files, to the first's nothing.

    That is the name of each, or its path where another one has that name.

    Raises:
      UsageError: if one is there twice.
    """
    own = [path.stem if path.is_file() else path.resolve().name for path in paths]
    pairs = list(zip(paths, own, strict=True))[1:]
    added = [str(path) if own[1:].count(x) > 1 else x for path, x in pairs]
    if len(set(added)) < len(added):
        raise UsageError("the same folder or file is given twice; give each once.")
    return ["", *(f", {name}" for name in added)]


def results(runs: Path, explored: int | None, tag: str) -> Results:
    """Returns the mean, the interval and each seed's mean, by arm and task.

    Args:
      runs: a folder with runs below it.
      explored: for models that explored so many trials; None: the most of all.
      tag: of the variant of phase 2; empty for the one without.

    Raises:
      RunError: if a log cannot be read, or none has such a task.
    """
    rows = [row for row in logs.load(runs) if row.tag == tag]
    if explored is None:
        explored = max((x.explored for x in rows if x.phase == "zero-shot"), default=0)
    configs = {run: logs.config(run) for run in {row.run for row in rows}}
    found: Results = {}
    for domain, tasks in TASKS.items():
        env = f"dmc/{domain}"
        own = [row for row in rows if configs[row.run].get("env") == env]
        for arm, scores in logs.scores(own, explored).items():
            steps = explored * _trial_steps(configs[own[0].run])
            for task in tasks:
                if task in scores:
                    own_numbers = numbers(scores[task], steps)
                    found.setdefault(arm, {})[_name(domain, task)] = own_numbers
    if not found:
        which = f" as variant {tag}" * bool(tag)
        which += f" after {explored} trials" * bool(explored)
        raise UsageError(f"no run in {runs} has performed tasks of the suite{which}.")
    return found


def table(found: Results, others: peers.Peers) -> list[str]:
    """Returns the tasks as rows: our arms, then others after fewest and most steps."""
    arms = tables.in_order(found)
    columns = [(x, i) for x in others.systems for i in peers.ENDS]
    lines = [
        [name, *(cell(found[arm].get(name)) for arm in arms)]
        + [f"{others.returns[x.name][name][i]:.0f}" for x, i in columns]
        for name in NAMES
    ]
    groups = {"**mean**": NAMES, **_HALVES}
    if 0 < len(common := _common(found)) < len(NAMES):
        groups[f"the {len(common)} tasks that every arm has"] = common
    for group, names in groups.items():
        theirs = [
            f"{statistics.mean(others.returns[x.name][name][i] for name in names):.0f}"
            for x, i in columns
        ]
        lines.append([group, *(_mean(found[arm], names) for arm in arms), *theirs])
    said = ("without", "with")
    about = [
        f"- {x.name} ({said[x.reward]} the reward): {x.source}. {x.about}"
        for x in others.systems
    ]
    header = [
        "task",
        *(f"`{x}`" for x in arms),
        *(peers.label(x, i) for x, i in columns),
    ]
    return [*tables.table(header, lines), *about]


def differences(found: Results, than: str) -> list[str]:
    """Returns returns of `than`, and how much more others have: tasks that all have."""
    others = [arm for arm in tables.in_order(found) if arm != than]
    common = _common(found)
    groups = {f"**mean** (of {len(common)})": common} if common else {}
    for group, names in _HALVES.items():
        if both := tuple(x for x in names if x in common):
            groups[f"{group} (of {len(both)})"] = both
    rows = {name: (cell(found[than][name]), (name,)) for name in common}
    rows |= {x: (_mean(found[than], names), names) for x, names in groups.items()}
    lines = [
        [label, own, *(_less(found[arm], found[than], names) for arm in others)]
        for label, (own, names) in rows.items()
    ]
    header = ["task", f"`{than}`", *(f"`{arm}` less `{than}`" for arm in others)]
    return tables.table(header, lines)


def _common(found: Results) -> tuple[str, ...]:
    """Returns the tasks that every arm has."""
    return tuple(x for x in NAMES if all(x in own for own in found.values()))


def read(path: Path) -> Results:
    """Reads a file of results.

    Raises:
      RunError: if it is not there, or is not one.
    """
    return rundir.read_as(path, Results, "results")


def _trial_steps(config: Mapping[str, Any]) -> int:
    """Returns the suite's control steps in a trial of exploration."""
    repeat = robots.of(Config(env=config["env"])).action_repeat
    return int(config["trial_length"]) * repeat


def numbers(scores: Mapping[int, float], steps: int) -> dict[str, Any]:
    """Returns mean, interval, each seed's mean or None; `steps` are of exploration."""
    summary = stats.summarize(np.array(list(scores.values()), float))
    interval = summary.ci95 if summary else None
    return {
        "mean": round(summary.mean, 1) if summary else None,
        "interval": [round(x, 1) for x in interval] if interval else None,
        "seeds": rundir.plain({seed: round(x, 1) for seed, x in scores.items()}),
        "steps": steps,
    }


def cell(found: Mapping[str, Any] | None) -> str:
    """Returns mean and interval of `numbers`, for a table."""
    if found is None:
        return "-"
    if found["mean"] is None:
        return "not finite"
    text = f"{found['mean']:.0f}"
    if found["interval"]:
        text += " [{:.0f}, {:.0f}]".format(*found["interval"])
    return text


def _mean(found: Mapping[str, Mapping[str, Any]], names: Sequence[str]) -> str:
    """Returns the mean of tasks, and of how many if some are missing.

    With an interval over seeds if tasks have the same; not finite if a task's is not.
    """
    own = [found[name] for name in names if name in found]
    if not own:
        return "-"
    means = [x["mean"] for x in own]
    mean = None if None in means else statistics.mean(means)
    text = cell({"mean": mean, "interval": stats.t_interval(_of_seeds(own))})
    return text if len(own) == len(names) else f"{text} (of {len(own)})"


def _less(
    ours: Mapping[str, Mapping[str, Any]], theirs: Mapping[str, Mapping[str, Any]],
    names: Sequence[str],
) -> str:  # fmt: skip
    """Returns the difference of two arms in a seed's mean of tasks, with Welch's."""
    one, other = (_of_seeds([x[name] for name in names]) for x in (ours, theirs))
    if not (len(one) and len(other)):
        return "-"
    found = stats.difference(one, other)
    return cell({"mean": found.mean, "interval": found.ci95})


def _of_seeds(own: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Returns each finite seed's mean of tasks, `[S]`; none if tasks have others."""
    seeds = {frozenset(y for y, z in x["seeds"].items() if z is not None) for x in own}
    same = sorted(seeds.pop()) if len(seeds) == 1 else []
    return np.array([statistics.mean(x["seeds"][y] for x in own) for y in same], float)


if __name__ == "__main__":
    signals.as_program(main)
