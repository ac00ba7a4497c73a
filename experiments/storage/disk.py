"""Files that survive a power cut, and disk errors as one line for the user."""

import os
import re
import shutil
from pathlib import Path


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
