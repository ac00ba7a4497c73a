"""Compiled libraries, kept for the next process in a folder that is the user's alone.

To load a library is to run it. So a file's name ends in the digest of its bytes, which
is computed again before the file is loaded. In between nobody else can change it, as
the folder is private. It may be deleted at any time.
"""

import contextlib
import hashlib
import os
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Callable, Generator
from pathlib import Path

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_DAY = 24 * 3600.0


@contextlib.contextmanager
def library(name: str, make: Callable[[Path], Path]) -> Generator[Path]:
    """Finds the library of this name, or makes it; its file may be loaded in here.

    Where the cache folder will not do, a warning says why, and the library is made in a
    temporary folder.

    Args:
      name: without a suffix. Who asks for the same name gets the same library.
      make: builds the library in an empty folder and returns its file.

    Raises:
      OSError: if there is no folder to make it in.
    """
    with contextlib.ExitStack() as stack:
        try:
            path = _kept(_cache_folder(), name, make)
        except OSError as error:
            warnings.warn(
                f"cannot keep a compiled kernel: {error}. It is built for this process "
                "alone; set XDG_CACHE_HOME to a folder that only you can write to.",
                stacklevel=3,
            )
            temporary = tempfile.TemporaryDirectory(prefix="jaxpets-")
            path = _kept(Path(stack.enter_context(temporary)).resolve(), name, make)
        yield path


def _cache_folder() -> Path:
    """Returns the user's cache folder, which is made if it is not there."""
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError as error:
        raise OSError("there is no home folder") from error
    # Links on the way are followed once: the folders checked are the folders used.
    folder = Path(os.path.realpath(home), "jaxpets")
    for path in reversed((folder, *folder.parents)):
        path.mkdir(mode=0o700, exist_ok=True)  # as the XDG specification wants it
    return folder


def _check_private(folder: Path) -> None:
    """Raises OSError if others could change what is in a folder."""
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode):
        raise NotADirectoryError(f"{folder} is a link and not a folder")
    if status.st_uid != os.geteuid():
        raise PermissionError(f"{folder} belongs to another user ({status.st_uid})")
    if status.st_mode & _OTHERS_WRITE:
        raise PermissionError(f"others may write to {folder}")
    for parent in folder.parents:
        # There anybody may put another folder in the place of ours; not if it is
        # sticky, as /tmp is.
        mode = parent.stat().st_mode
        if mode & stat.S_IWOTH and not mode & stat.S_ISVTX:
            raise PermissionError(f"anybody may write to {parent}")


def _kept(folder: Path, name: str, make: Callable[[Path], Path]) -> Path:
    """Returns the library in a folder, which is made if no file there is as it was."""
    _check_private(folder)
    _sweep(folder)
    found = sorted(folder.glob(f"{name}-*.so"))
    if whole := next(filter(_is_whole, found), None):
        return whole
    for path in found:
        warnings.warn(f"{path} is damaged; it is built again.", stacklevel=4)
    new = _make(folder, name, make)
    for path in found:
        if path != new:
            path.unlink(missing_ok=True)
    return new


def _is_whole(path: Path) -> bool:
    """Whether a file is ours alone, and its bytes are those that its name tells of."""
    status = path.lstat()
    is_file = stat.S_ISREG(status.st_mode)
    if not is_file or status.st_uid != os.geteuid() or status.st_mode & _OTHERS_WRITE:
        return False
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return path.stem.endswith(f"-{digest}")


def _make(folder: Path, name: str, make: Callable[[Path], Path]) -> Path:
    """Puts a new library into a folder, whole or not at all."""
    with tempfile.TemporaryDirectory(dir=folder) as draft:
        built = make(Path(draft))
        built.chmod(0o700)
        with built.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
        path = folder / f"{name}-{digest}.so"
        os.replace(built, path)  # others may build the same one now
    names = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(names)
    finally:
        os.close(names)
    return path


def _sweep(folder: Path) -> None:
    """Removes what builds that were killed have left; no build takes a day."""
    for path in folder.glob("tmp*"):
        with contextlib.suppress(FileNotFoundError):  # another process sweeps as well
            if time.time() - path.lstat().st_mtime > _DAY:
                shutil.rmtree(path, ignore_errors=True)
