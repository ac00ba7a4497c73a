"""The names in a checkpoint directory: which steps there are, and moves between names.

A step's folder is called by its number. Other names start with a dot:

    .saving-7      a save that has not finished; removed by the next one
    .deleted-7     an old step on its way out; removed by the next save
    .corrupt-7     a step that failed its checks; kept for the user
    .superseded-*  newer steps set aside by a resume from an older one; kept as well

Every move is one rename, so a kill leaves the old name or the new one.
"""

import itertools
import os
import shutil
import time
from collections.abc import Collection
from pathlib import Path

from experiments.errors import CheckpointError
from experiments.storage.checksums import SEAL
from experiments.storage.disk import storage_errors, sync


def numbered(directory: Path) -> list[int]:
    """Returns every number that names anything in the directory, oldest first."""
    if not directory.is_dir():
        return []
    names = [name for name in os.listdir(directory) if name.isascii()]
    return sorted(int(n) for n in names if n.isdecimal() and n == str(int(n)))


def steps(directory: Path) -> list[int]:
    """Returns the steps that are complete, oldest first."""
    directory = Path(directory)
    return [n for n in numbered(directory) if _complete(directory / str(n))]


def _complete(folder: Path) -> bool:
    return not folder.is_symlink() and (folder / SEAL).is_file()


def supersede(directory: Path, step: int) -> Path | None:
    """Sets every step newer than `step` aside, so that a run can go on from there.

    Returns:
      The folder that now holds the others, or None if there were none.
    """
    directory = Path(directory).resolve()
    newer = [number for number in numbered(directory) if number > step]
    if not newer:
        return None
    with storage_errors(f"move newer checkpoints in {directory}"):
        aside = _unused(directory / f".superseded-{time.strftime('%Y%m%d-%H%M%S')}")
        aside.mkdir()
        for number in reversed(newer):
            (directory / str(number)).rename(aside / str(number))
        sync(aside)
        sync(directory)
    return aside


def quarantine(directory: Path, number: int) -> str:
    """Sets a damaged step aside and returns what became of it, for the warning."""
    target = _unused(directory / f".corrupt-{number}")
    try:
        (directory / str(number)).rename(target)
    except OSError as error:  # Another user's run, say: it can be read, not changed.
        return f"left in place ({error.strerror})"
    return f"moved to {target.name}"


def require_newest(directory: Path, step: int) -> None:
    """Raises CheckpointError if there is a step as new as this one."""
    newer = [number for number in numbered(directory) if number >= step]
    if newer:
        raise CheckpointError(
            f"checkpoint {step} would not be the newest in {directory} "
            f"(there: {', '.join(map(str, newer))}). Resume from the newest, or move "
            "these away."
        )


def prune(directory: Path, keep: int, milestones: Collection[int]) -> None:
    """Drops all but the newest `keep` steps and the milestones."""
    kept = {*steps(directory)[-keep:], *milestones}
    with storage_errors(f"delete an old checkpoint in {directory}"):
        for number in numbered(directory):
            if number not in kept:
                gone = _unused(directory / f".deleted-{number}")
                (directory / str(number)).rename(gone)
    sweep(directory)


def sweep(directory: Path) -> None:
    """Removes what did not finish; what cannot be removed waits for the next time."""
    for pattern in (".saving-*", ".deleted-*"):
        for path in directory.glob(pattern):
            shutil.rmtree(path, ignore_errors=True)


def last_good(directory: Path, before: int) -> int | None:
    """Returns the newest complete step older than `before`."""
    return max((n for n in steps(directory) if n < before), default=None)


def _unused(path: Path) -> Path:
    """Returns `path`, or `path.2`, `path.3`, ... if that exists."""
    tries = (path.with_name(f"{path.name}.{i}") for i in itertools.count(2))
    return next(p for p in itertools.chain([path], tries) if not os.path.lexists(p))
