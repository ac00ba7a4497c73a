"""What a bench has tried so far, in a file: a line of JSON per fault."""

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path

from faults.lab import Fault, Outcome

Name = tuple[str, str, int]  # what a fault is known by: kind, phase, number


def name(fault: Fault) -> Name:
    return fault.kind, fault.phase, fault.at


def tried(outcomes: Iterable[Outcome]) -> set[Name]:
    return {name(outcome.fault) for outcome in outcomes}


def add(file: Path, outcome: Outcome) -> None:
    """Writes an outcome at the end of a file; what a lost one said is kept."""
    kind, phase, at = name(outcome.fault)
    row = {"kind": kind, "phase": phase, "at": at, "met": outcome.met}
    row |= {"code": outcome.code, "wrong": outcome.wrong}
    row["said"] = outcome.said if outcome.wrong else ""
    with file.open("a") as to:
        print(f"\n{json.dumps(row)}", end="", file=to)  # a torn line ends here at least


def read(file: Path) -> list[Outcome]:
    """Returns what is in a file, if there is one; a torn line is left out."""
    outcomes = []
    for line in file.read_text().splitlines() if file.exists() else []:
        with contextlib.suppress(ValueError):  # no JSON
            row = json.loads(line)
            fault = Fault(row["kind"], row["phase"], at=row["at"])
            found = (row[field] for field in ("met", "wrong", "code", "said"))
            outcomes.append(Outcome(fault, *found))
    return outcomes
