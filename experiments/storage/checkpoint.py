"""Checkpoints that are whole or absent: the only home of orbax.

A step has two orbax items: `state`, a flat dictionary of arrays, and `meta`, a record
of their types and of what the caller wants to remember. Orbax's manager writes, keeps,
drops and restores the steps. Orbax itself notices no flipped bit in an array, so before
a step gets its number, by one rename, its files are sealed, read back, compared with
the state and forced to the disk.

One process may write at a time (`rundir.lock`); reading is always safe.
"""

import asyncio
import contextlib
import errno
import json
import logging
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

import jaxpets

from ..errors import (
    CheckpointError,
    DivergedError,
    RunError,
    StorageError,
    stop_behind,
)
from . import disk, pytrees, step_folders
from .step_folders import broken, names, seal, steps

__all__ = ["restore", "save", "steps"]

SCHEMA = 2  # 1 has a checksum of every array as well
_FIRST = ocp.options.MultiprocessingOptions(0, {0}, "first")  # no other host is here


class _DamagedError(Exception):
    """A step that is not what was written; the message says where."""

    kind = "damaged"


class _ForeignError(_DamagedError):
    """A step that was written, but not here; the message says by whom."""

    kind = "foreign"


def save(
    directory: Path, step: int, state: Any, meta: Mapping[str, Any], *,
    finite: Any = None, keep: int = 2, milestones: Collection[int] = (),
) -> None:  # fmt: skip
    """Writes one step and returns when it is on the disk; then drops old ones.

    Args:
      directory: of all steps; created if need be.
      step: newer than every step there.
      state: a pytree of arrays, on any device; typed keys are fine.
      meta: JSON values to come back from `restore`; no NaN.
      finite: a part of the state whose floats must be finite.
      keep: number of newest steps to keep, the new one included.
      milestones: older steps that are never dropped.

    Raises:
      CheckpointError: if there is a step as new as this one.
      DivergedError, StorageError: not finite, or the disk failed; nothing has changed.
    """
    if keep < 1:
        raise ValueError(f"keep must be at least 1, got {keep}")
    directory = Path(directory).resolve()
    if newer := [number for number in names(directory) if number >= step]:
        raise CheckpointError(
            f"checkpoint {step} would not be the newest in {directory} (there: "
            f"{_listed(newer)}). Resume from the newest, or move these away."
        )
    good = _listed(steps(directory)[-1:])
    if where := pytrees.non_finite(finite):
        where = f"not finite at checkpoint {step}: {where}"
        raise DivergedError(f"{where}. Last good checkpoint: {good}.")
    arrays, leaves = pytrees.to_host(state), pytrees.describe(state)
    record = {"schema": SCHEMA, "jaxpets": jaxpets.__version__, "step": step}
    record = json.dumps(record | {"leaves": leaves, "meta": meta}, allow_nan=False)
    size = 200_000 + sum(x.nbytes for x in arrays.values())  # orbax compresses them
    kept = [policies.LatestN(keep), policies.CustomSteps(list(milestones))]
    try:
        disk.make(directory)
        step_folders.sweep(directory)
        if disk.free_bytes(directory) < size:
            # Orbax would find out too, after pages of its threads' tracebacks.
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        _write(directory, step, arrays, json.loads(record), kept)
    except Exception as error:
        if what := _what_failed(error, directory, f"checkpoint {step}", size):
            good = "No earlier one" if good == "none" else f"Checkpoint {good}"
            advice = "free space or check the disk, and run the same command."
            raise StorageError(f"{what}. {good} is intact; {advice}") from error
        raise
    finally:
        step_folders.sweep(directory)


def restore(
    directory: Path, template: Any, *,
    step: int | None = None, part: bool = False, warn: Callable[[str], None],
    foreign: Callable[[dict[str, Any]], str | None] = lambda _: None,
) -> tuple[int, Any, dict[str, Any]] | None:  # fmt: skip
    """Returns the newest step that is undamaged, or exactly `step`: it, state and meta.

    Steps newer than the one read, which are damaged or another's, are set aside as
    `.damaged-<step>` or `.foreign-<step>`, with one warning each. If none can be read,
    none is moved: the directory is not a new one. None if there is no checkpoint at
    all.

    Args:
      directory: as in `save`.
      template: the state's pytree; arrays or `jax.ShapeDtypeStruct`s, on any device. Or
        a function that returns it, of what `pytrees.describe` said of what was saved.
      step: the one to read, or None for the newest.
      part: whether the template may be a part of what was saved, with the same paths.
      warn: gets each warning as one line.
      foreign: says of a step's meta whose it is, if it is not ours.

    Raises:
      CheckpointError: if nothing there can be used; the message says why.
    """
    directory = Path(directory).resolve()
    refused: dict[int, _DamagedError] = {}
    listed = names(directory)
    for number in [n for n in listed[::-1] if step in (None, n)]:
        try:
            state, meta = _read(directory, number, template, part, foreign)
        except _DamagedError as error:
            if number in names(directory):  # else it was dropped as we read it
                refused[number] = error
            continue
        for bad, why in refused.items():
            fate = step_folders.quarantine(directory, bad, why.kind)
            warn(f"checkpoint {bad} is {why.kind} ({why}); {fate}, using {number}.")
        return number, state, meta
    if step is None and names(directory)[-1:] != listed[-1:]:  # its run goes on
        return restore(directory, template, part=part, warn=warn, foreign=foreign)
    if step is not None:
        others = _listed([number for number in steps(directory) if number != step])
        what = f"checkpoint {step} in {directory}"
        why = refused.get(step)
        what = f"{what} is {why.kind} ({why})" if why else f"no {what}"
        raise CheckpointError(f"{what}. Choose another (there: {others}).")
    if refused:
        whys = (f"{number} is {why.kind}: {why}" for number, why in refused.items())
        raise CheckpointError(
            f"no checkpoint in {directory} can be used ({'; '.join(whys)}). Start over "
            "in another run directory; the files were kept."
        )
    return None


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers)) or "none"


