"""Checkpoints that are whole or absent: the only home of orbax.

A step is a folder with two orbax items: `state`, a flat dictionary of arrays, and
`meta`, a record of the leaves, their checksums and what the caller wants to remember.
It gets its number by one rename, after it was written, sealed, read back, compared and
forced to the disk. Orbax itself detects no flipped bit in an array, and a save of its
in the background is lost, with exit code 0, when the program ends before it does.

One process may write at a time (`rundir.lock`); reading is always safe.
"""

import contextlib
import errno
import logging
import os
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from experiments.errors import CheckpointError, DivergedError, StorageError
from experiments.storage import step_folders
from experiments.storage.checksums import broken, seal
from experiments.storage.disk import (
    disk_error,
    free_bytes,
    is_full,
    megabytes,
    sync,
    sync_tree,
)
from experiments.storage.manifest import digest, manifest, misfit, stored_leaves
from experiments.storage.pytrees import describe, from_host, non_finite, to_host
from experiments.storage.step_folders import steps, supersede

__all__ = ["restore", "save", "steps", "supersede"]

_FIRST = ocp.options.MultiprocessingOptions(0, {0}, "first")  # no other host is here


class _DamagedError(Exception):
    """A step that is not what was written; the message says where."""


def save(
    directory: Path,
    step: int,
    state: Any,
    meta: Mapping[str, Any],
    *,
    finite: Any = None,
    keep: int = 2,
    milestones: Collection[int] = (),
) -> None:
    """Writes one step and returns when it is on the disk; then drops old ones.

    Args:
      directory: Of all steps; created if need be.
      step: Newer than every step there.
      state: A pytree of arrays, on any device; typed keys are fine.
      meta: JSON values to come back from `restore`; no NaN.
      finite: A part of the state whose floats must be finite.
      keep: Number of newest steps to keep, the new one included.
      milestones: Older steps that are never dropped.

    Raises:
      DivergedError, StorageError: Not finite, or the disk failed; nothing has changed.
      CheckpointError: There is a step as new as this one.
    """
    if keep < 1:
        raise ValueError(f"keep must be at least 1, got {keep}")
    directory = Path(directory).resolve()
    step_folders.require_newest(directory, step)
    _require_finite(directory, step, finite)
    arrays = to_host(state)
    body = manifest(step, describe(state), arrays, meta)
    try:
        _commit(directory, step, arrays, body)
    except Exception as error:
        step_folders.sweep(directory)
        if message := _disk_message(directory, step, arrays, error):
            raise StorageError(message) from error
        raise
    step_folders.prune(directory, keep, milestones)


def restore(
    directory: Path,
    template: Any,
    *,
    step: int | None = None,
    part: bool = False,
    warn: Callable[[str], None],
) -> tuple[int, Any, dict[str, Any]] | None:
    """Reads the newest step that is undamaged, or exactly `step`.

    Damaged steps newer than the one read are set aside as `.corrupt-<step>`, with one
    warning each. If none can be read, none is moved: the directory is not a new one.

    Args:
      directory: As in `save`.
      template: The state's pytree; arrays or `jax.ShapeDtypeStruct`s, on any device.
      step: The one to read, or None for the newest.
      part: Whether the template may be a part of what was saved, with the same paths.
      warn: Gets each warning as one line.

    Returns:
      The step, the state and the meta; None if there is no checkpoint at all.

    Raises:
      CheckpointError: Nothing there can be used; the message says why.
    """
    directory = Path(directory).resolve()
    candidates = _candidates(directory, step)
    if not candidates:
        return None
    damaged = {}
    for number in candidates:
        try:
            state, meta = _read(directory, number, template, part)
        except _DamagedError as error:
            damaged[number] = str(error)
            continue
        for bad, reason in damaged.items():
            fate = step_folders.quarantine(directory, bad)
            warn(f"checkpoint {bad} is damaged ({reason}); {fate}, using {number}.")
        return number, state, meta
    raise _no_use(directory, step, damaged)


def _candidates(directory: Path, step: int | None) -> list[int]:
    """Returns the steps to try, best first."""
    numbers = step_folders.numbered(directory)
    if step is None:
        return numbers[::-1]
    if step in numbers:
        return [step]
    there = ", ".join(map(str, steps(directory))) or "none"
    raise CheckpointError(
        f"no checkpoint {step} in {directory} (there: {there}). Choose another."
    )


def _no_use(
    directory: Path, step: int | None, damaged: Mapping[int, str]
) -> CheckpointError:
    """Returns the error for a directory without a readable step."""
    if step is not None:
        others = [number for number in steps(directory) if number != step]
        return CheckpointError(
            f"checkpoint {step} in {directory} is damaged ({damaged[step]}). Choose "
            f"another (there: {', '.join(map(str, others)) or 'none'})."
        )
    reasons = "; ".join(f"{number}: {reason}" for number, reason in damaged.items())
    return CheckpointError(
        f"all {len(damaged)} checkpoints in {directory} are damaged ({reasons}). Start "
        "over in another run directory; the files were kept."
    )


