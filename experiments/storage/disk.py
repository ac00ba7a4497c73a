"""Files that survive a power cut, and disk errors as one line for the user."""

import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from experiments.errors import StorageError


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
        for name in files:
            sync(Path(folder, name))
        sync(Path(folder))


def disk_error(error: BaseException | None) -> int | None:
    """Returns the errno behind an exception, TensorStore's included, or None."""
    seen = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno:
            return error.errno
        # TensorStore raises ValueError and has the number in the text only.
        if found := re.search(r"os_error_code='(\d+)'", str(error)):
            return int(found[1])
        error = error.__cause__ or error.__context__
    return None


def is_full(number: int | None) -> bool:
    """Says whether an errno means that there is no room left."""
    return number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def free_bytes(path: Path) -> int:
    """Returns the free bytes of the disk that holds (or will hold) `path`."""
    path = path.absolute()
    while not path.exists() and path != path.parent:
        path = path.parent
    return shutil.disk_usage(path).free


def megabytes(size: int) -> str:
    """Formats a size for a message."""
    return f"{size / 1e6:.3g} MB" if size < 1e9 else f"{size / 1e9:.3g} GB"


@contextlib.contextmanager
def storage_errors(doing: str) -> Iterator[None]:
    """Turns an OSError into a StorageError: `cannot <doing> (<reason>). ...`."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise StorageError(
            f"cannot {doing} ({reason}). Free the disk, check its permissions, or "
            "choose another run directory."
        ) from error