def _write(
    directory: Path, step: int, arrays: dict[str, np.ndarray], record: Any, kept: Any
) -> None:
    """Lets orbax write a step, then drop those that no policy of `kept` keeps."""
    # Orbax refuses arrays of size zero; the record has their shape.
    stored = {name: array for name, array in arrays.items() if array.size}
    items = {"state": ocp.args.StandardSave(stored), "meta": ocp.args.JsonSave(record)}
    try:
        with _manager(
            directory,
            preservation_policy=policies.AnyPreservationPolicy(kept),
            temporary_path_class=_draft_of(stored),
            todelete_subdir=step_folders.DELETED,
        ) as manager:
            manager.save(step, args=ocp.args.Composite(**items), force=True)
    finally:
        # Draft, as every class, is in a cycle: it would keep them until gc finds it.
        stored.clear()


def _draft_of(stored: dict[str, np.ndarray]) -> type:
    """Returns the kind of folder that orbax writes to: checked before its rename."""

    def check(draft: Path) -> None:
        seal(draft)
        if why := broken(draft):
            raise _DamagedError(why)
        with ocp.StandardCheckpointer(multiprocessing_options=_FIRST) as reader:
            found = reader.restore(draft / "state")
        for name, array in stored.items():
            same = found[name].dtype == array.dtype and found[name].shape == array.shape
            if not same or found[name].tobytes() != array.tobytes():
                raise _DamagedError(f"{name} is not what was saved")
        disk.sync_tree(draft)

    class Draft(ocp.path.atomicity.AtomicRenameTemporaryPath):
        async def finalize(self) -> None:
            draft, final = Path(self.get()), Path(self.get_final())
            if final.name.isdecimal():  # the step; its items come before
                await asyncio.to_thread(check, draft)
            draft.rename(final)
            disk.sync(final.parent)

    return Draft


def _what_failed(error: Exception, directory: Path, step: str, size: int) -> str | None:
    """Says what the disk did to a save; None if it is a bug of ours."""
    if isinstance(error, _DamagedError):
        return f"{step} in {directory} did not read back ({error})"
    if (number := disk.disk_error(error)) is None:
        return None
    full = number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    reason = "no space for" if full else f"{os.strerror(number)} writing"
    needs, free = map(disk.megabytes, (size, disk.free_bytes(directory)))
    return f"{reason} {step} in {directory} (needs {needs}, {free} free)"


def _read(
    directory: Path, number: int, template: Any, part: bool,
    foreign: Callable[[dict[str, Any]], str | None],
) -> tuple[Any, dict[str, Any]]:  # fmt: skip
    """Returns state and meta of one step; raises CheckpointError if it does not fit."""
    meta = ocp.args.Composite(meta=ocp.args.JsonRestore())
    state = ocp.args.Composite(state=ocp.args.StandardRestore())
    try:
        if why := broken(directory / str(number)):
            raise _DamagedError(why)
        with _manager(directory, read_only=True) as manager:
            record = manager.restore(number, args=meta)["meta"]
            if record["step"] != number:
                raise _DamagedError(f"it is step {record['step']}")
            if whose := foreign(record["meta"]):
                raise _ForeignError(whose)
            if callable(template):
                template = template(record["leaves"])
            if why := _misfit(record, template, part):
                raise CheckpointError(f"checkpoint {number} in {directory} {why}")
            arrays = manager.restore(number, args=state)["state"]
    except PermissionError as error:
        what = f"cannot read checkpoint {number} in {directory} ({error.strerror})"
        raise StorageError(f"{what}. Check its permissions.") from error
    except (MemoryError, RunError, _DamagedError):
        raise
    except Exception as error:
        if stop := stop_behind(error):
            raise stop from error
        raise _DamagedError(f"unreadable: {type(error).__name__}") from error
    for name, leaf in record["leaves"].items():
        if 0 in leaf["shape"]:
            arrays[name] = np.zeros(leaf["shape"], jnp.dtype(leaf["dtype"]))
    return pytrees.from_host(arrays, template), record["meta"]


def _misfit(record: dict[str, Any], template: Any, part: bool) -> str | None:
    """Says in one line why a record does not fit a template, or returns None."""
    writer = f"written by jaxpets {record['jaxpets']}, schema {record['schema']}"
    if record["schema"] > SCHEMA:
        reader = f"this is jaxpets {jaxpets.__version__}, schema {SCHEMA}"
        return f"cannot be read ({writer}; {reader}). Use the version that wrote it."
    lines = pytrees.differences(record["leaves"], pytrees.describe(template), part=part)
    if not lines:
        return None
    more = f"; and {len(lines) - 3} more" if len(lines) > 3 else ""
    what = f"does not fit this run ({writer}): {'; '.join(lines[:3])}{more}"
    return f"{what}. Use the same config or another run directory."


@contextlib.contextmanager
def _manager(directory: Path, **options: Any) -> Iterator[ocp.CheckpointManager]:
    """Yields a manager that says nothing, and whose saves are over when they return."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    options |= {"create": False, "multiprocessing_options": _FIRST}
    options |= {"enable_async_checkpointing": False, "lightweight_initialize": True}
    try:
        chosen = ocp.CheckpointManagerOptions(**options)
        with ocp.CheckpointManager(directory, options=chosen) as manager:
            yield manager
    finally:
        logger.setLevel(level)
