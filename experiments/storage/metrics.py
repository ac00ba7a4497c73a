"""The log of a run, metrics.jsonl: what is in its rows, and how they are kept.

A row is a trial of a seed, and of a task where one is sought:

    phase, arm, seed, trial  exploration has planner and steps too, the others task and
                             explored_trials, the trials behind their model; in distill
                             the planner is plan, policy, or both
    value                    predicted reward per imagined step
    turns                    net turns of the torso, nose down; left out of a robot of
                             which none are counted
    bad_plans                steps whose every candidate was imagined to be not finite;
                             left out where there is none
    lost_steps               those from where physics diverged on: they are not learned
                             from and earn nothing; left out where there are none
    returns                  of the trial under every task; return is that of its own
    fit                      of the model after the trial, where there was one
    seconds                  act and fit
    constants, constants/... what was drawn for the trial, where anything is
    check                    a checksum of the other entries, whatever their order

Null is a number that is not finite. The log is JSON Lines. A run that is resumed cuts
it back to the trials that its checkpoint knows of, so that each trial is in it once.
"""

import json
import os
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ..errors import storage_errors
from ..parallel import distributed
from . import disk, rundir

# Names in rows of older versions.
_RENAMED = {"loss": "nll"}


class Row(NamedTuple):
    """A line of a log, with what its run says about it."""

    preset: str  # with the robot, as `rundir.study_of` has it
    arm: str  # with the number of bits for count: count-32
    phase: str
    seed: int
    task: str  # empty while exploring
    trial: int
    explored: int  # exploration trials behind the model; 0 while exploring
    tag: str  # of a variant of phase 2; empty for the one that Table 1 counts
    data: dict[str, Any]
    run: Path  # folder of the log


