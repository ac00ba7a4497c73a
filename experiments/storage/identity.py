"""Whose a folder and its checkpoints are.

A folder gets a config and an id when it is made. Its checkpoints carry both, so that
one which came from elsewhere is known, whatever its shapes are. The folder of what a
file of a model performs knows the bytes of that file, as its name may soon be of
another. Folders and checkpoints of older versions have none of this, and are taken as
they are.
"""

import os
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import CheckpointError
from . import checkpoint, rundir

# (of the start, of now, where the first is) -> what differs between configs in JSON.
Differences = Callable[[Any, Any, str], list[str]]
_GOAL = "num_trials"  # which trial completes a run; not a part of which run it is


def settle(
    path: Path, config: dict[str, Any], differences: Differences,
    model: str | None = None,
) -> None:  # fmt: skip
    """Gives a new folder its config and its id; compares the config of an old one.

    An old one may be given more trials.

    Args:
      path: of the folder.
      config: of now, in JSON.
      differences: between two configs.
      model: digest of the file of a model that the run starts from, if it is one.

    Raises:
      CheckpointError: if it is of other numbers, or of another model.
    """
    own = path / rundir.CONFIG
    _check_model(path, config, model)
    if not own.exists():
        known = (path / rundir.IDENTITY).exists()
        if not known and not checkpoint.steps(path / rundir.CHECKPOINTS):
            made = {"id": secrets.token_hex(8), "model": model}
            rundir.write_json(path / rundir.IDENTITY, made)
        rundir.write_json(own, config)
        return
    began = rundir.read_json(own)
    if lines := differences(began, config, str(own)):
        another = "--name" if config["phase"] == "explore" else "--tag"
        raise CheckpointError(
            f"{path} was started with other numbers: {'; '.join(lines)}. Use the same "
            f"flags, or another {another}."
        )
    if config.get(_GOAL, 0) > began.get(_GOAL, 0):
        rundir.write_json(own, began | {_GOAL: config[_GOAL]})


def _check_model(path: Path, config: Mapping[str, Any], model: str | None) -> None:
    """Refuses a folder of another model; that of an older version does not say."""
    known = rundir.find_json(path / rundir.IDENTITY)
    if known.get("model", model) == model:
        return
    began = rundir.find_json(path / rundir.CONFIG)
    now, then = (x.get("source") or path.parent for x in (config, began))
    raise CheckpointError(
        f"{path} was started with another model than that of {now}: with that of "
        f"{then} at the time. Use another --tag or another --out."
    )


def read_id(path: Path) -> str | None:
    """Returns the id of a run, None if an older version has made it.

    Raises:
      CheckpointError: if it cannot be read.
    """
    own = path / rundir.IDENTITY
    if not os.path.lexists(own):
        return None
    found = rundir.read_json(own)
    if not isinstance(found, dict) or not isinstance(found.get("id"), str):
        raise CheckpointError(f"{own} holds no id of a run. Restore or remove it.")
    return found["id"]


def of(path: Path) -> dict[str, Any]:
    """Returns what a checkpoint remembers of its run."""
    own = read_id(path)
    if own is None:
        return {}
    return {"run": own, "config": rundir.find_json(path / rundir.CONFIG)}


def foreign(
    path: Path, meta: Mapping[str, Any], config: Mapping[str, Any] | None,
    differences: Differences,
) -> str | None:  # fmt: skip
    """Says whose a checkpoint with this meta is, if it is not of the run in `path`.

    Args:
      path: of the run.
      meta: with what `of` has put into it.
      config: of the run; None for one that is only read, of which the id is enough.
      differences: between two configs.
    """
    own, found = read_id(path), meta.get("run")
    if own is None or found is None:
        return None
    if found != own:
        return f"of run {found!r}; {rundir.IDENTITY} says {own!r}"
    if config is None:
        return None
    lines = differences(meta["config"], config, "its config")
    return f"of other numbers: {'; '.join(lines)}" if lines else None
