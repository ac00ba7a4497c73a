"""`python -m experiments.compare RUN RUN ...`: what differs between runs.

That is their settings, what they ran on, and their returns, in tables and a figure.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from . import calling, signals
from .config import Science, Variant
from .entries import entries
from .errors import RunError, UsageError, storage_errors
from .report import figures, logs, report, tables
from .report.logs import Row, Scores
from .storage import disk, rundir

_NOT_THERE = "not recorded"


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the tables and writes them beside a figure; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("compare"),
        description="Shows what differs between runs: settings, what they ran on, and "
        "returns.",
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="folder of an exploration run"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/compare"),
        help="folder for compare.md and compare.png; by default runs/compare",
    )  # fmt: skip
    args = parser.parse_args(argv)
    try:
        text = compared(_named(args.runs), args.out / "compare.png")
        path = args.out / "compare.md"
        disk.write(path, text.encode())
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(text.replace("<br>", " "))
    print(f"wrote {path} and {path.with_suffix('.png')}", file=sys.stderr)
    return 0


def compared(runs: Mapping[str, Path], picture: Path) -> str:
    """Draws runs by name, and returns the page about them, in Markdown.

    Raises:
      RunError: if one of them has no log, or cannot be read.
    """
    by_run = {
        name: [row._replace(arm=_label(name, row)) for row in logs.load(path)]
        for name, path in runs.items()
    }
    with storage_errors(f"make {picture.parent}"):
        disk.make(picture.parent)
    rows = [row for own in by_run.values() for row in own]
    configs = {name: tables.flat(logs.config(path)) for name, path in runs.items()}
    places = {
        name: tables.flat(rundir.find_json(path / rundir.ENVIRONMENT))
        for name, path in runs.items()
    }
    known = [entry.name for role in (Science, Variant) for entry in entries(role)]
    lines = ["# What differs", "", "## Settings", "", *_differing(configs, known)]
    every = list(dict.fromkeys(name for own in places.values() for name in own))
    lines += ["## What they ran on", "", *_differing(places, every)]
    lines += _returns(rows, picture)
    return "\n".join(lines)


def _named(paths: Sequence[Path]) -> dict[str, Path]:
    """Returns runs by the name of their folder, or by their path where two share it."""
    for path in paths:
        if not path.is_dir():
            raise UsageError(f"{path} is no folder of a run.")
    names = [path.resolve().name for path in paths]
    named = {
        str(path) if names.count(name) > 1 else name: path
        for name, path in zip(names, paths, strict=True)
    }
    if len(named) < max(len(paths), 2):
        raise UsageError("compare takes two runs or more, each once.")
    return named


def _label(name: str, row: Row) -> str:
    """Returns what stands in the place of an arm: the run, with its variant."""
    return f"{name}, {row.tag}" if row.tag else name


def _differing(
    by_run: Mapping[str, Mapping[str, Any]], names: Sequence[str]
) -> list[str]:
    """Returns a row for each entry that is not the same in all runs."""
    rows = []
    for name in names:
        values = [str(own.get(name, _NOT_THERE)) for own in by_run.values()]
        if len(set(values)) > 1:
            rows.append([f"`{name}`", *values])
    return tables.table(["", *by_run], rows) if rows else ["The same.", ""]


def _returns(rows: Sequence[Row], picture: Path) -> list[str]:
    """Returns the section on returns, and draws it."""
    last = _explored(rows)
    found: Scores = {}
    for name, explored in last.items():
        own = [row for row in rows if row.arm == name]
        found[name] = logs.scores(own, explored)[name]
    common = max(last.values(), default=max(row.trial for row in rows))
    shown = {name: own for name, own in found.items() if last[name] == common}
    figures.figure_4(picture, report.panels(rows, shown, common), common)
    lines = ["## Zero-shot returns", ""]
    if found:
        tasks = tables.tasks_of(rows)
        titled = {f"{name} ({last[name]} trials)": found[name] for name in found}
        first, *others = found
        pairs = [(other, first) for other in others]
        lines += [
            *tables.table_1(tasks, titled, with_paper=False),
            "Mean ± standard deviation over seeds, [95 % interval], of models after as "
            "many trials as stand above.",
            "",
            *tables.differences(tasks, found, pairs),
        ]
    else:
        lines += ["No run has performed.", ""]
    return [*lines, f"![returns]({picture.name})", ""]


def _explored(rows: Sequence[Row]) -> dict[str, int]:
    """Returns the trials behind the last model that each run has performed with."""
    last: dict[str, int] = {}
    for row in rows:
        if row.phase == "zero-shot":
            last[row.arm] = max(last.get(row.arm, 0), row.explored)
    return last


if __name__ == "__main__":
    signals.as_program(main)
