"""Reads the logs of runs, and picks scores and curves out of them."""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.errors import UsageError

Points = dict[int, dict[int, float]]  # trial -> seed -> number
Scores = dict[str, dict[str, dict[int, float]]]  # arm -> task -> seed -> score


class Row(NamedTuple):
    """A line of metrics.jsonl, with what its run says about it."""

    preset: str
    arm: str  # with the number of bits for count: count-32
    phase: str
    seed: int
    task: str  # empty while exploring
    trial: int
    explored: int  # exploration trials behind the model; 0 while exploring
    tag: str  # of a variant of phase 2; empty for the one that Table 1 counts
    data: dict[str, Any]
    run: Path  # folder of the log


def load(out: Path) -> list[Row]:
    """Reads every metrics.jsonl under a folder, hidden ones left out.

    A last line without its end is left out too: a run is writing it, or was killed
    while it did. So is what a run did for one task where it did the same for all.

    Raises:
      UsageError: if there is no log, a line that is no row, or two rows for one seed,
        task and trial of an arm: averaging them would count a seed twice.
    """
    logs = files(out, "metrics.jsonl")
    rows = [row for log in logs if not _is_part(log) for row in _read(log)]
    if not rows:
        raise UsageError(f"there is no metrics.jsonl with a row under {out}.")
    seen: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        first = seen.setdefault(row[:-2], row)
        if first is not row:
            task = f", task {row.task}" if row.task else ""
            raise UsageError(
                f"{first.run} and {row.run} both hold trial {row.trial} of seed "
                f"{row.seed}{task}, phase {row.phase}, arm {row.arm}, preset "
                f"{row.preset}; move one of them elsewhere."
            )
    return rows


def files(out: Path, name: str) -> list[Path]:
    """Returns the files of a name at any depth under a folder but for hidden ones."""
    return [
        path
        for path in sorted(out.rglob(name))
        if not any(part.startswith(".") for part in path.relative_to(out).parts)
    ]


def label(arm: str, config: Mapping[str, Any]) -> str:
    """Returns what the report calls an arm: count has its number of bits, count-32."""
    if arm == "count" and "num_bits" in config:
        return f"count-{config['num_bits']}"
    return arm


def _is_part(log: Path) -> bool:
    """Tells if the folder beside this one has done all tasks, this one among them."""
    folder = log.parent
    task = read_json(folder / "config.json").get("task", "all")
    if task == "all":
        return False
    whole = folder.with_name(folder.name.replace(f"-{task}", "", 1)) / log.name
    return whole != log and whole.exists() and whole.stat().st_size > 0


def _read(log: Path) -> Iterator[Row]:
    config = read_json(log.parent / "config.json")
    lines = log.read_text().splitlines(keepends=True)
    for i, line in enumerate(lines, 1):
        if not line.endswith("\n"):
            return
        try:
            yield _row(json.loads(line), config, log.parent)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(f"{log}:{i} is no row of a run ({error!r}).") from error


def _row(data: dict[str, Any], config: dict[str, Any], run: Path) -> Row:
    exploring = data["phase"] == "explore"
    return Row(
        preset=config["preset"],
        arm=label(data["arm"], config),
        phase=data["phase"],
        seed=int(data["seed"]),
        task="" if exploring else data["task"],
        trial=int(data["trial"]),
        explored=0 if exploring else int(data["explored_trials"]),
        tag=config.get("tag") or "",
        data=data,
        run=run,
    )


def read_json(path: Path) -> dict[str, Any]:
    """Returns the object in a file, or an empty one if there is none to read."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def number(value: Any) -> float:
    """Returns a logged number; null, which stands for one not finite, is NaN."""
    return float("nan") if value is None else float(value)


def named_by_tag(rows: Iterable[Row]) -> list[Row]:
    """Returns the rows with their variant in the name of the arm: `best, no-refit`."""
    return [
        row._replace(arm=f"{row.arm}, {row.tag}") if row.tag else row for row in rows
    ]


def scores(rows: Iterable[Row], explored: int) -> Scores:
    """Returns zero-shot scores of models that explored so many trials.

    A seed's score is the mean of its finite returns; NaN if it has none.
    """
    returns: dict[tuple[str, str, int], list[float]] = {}
    for row in rows:
        if row.phase == "zero-shot" and row.explored == explored:
            own = returns.setdefault((row.arm, row.task, row.seed), [])
            own.append(number(row.data["return"]))
    found: Scores = {}
    for (arm, task, seed), values in sorted(returns.items()):
        finite = [value for value in values if np.isfinite(value)]
        score = float(np.mean(finite)) if finite else float("nan")
        found.setdefault(arm, {}).setdefault(task, {})[seed] = score
    return found


def tuning(rows: Iterable[Row], task: str, explored: int) -> dict[str, Points]:
    """Returns the returns of fine-tuning by arm, each by trial and seed."""
    found: dict[str, Points] = {}
    for row in rows:
        if (row.phase, row.task, row.explored) == ("finetune", task, explored):
            by_trial = found.setdefault(row.arm, {}).setdefault(row.trial, {})
            by_trial[row.seed] = number(row.data["return"])
    return found


def exploring(rows: Iterable[Row], *names: str) -> dict[str, Points]:
    """Returns a number of every exploration trial by arm, each by trial and seed.

    Args:
      rows: of any phases.
      names: where the number is in the row, from the outside to the inside. Arms that
        never have it are left out.
    """
    found: dict[str, Points] = {}
    for row in rows:
        if row.phase == "explore":
            value: Any = row.data
            for name in names:
                value = (value or {}).get(name)
            by_trial = found.setdefault(row.arm, {}).setdefault(row.trial, {})
            by_trial[row.seed] = number(value)
    return {
        arm: points
        for arm, points in found.items()
        if any(np.isfinite(x) for by_seed in points.values() for x in by_seed.values())
    }
