"""A run's folder for as long as the run lasts: locked, described, and accounted for."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from experiments.config import NUM_TASKS
from experiments.entries import differences
from experiments.errors import CheckpointError, InterruptedRun, RunError
from experiments.storage import rundir

# Two checkpoints and one being written, of a paper-sized run of one seed and task.
_NEEDED_BYTES = 64 * 2**20


@contextlib.contextmanager
def open_run(
    folder: Path,
    config: dict[str, Any],
    *,
    say: Callable[[str], None],
) -> Iterator[None]:
    """Holds a run's folder: config.json, env.json, status.json and the lock.

    Args:
      folder: made if it is not there.
      config: in JSON; must equal what the folder was started with.
      say: for warnings.

    Raises:
      CheckpointError: if the folder is in use or belongs to another config.
      StorageError: if it cannot be written to.
    """
    branches = len(config["seeds"])
    if (config["phase"], config["task"]) == ("finetune", "all"):
        branches *= NUM_TASKS
    rundir.probe(folder, _NEEDED_BYTES * branches)
    with rundir.lock(folder):
        _compare(folder / "config.json", config)
        environment = rundir.environment()
        if (folder / "env.json").exists():
            old = rundir.read_json(folder / "env.json")
            for line in rundir.compare_environment(old, environment):
                say(f"warning: {line}")
        else:
            rundir.write_json(folder / "env.json", environment)
        _status(folder, "running")
        try:
            yield
        except InterruptedRun as error:
            _status(folder, "interrupted", str(error))
            raise InterruptedRun(
                f"{error}; at most the trial under way is lost. Continue with the same "
                "command."
            ) from error
        except RunError as error:
            _status(folder, "failed", str(error))
            raise
        _status(folder, "complete")


def _compare(path: Path, config: dict[str, Any]) -> None:
    if path.exists():
        lines = differences(rundir.read_json(path), config)
        if lines:
            another = "--name" if config["phase"] == "explore" else "--tag"
            raise CheckpointError(
                f"{path.parent} was started with other numbers: {'; '.join(lines)}. "
                f"Use the same flags, or another {another}."
            )
    else:
        rundir.write_json(path, config)


def _status(folder: Path, state: str, reason: str = "") -> None:
    status = {"state": state, "reason": reason, "time": rundir.now()}
    rundir.write_json(folder / "status.json", status)