# Writing.


def _require_finite(directory: Path, step: int, part: Any) -> None:
    if where := non_finite(part):
        good = step_folders.last_good(directory, step)
        raise DivergedError(
            f"not finite at checkpoint {step}: {where}. Last good checkpoint: "
            f"{'none' if good is None else good}."
        )


def _commit(
    directory: Path,
    step: int,
    arrays: Mapping[str, np.ndarray],
    body: Mapping[str, Any],
) -> None:
    """Writes a step under a temporary name, checks it, and gives it its number."""
    directory.mkdir(parents=True, exist_ok=True)
    step_folders.sweep(directory)
    if free_bytes(directory) < _size(arrays):
        # Orbax would find out too, after pages of its threads' tracebacks.
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    draft = directory / f".saving-{step}"
    items = ocp.args.Composite(
        state=ocp.args.StandardSave(_storable(arrays)), meta=ocp.args.JsonSave(body)
    )
    with _quiet_orbax() as orbax:
        orbax.save(draft, args=items)
    for note in draft.rglob("commit_success.txt"):
        note.write_text("whole\n")  # orbax says there where on this machine it wrote
    seal(draft)
    _read_arrays(draft, _read_manifest(draft, step))
    sync_tree(draft)
    draft.rename(directory / str(step))
    sync(directory)


def _size(arrays: Mapping[str, np.ndarray]) -> int:
    """Returns an upper bound of the bytes of a step: orbax compresses the arrays."""
    return 200_000 + sum(array.nbytes for array in arrays.values())


def _disk_message(
    directory: Path, step: int, arrays: Mapping[str, np.ndarray], error: Exception
) -> str | None:
    """Returns the line for a save that the disk failed; None if it is a bug of ours."""
    number = disk_error(error)
    if isinstance(error, _DamagedError):
        what = f"checkpoint {step} in {directory} did not read back ({error})"
    elif number is None:
        return None
    else:
        reason = "no space for" if is_full(number) else f"{os.strerror(number)} writing"
        needs, free = megabytes(_size(arrays)), megabytes(free_bytes(directory))
        what = f"{reason} checkpoint {step} in {directory} (needs {needs}, {free} free)"
    good = step_folders.last_good(directory, step)
    intact = "No earlier one" if good is None else f"Checkpoint {good}"
    return (
        f"{what}. {intact} is intact; free space or check the disk, and run the same "
        "command."
    )


# Reading.


def _read(
    directory: Path, number: int, template: Any, part: bool
) -> tuple[Any, dict[str, Any]]:
    """Reads and checks one step; raises CheckpointError if it does not fit."""
    folder = directory / str(number)
    try:
        body = _read_manifest(folder, number)
        if why := misfit(body, describe(template), part=part):
            raise CheckpointError(f"checkpoint {number} in {directory} {why}")
        arrays = _read_arrays(folder, body)
    except PermissionError as error:
        raise StorageError(
            f"cannot read checkpoint {number} in {directory} ({error.strerror}). "
            "Check its permissions."
        ) from error
    return from_host(arrays, template), body["meta"]


def _read_manifest(folder: Path, number: int) -> dict[str, Any]:
    """Returns the record of a step, once it is known to be what was written."""
    if why := broken(folder):
        raise _DamagedError(why)
    body = _read_items(folder, meta=ocp.args.JsonRestore()).meta
    if body["step"] != number:
        raise _DamagedError(f"it is step {body['step']}")
    return body


def _read_arrays(folder: Path, body: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Reads the arrays that a record lists, and checks each against its digest."""
    arrays = {
        name: np.zeros(leaf.shape, jnp.dtype(leaf.dtype))
        for name, leaf in stored_leaves(body).items()
    }
    target = ocp.args.StandardRestore(_storable(arrays))
    arrays |= _read_items(folder, state=target).state
    for name, array in arrays.items():
        if digest(array) != body["leaves"][name]["sha256"]:
            raise _DamagedError(f"checksum of {name}")
    return arrays


def _storable(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Drops arrays of size zero, which orbax refuses; the record has their shape."""
    return {name: array for name, array in arrays.items() if array.size}


def _read_items(folder: Path, **items: Any) -> Any:
    """Reads orbax items; whatever goes wrong in there means damage."""
    try:
        with _quiet_orbax() as orbax:
            return orbax.restore(folder, args=ocp.args.Composite(**items))
    except (MemoryError, PermissionError):
        raise
    except Exception as error:
        raise _DamagedError(f"unreadable: {type(error).__name__}") from error


@contextlib.contextmanager
def _quiet_orbax() -> Iterator[ocp.Checkpointer]:
    """Yields a new checkpointer; a failed read can spoil the next one of the same."""
    alone = ocp.CompositeOptions(multiprocessing_options=_FIRST)
    handler = ocp.CompositeCheckpointHandler(composite_options=alone)
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with (
            warnings.catch_warnings(action="ignore"),
            ocp.Checkpointer(handler, multiprocessing_options=_FIRST) as orbax,
        ):
            yield orbax
    finally:
        logger.setLevel(level)
