"""A checkpoint directory: its names, and the seal over a step's files.

A step's folder is called by its number. Every move is one rename, so a kill leaves the
old name or the new one. Other names are left alone but for these:

    7.orbax-checkpoint-tmp  a save that has not finished; removed by the next one
    .deleted                old steps on their way out; removed by the next save
    .damaged-7, .foreign-7  a step that failed its checks, or is another run's; kept
                            for the user

The seal is the SHA-256 of every file, as `sha256sum -c` reads it: nothing parses a file
of a checkpoint before its bytes are known to be those that were written.
"""

import hashlib
import itertools
import os
import shutil
import stat
import time
from pathlib import Path

SEAL = "SHA256SUMS"
DELETED = ".deleted"
# The last two are names of older versions.
_UNFINISHED = ("*.orbax-checkpoint-tmp", DELETED, ".saving-*", ".deleted-*")
_MAX_FILES, _MAX_BYTES = 10_000, 100_000_000_000  # what a check may read


def names(directory: Path) -> list[int]:
    """Returns every number that names anything in the directory, oldest first."""
    found = os.listdir(directory) if directory.is_dir() else []
    digits = [name for name in found if name.isascii() and name.isdecimal()]
    return sorted(int(name) for name in digits if name == str(int(name)))


def steps(directory: Path) -> list[int]:
    """Returns the steps that are complete, oldest first."""
    folders = {number: Path(directory, str(number)) for number in names(directory)}
    return [
        n for n, x in folders.items() if (x / SEAL).is_file() and not x.is_symlink()
    ]


def quarantine(directory: Path, number: int, kind: str) -> str:
    """Sets a step aside and returns what became of it, for the warning."""
    target = directory / f".{kind}-{number}"
    if os.path.lexists(target):
        target = target.with_name(f"{target.name}.{time.time_ns()}")
    try:
        (directory / str(number)).rename(target)
    except OSError as error:  # Another user's run, say: it can be read, not changed.
        return f"left in place ({error.strerror})"
    return f"moved to {target.name}"


def sweep(directory: Path) -> None:
    """Removes what did not finish; what cannot be removed waits for the next time."""
    for path in itertools.chain(*map(directory.glob, _UNFINISHED)):
        if path.is_symlink():  # orbax would put old steps where it leads
            path.unlink(missing_ok=True)
        shutil.rmtree(path, ignore_errors=True)


def seal(folder: Path) -> None:
    """Writes the seal of a finished folder into it."""
    lines = [f"{checksum}  {name}\n" for name, checksum in _checksums(folder).items()]
    (folder / SEAL).write_text("".join(lines))


def broken(folder: Path) -> str | None:
    """Says what is wrong with a sealed folder, or returns None."""
    if folder.is_symlink() or not (folder / SEAL).is_file():
        return "incomplete"
    try:
        found = _checksums(folder)
    except ValueError as error:
        return str(error)
    lines = (folder / SEAL).read_text(errors="replace").splitlines()
    split = (line.partition("  ") for line in lines)
    sealed = {name: checksum for checksum, _, name in split}
    if not sealed:
        return f"{SEAL} is empty"
    if not (differ := found.items() ^ sealed.items()):
        return None
    name, _ = min(differ)
    if name not in found:
        return f"{name} is missing"
    return f"checksum of {name}" if name in sealed else f"{name} does not belong there"


def _checksums(folder: Path) -> dict[str, str]:
    """Returns the SHA-256 of the files below a folder by name, but for the seal.

    Raises:
      ValueError: for a link, a device, or more than a checkpoint can hold.
    """
    found, count, size = {}, 0, 0
    for parent, folders, files in os.walk(folder, onerror=_raise):
        for path in (Path(parent, name) for name in (*folders, *files)):
            name, status = path.relative_to(folder).as_posix(), path.lstat()
            count, size = count + 1, size + status.st_size
            if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
                raise ValueError(f"{name} is a link or a device")
            if count > _MAX_FILES or size > _MAX_BYTES:
                raise ValueError("too many or too large files")
            if stat.S_ISREG(status.st_mode) and name != SEAL:
                with path.open("rb") as file:
                    found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def _raise(error: OSError) -> None:
    raise error
