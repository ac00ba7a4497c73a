"""A seal over a folder: the SHA-256 of every file, in the format of `sha256sum -c`.

Nothing parses a file of a checkpoint before its bytes are known to be those that were
written. Names come from the folder itself, never from the seal.
"""

import hashlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

SEAL = "SHA256SUMS"
_MAX_FILES = 10_000
_MAX_BYTES = 100_000_000_000  # what a check may read before it gives up


def seal(folder: Path) -> None:
    """Writes the seal of a finished folder into it."""
    lines = [f"{_checksum(path)}  {name}\n" for name, path in _files(folder)]
    (folder / SEAL).write_text("".join(lines))


def broken(folder: Path) -> str | None:
    """Says what is wrong with a sealed folder, or returns None."""
    try:
        sealed = _seal_of(folder)
        files = dict(_files(folder))
        if lost := sealed.keys() - files.keys():
            return f"{min(lost)} is missing"
        if new := files.keys() - sealed.keys():
            return f"{min(new)} does not belong there"
        for name, path in files.items():
            if _checksum(path) != sealed[name]:
                return f"checksum of {name}"
    except (FileNotFoundError, NotADirectoryError):
        return "incomplete"
    except (UnicodeError, ValueError) as error:
        return str(error)
    return None


def _seal_of(folder: Path) -> dict[str, str]:
    """Returns the checksums in the seal by file name."""
    if not stat.S_ISDIR(folder.lstat().st_mode):
        raise ValueError("not a folder")
    if not stat.S_ISREG((folder / SEAL).lstat().st_mode):
        raise ValueError(f"{SEAL} is a link or a device")
    with (folder / SEAL).open(errors="replace") as file:
        text = file.read(200 * _MAX_FILES)
    lines = [line.partition("  ") for line in text.splitlines()]
    if not all(checksum and name for checksum, _, name in lines):
        raise ValueError(f"{SEAL} is cut")
    return {name: checksum for checksum, _, name in lines}


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yields the files below a folder by name, without the seal.

    Raises:
      ValueError: for a link, a device, or more than a checkpoint can hold.
    """
    count, size = 0, 0
    for parent, folders, names in os.walk(folder, onerror=_raise):
        folders.sort()
        for entry in (*folders, *sorted(names)):
            path = Path(parent, entry)
            status = path.lstat()
            count, size = count + 1, size + status.st_size
            name = path.relative_to(folder).as_posix()
            if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
                raise ValueError(f"{name} is a link or a device")
            if count > _MAX_FILES or size > _MAX_BYTES:
                raise ValueError("too many or too large files")
            if stat.S_ISREG(status.st_mode) and name != SEAL:
                yield name, path


def _raise(error: OSError) -> None:
    raise error


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
