"""The log of a run, metrics.jsonl: what is in its rows, and how they are kept.

A row is a trial of a seed, and of a task where one is sought:

    phase, arm, seed, trial  exploration has planner and steps too, the others task and
                             explored_trials, the trials behind their model
    value                    predicted reward per imagined step
    turns                    net turns of the torso, nose down
    returns                  of the trial under every task; return is that of its own
    fit                      of the model after the trial, where there was one
    seconds                  act and fit

Null is a number that is not finite. The log is JSON Lines. A checkpoint remembers its
size when it was written; a resumed run cuts it back to there, so that each trial is in
it once.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.errors import CheckpointError, UsageError, storage_errors
from experiments.storage import rundir

# Names in rows of older versions.
_RENAMED = {"loss": "nll"}


class Row(NamedTuple):
    """A line of a log, with what its run says about it."""

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


def row(
    label: Mapping[str, Any], value: float, turns: float, returns: Mapping[str, float],
    fit: Mapping[str, float] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Returns a row as it is written; its label says what the trial is."""
    found = {**label, "value": value, "turns": turns, "returns": returns}
    if label.get("task"):
        found["return"] = returns[label["task"]]
    return found if fit is None else found | {"fit": fit}


def arm_label(arm: str, config: Mapping[str, Any]) -> str:
    """Returns what the report calls an arm: count has its number of bits, count-32."""
    if arm == "count" and "num_bits" in config:
        return f"count-{config['num_bits']}"
    return arm


def number(value: Any) -> float:
    """Returns a logged number; null, which stands for one not finite, is NaN."""
    return float("nan") if value is None else float(value)


def read(log: Path, config: Mapping[str, Any]) -> Iterator[Row]:
    """Yields the rows of a log of a run with this config, in JSON.

    A last line without its end is left out: a run is writing it, or was killed while it
    did.

    Raises:
      UsageError: for a line that is no row.
    """
    for i, line in enumerate(log.read_text().splitlines(keepends=True), 1):
        if not line.endswith("\n"):
            return
        try:
            yield _parsed(json.loads(line), config, log.parent)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(f"{log}:{i} is no row of a run ({error!r}).") from error


def _parsed(data: dict[str, Any], config: Mapping[str, Any], run: Path) -> Row:
    exploring = data["phase"] == "explore"
    if fit := data.get("fit"):
        fit = {_RENAMED.get(name, name): value for name, value in fit.items()}
        data = data | {"fit": fit}
    return Row(
        preset=config["preset"],
        arm=arm_label(data["arm"], config),
        phase=data["phase"],
        seed=int(data["seed"]),
        task="" if exploring else data["task"],
        trial=int(data["trial"]),
        explored=0 if exploring else int(data["explored_trials"]),
        tag=config.get("tag") or "",
        data=data,
        run=run,
    )


def append_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Appends rows to a log in one write; they are on the disk on return.

    Args:
      path: The log.
      rows: Numbers may be Python's, NumPy's or jax's; NaN and infinity become null.
    """
    lines = [json.dumps(rundir.plain(row), allow_nan=False) + "\n" for row in rows]
    with storage_errors(f"write {path}"), path.open("ab", buffering=0) as file:
        start = file.seek(0, os.SEEK_END)
        try:
            _write_all(file.fileno(), "".join(lines).encode())
            os.fsync(file.fileno())
        except OSError:
            file.truncate(start)  # Half a row would spoil the next one.
            raise


def _write_all(file: int, data: bytes) -> None:
    while data:
        data = data[os.write(file, data) :]


def log_size(path: Path) -> int:
    """Returns the bytes in a log, for the meta of a checkpoint; 0 if there is none."""
    return path.stat().st_size if path.exists() else 0


def cut_log(path: Path, offset: int) -> None:
    """Cuts a log back to what a checkpoint knows of.

    The rest goes to `<path>.orphan`, after what is there.

    Args:
      path: The log; need not exist if `offset` is 0.
      offset: `log_size` when the checkpoint was written.

    Raises:
      CheckpointError: The log is shorter than that.
    """
    size = log_size(path)
    if size < offset:
        raise CheckpointError(
            f"{path} has {size} bytes, but its checkpoint knows of {offset}. Restore "
            "the file or start over in another run directory."
        )
    if size == offset:
        return
    with storage_errors(f"cut {path}"), path.open("rb+") as file:
        file.seek(offset)
        rest = file.read()
        with path.with_name(path.name + ".orphan").open("ab") as orphans:
            orphans.write(rest if rest.endswith(b"\n") else rest + b"\n")
            orphans.flush()
            os.fsync(orphans.fileno())
        file.truncate(offset)
        os.fsync(file.fileno())
