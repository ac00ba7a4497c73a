"""Files that survive a power cut, and disk errors as one line for the user."""

import contextlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path

from ..errors import StorageError, storage_errors

_DRAFT = ".tmp-"


@contextlib.contextmanager
def draft(path: Path) -> Iterator[Path]:
    """Yields a name beside a file that nothing has, and removes what it came to name.

    It has the suffix of the file, from which libraries guess what to write.
    """
    name = path.with_name(f"{_DRAFT}{secrets.token_hex(4)}{path.suffix}")
    try:
        yield name
    finally:
        name.unlink(missing_ok=True)


@contextlib.contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yields a draft of a file, which takes its place at once when the block ends.

    A reader sees the old file or the new one, after a power cut too; a failure leaves
    the old one. A link there is replaced, not followed.

    Raises:
      StorageError: if the disk refuses.
    """
    with storage_errors(f"write {path}"):
        with draft(path) as name:
            yield name
            sync(name)
            name.replace(path)
        sync(path.parent)


def write(path: Path, data: bytes) -> None:
    """Replaces a file, as `replaced` does."""
    with replaced(path) as name:
        name.write_bytes(data)


def sweep(folder: Path) -> None:
    """Removes the drafts of killed processes; nobody may be writing there."""
    for name in folder.glob(f"{_DRAFT}*"):
        with contextlib.suppress(OSError):
            name.unlink()
    for name in folder.glob(".writing-*"):  # the library's, of files of tensors
        if not name.is_symlink():
            shutil.rmtree(name, ignore_errors=True)


@contextlib.contextmanager
def opened(path: Path, flags: int) -> Iterator[int]:
    """Opens a file, made if need be, to write to it where it stands.

    Raises:
      StorageError: if the disk refuses, or as `check_own`.
    """
    check_own(path)
    flags |= os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    with storage_errors(f"write {path}"):
        file = os.open(path, flags, 0o666)
    try:
        yield file
    finally:
        os.close(file)


def check_own(path: Path, *, folder: bool = False) -> None:
    """Refuses to write to a file or a folder that also is elsewhere, as links are.

    Args:
      path: need not exist.
      folder: whether it must be one.

    Raises:
      StorageError: if it is a link, hard or soft, or of another kind.
    """
    with storage_errors(f"write {path}"):
        try:
            status = path.lstat()
        except FileNotFoundError:
            return
    if folder:
        good = stat.S_ISDIR(status.st_mode)
    else:
        good = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
    if not good:
        kind = "folder" if folder else "file"
        raise StorageError(
            f"{path} is a link, or no {kind}; a run writes to its own only. Put a copy "
            "of what it stands for in its place, or move it away."
        )


def make(folder: Path) -> None:
    """Makes a folder, and those that it is in; a power cut does not undo it."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for path in missing:
        sync(path.parent)


def sync(path: Path) -> None:
    """Forces a file, or the names in a directory, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(root: Path) -> None:
    """Forces everything below `root` to the disk, then `root` itself."""
    for folder, _, files in os.walk(root, topdown=False):
        for path in (*(Path(folder, name) for name in files), Path(folder)):
            sync(path)


def disk_error(error: BaseException | None) -> int | None:
    """Returns the errno behind an exception, TensorStore's included, or None."""
    while error is not None:
        if isinstance(error, OSError) and error.errno:
            return error.errno
        # TensorStore raises ValueError and has the number in the text only.
        if found := re.search(r"os_error_code='(\d+)'", str(error)):
            return int(found[1])
        error = error.__cause__ or error.__context__
    return None


def free_bytes(path: Path) -> int:
    """Returns the free bytes of the disk that holds (or will hold) `path`."""
    there = next(x for x in (path, *path.absolute().parents) if x.exists())
    return shutil.disk_usage(there).free


def megabytes(size: int) -> str:
    """Formats a size for a message."""
    return f"{size / 1e6:.3g} MB" if size < 1e9 else f"{size / 1e9:.3g} GB"