def row(
    label: Mapping[str, Any], value: float, turns: float | None,
    returns: Mapping[str, float], fit: Mapping[str, float] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Returns a row as it is written; its label says what the trial is."""
    found = {**label, "value": value, "turns": turns, "returns": returns}
    if turns is None:
        del found["turns"]
    if label.get("task"):
        found["return"] = returns[label["task"]]
    return found if fit is None else found | {"fit": fit}


def arm_label(arm: str, config: Mapping[str, Any]) -> str:
    """Returns what the report calls an arm: count has its number of bits, count-32."""
    if arm == "count" and "num_bits" in config:
        return f"count-{config['num_bits']}"
    return rundir.label(arm)


def number(value: Any) -> float:
    """Returns a logged number; null, which stands for one not finite, is NaN."""
    return float("nan") if value is None else float(value)


class _Line(msgspec.Struct, kw_only=True, tag_field="phase"):
    """What a row must have, and of what kind it is; older versions wrote less."""

    arm: rundir.Name
    seed: int
    trial: int
    value: float | None = None
    turns: float | None = None
    returns: dict[str, float | None] | None = None
    fit: dict[str, float | None] | None = None
    seconds: dict[str, float | None] | None = None
    lost_steps: int = 0


class _Explore(_Line, tag="explore"):
    pass


class _ZeroShot(_Line, tag="zero-shot"):
    task: str
    explored_trials: int
    own: float | None = msgspec.field(name="return")


class _Finetune(_ZeroShot, tag="finetune"):
    pass


class _Distill(_ZeroShot, tag="distill"):
    pass


def read(log: Path, config: Mapping[str, Any]) -> Iterator[Row]:
    """Yields the rows of a log of a run with this config, in JSON.

    A last line without its end is left out: a run is writing it, or was killed while it
    did. So is a line that is no row, and that is said.
    """
    study = rundir.study_of(log.parent, config)
    with log.open("rb") as file:
        for i, line in enumerate(file, 1):
            if not line.endswith(b"\n"):
                return
            try:
                yield _parsed(_checked(line), config, log.parent, study)
            except (ValueError, RecursionError) as error:
                why = f"{log}:{i} is no row of a run ({error})"
                distributed.say(f"warning: {why}; left out.")


def _parsed(data: Any, config: Mapping[str, Any], run: Path, study: str) -> Row:
    line = msgspec.convert(data, _Explore | _ZeroShot | _Finetune | _Distill)
    if fit := data.get("fit"):
        fit = {_RENAMED.get(name, name): value for name, value in fit.items()}
        data = data | {"fit": fit}
    return Row(
        preset=study,
        arm=arm_label(line.arm, config),
        phase=data["phase"],
        seed=line.seed,
        task="" if isinstance(line, _Explore) else line.task,
        trial=line.trial,
        explored=0 if isinstance(line, _Explore) else line.explored_trials,
        tag=config.get("tag") or "",
        data=data,
        run=run,
    )


def lost_steps(path: Path, trial: int) -> list[int]:
    """Returns, of every row of a trial, the steps from where physics diverged on."""
    rows = [json.loads(line) for line, found in _trials(path) if found == trial]
    counts = [row.get("lost_steps", 0) for row in rows]
    return [count if type(count) is int else 0 for count in counts]


def append_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Appends rows to a log in one write; they are on the disk on return.

    Args:
      path: The log.
      rows: Numbers may be Python's, NumPy's or jax's; NaN and infinity become null.

    Raises:
      StorageError: if the disk refuses, or the log is a link.
    """
    _append(path, _lines(rows))


def replace_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes a log at once, as `append_rows` does; a reader sees all rows or none."""
    disk.write(path, _lines(rows))


def rows_by_trial(path: Path) -> Counter[int]:
    """Returns how many rows of every trial can be read in a log that need not exist."""
    return Counter(trial for _, trial in _trials(path) if trial is not None)


def resume(path: Path, first: int, last: int, num_rows: Any) -> list[str]:
    """Cuts a log back to a checkpoint; returns what is to be said of it, as lines.

    Args:
      path: The log; what it has lost costs rows, and never the run.
      first: The trial before those of the run.
      last: The trial of the checkpoint; `first` if there is none.
      num_rows: Of every trial, as the checkpoint says; a stranger's may say anything.
    """
    before = rows_by_trial(path)
    cut_log(path, last)
    found = rows_by_trial(path)
    if type(num_rows) is not int or not num_rows:
        num_rows = max(found.values(), default=1)
    lost = [trial for trial in range(first + 1, last + 1) if found[trial] < num_rows]
    if lost:
        return [
            f"{path} has lost rows of {_listed(lost)}; the run goes on from checkpoint "
            f"{last} without them."
        ]
    if before and last == first:
        return [
            f"there is a log of {_listed(sorted(before))}, but no checkpoint; the run "
            f"starts again at trial {first + 1}, and these rows are in "
            f"{_orphans(path)} now."
        ]
    return []


def _listed(trials: Sequence[int]) -> str:
    """Returns `trials 1 to 3, 5`."""
    runs: list[list[int]] = []
    for trial in trials:
        if runs and trial == runs[-1][-1] + 1:
            runs[-1][1:] = [trial]
        else:
            runs.append([trial])
    text = ", ".join(" to ".join(map(str, run)) for run in runs)
    return f"trial{'s' * (len(trials) > 1)} {text}"


def cut_log(path: Path, last: int) -> None:
    """Cuts a log back to the trials up to `last`.

    The rest, and lines that are no rows, go to `<path>.orphan`, after what is there.
    """
    kept, rest = [], []
    for line, trial in _trials(path):
        (rest if trial is None or trial > last else kept).append(line)
    if rest:
        _append(_orphans(path), b"".join(rest).removesuffix(b"\n") + b"\n")
        disk.write(path, b"".join(kept))


def _orphans(path: Path) -> Path:
    return path.with_name(rundir.ORPHANS)


def _lines(rows: Sequence[Mapping[str, Any]]) -> bytes:
    found = [rundir.plain(row) for row in rows]
    found = [row | {"check": _check(row)} for row in found]
    return "".join(json.dumps(row, allow_nan=False) + "\n" for row in found).encode()


def _check(row: Mapping[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(row, sort_keys=True).encode()):08x}"


def _checked(line: bytes) -> Any:
    """Parses a line. A ValueError says why it is not what was written."""
    data = json.loads(line)
    if not isinstance(data, dict) or "check" not in data:  # of an older version
        return data
    if data.pop("check") != _check(data):
        raise ValueError("it has changed: its check is of another one")
    return data


def _trials(path: Path) -> Iterator[tuple[bytes, int | None]]:
    """Yields the lines of a log, each with its trial; None is no row, or half a one."""
    if not path.exists():
        return
    with path.open("rb") as file:
        for line in file:
            try:
                trial = _checked(line)["trial"] if line.endswith(b"\n") else None
            except (ValueError, KeyError, TypeError, RecursionError):
                trial = None
            yield line, trial if type(trial) is int else None


def _append(path: Path, data: bytes) -> None:
    with disk.opened(path, os.O_RDWR | os.O_APPEND) as file:
        start = os.lseek(file, 0, os.SEEK_END)
        with storage_errors(f"write {path}"):
            try:
                while data:
                    data = data[os.write(file, data) :]
                os.fsync(file)
                if not start:
                    disk.sync(path.parent)
            except OSError:
                os.ftruncate(file, start)  # Half a row would spoil the next one.
                raise
