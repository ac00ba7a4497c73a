"""Reads the logs of runs, and picks scores and curves out of them."""

from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from ..errors import CheckpointError, UsageError
from ..storage import metrics, rundir
from ..storage.metrics import Row, number
from ..storage.rundir import Name

Points = dict[int, dict[int, float]]  # trial -> seed -> number
Scores = dict[str, dict[str, dict[int, float]]]  # arm -> task -> seed -> score


_Tasks = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._,-]{0,999}\Z")]


class _Labels(msgspec.Struct):
    """What the report reads of a config; some of it gets into names of files."""

    preset: Name
    env: str = rundir.HALF_CHEETAH
    arm: str = "epistemic"
    task: _Tasks = "all"
    tag: Name | None = None
    num_bits: int = 0


def load(out: Path) -> list[Row]:
    """Reads every metrics.jsonl under a folder, hidden ones left out.

    Lines that are no rows are left out too, as `metrics.read` says. So is what a run
    did for some tasks where it did the same for others as well.

    Raises:
      UsageError: if there is no log, or two rows for one seed, task and trial of an
        arm: averaging them would count a seed twice.
      CheckpointError: as `config`.
    """
    logs = {log: config(log.parent) for log in files(out, rundir.METRICS)}
    parts = {log.parent for log, own in logs.items() if _is_part(log, own)}
    whole_first = sorted(logs, key=lambda log: log.parent in parts)
    rows = [row for log in whole_first for row in metrics.read(log, logs[log])]
    if not rows:
        raise UsageError(f"there is no metrics.jsonl with a row under {out}.")
    seen: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        first = seen.setdefault(row[:-2], row)
        if first is not row and not _is_again(row, first, parts):
            task = f", task {row.task}" if row.task else ""
            raise UsageError(
                f"{first.run} and {row.run} both hold trial {row.trial} of seed "
                f"{row.seed}{task}, phase {row.phase}, arm {row.arm}, preset "
                f"{row.preset}; move one of them elsewhere."
            )
    return list(seen.values())


def files(out: Path, name: str) -> list[Path]:
    """Returns the files of a name at any depth under a folder but for hidden ones.

    A run in it may be a link to a folder elsewhere, as on a larger disk.
    """
    whole = out.resolve()
    links = (x for x in out.glob("*") if x.is_symlink() and x.is_dir())
    roots = [out, *(x for x in links if not x.resolve().is_relative_to(whole))]
    return [
        path
        for path in sorted(path for root in roots for path in root.rglob(name))
        if not any(part.startswith(".") for part in path.relative_to(out).parts)
    ]


def _is_again(row: Row, first: Row, parts: Container[Path]) -> bool:
    """Tells if a row is of a task that the same run performed among others before."""
    if row.phase == "explore" or row.run.parent != first.run.parent:
        return False
    one, other = ({**x.data, "seconds": None} for x in (row, first))
    return row.run in parts or one == other


def _is_part(log: Path, own: Mapping[str, Any]) -> bool:
    """Tells if the folder beside that of a log has done all tasks, these among them."""
    folder, task = log.parent, own.get("task", "all")
    if task == "all":
        return False
    part = f"-{rundir.label(task)}"
    whole = folder.with_name(folder.name.replace(part, "", 1)) / log.name
    return whole != log and whole.exists() and whole.stat().st_size > 0


def config(folder: Path) -> dict[str, Any]:
    """Returns the config of a run, in JSON.

    Raises:
      CheckpointError: if there is none, or one that no run can have.
    """
    path = folder / rundir.CONFIG
    found = rundir.read_json(path)
    try:
        msgspec.convert(found, _Labels)
    except msgspec.ValidationError as error:
        raise CheckpointError(
            f"{path} is no config of a run ({error}). Restore it, or move its folder "
            "elsewhere."
        ) from None
    return found


def steps(rows: Iterable[Row], name: str) -> str:
    """Returns how many steps the rows' trials have, as `250`; empty if none says so.

    Args:
      rows: of any runs.
      name: the entry of their configs: `trial_length` or `task_length`.
    """
    runs = {row.run for row in rows}
    told = (rundir.find_json(run / rundir.CONFIG).get(name) for run in runs)
    return " or ".join(map(str, sorted({x for x in told if isinstance(x, int)})))


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
