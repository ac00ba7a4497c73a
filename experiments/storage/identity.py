"""Whose a folder and its checkpoints are.

A folder gets a config and an id when it is made. Its checkpoints carry both, so that
one which came from elsewhere is known, whatever its shapes are. The folder of what a
file of a model performs knows the bytes of that file, as its name may soon be of
another. The file of a robot may be edited, so that a folder knows what its robot
observes, by name. Folders and checkpoints of older versions have none of this, and are
taken as they are.
"""

import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import CheckpointError
from . import checkpoint, rundir

# (of the start, of now, where the first is) -> what differs between configs in JSON.
Differences = Callable[[Any, Any, str], list[str]]
_GOAL = "num_trials"  # which trial completes a run; not a part of which run it is


def settle(
    path: Path, config: dict[str, Any], differences: Differences,
    model: str | None = None, entries: Sequence[str] = (),
) -> None:  # fmt: skip
    """Gives a new folder its config and its id; compares the config of an old one.

    An old one may be given more trials.

    Args:
      path: of the folder.
      config: of now, in JSON.
      differences: between two configs.
      model: digest of the file of a model that the run starts from, if it is one.
      entries: names of what the robot observes, in order, if they have any.

    Raises:
      CheckpointError: if it is of other numbers, another model or another robot.
    """
    own = path / rundir.CONFIG
    _check_model(path, config, model)
    check_robot(path, config, entries)
    if not own.exists():
        known = (path / rundir.IDENTITY).exists()
        if not known and not checkpoint.steps(path / rundir.CHECKPOINTS):
            made: dict[str, Any] = {"id": secrets.token_hex(8), "model": model}
            made |= {"entries": list(entries)} if entries else {}
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


def check_robot(path: Path, config: Mapping[str, Any], entries: Sequence[str]) -> None:
    """Refuses another robot than that of a folder, or of the exploration it is in.

    Raises:
      CheckpointError: if its entries are known to be others, or in another order.
    """
    explores = config["phase"] == "explore"
    for folder in [path] if explores else [path.parent, path]:
        known = rundir.find_json(folder / rundir.IDENTITY).get("entries")
        if not isinstance(known, list) or known == list(entries) or not entries:
            continue
        why = unlike(known, entries, "the run")
        another = "--name" if explores else "--tag"
        advice = f"the same robot, or another {another}"
        if folder != path:
            advice = "the robot that explored, or explore again under another --name"
        raise CheckpointError(
            f"{folder} was started with another robot than --env {config['env']} is "
            "now: its observations must have the same entries in the same order; "
            f"{why}. Use {advice}."
        )


def unlike(
    then: Sequence[Any], now: Sequence[Any], where: str,
    name: Callable[[Any], str] = str,
) -> str:  # fmt: skip
    """Says how two rows of entries differ: what one alone has, or else the order.

    Args:
      then: entries of a run or a model.
      now: those of the robot.
      where: what the first are of, in words.
      name: of an entry.
    """
    alone = [x for x in then if x not in now]
    lacking = [x for x in now if x not in then]
    pairs = enumerate(zip(then, now, strict=False))
    moved = [(i, a, b) for i, (a, b) in pairs if a != b]
    if alone or lacking or not moved:
        own, its = (", ".join(map(name, x)) or "none" for x in (alone, lacking))
        return f"only {where} has {own}, only the robot has {its}"
    i, a, b = moved[0]
    both = f"{name(a)} in {where}, {name(b)} in the robot"
    return f"the order differs: entry {i} is {both}"


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
