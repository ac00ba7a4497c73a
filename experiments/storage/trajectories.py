"""trajectories.npz: what a video is made of."""

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from . import disk


def save(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Replaces the file at once."""
    with disk.replaced(path) as draft:
        np.savez_compressed(draft, **dict[str, Any](arrays))


def is_whole(path: Path) -> bool:
    """Returns whether every byte of the file is there as it was written."""
    if path.is_symlink() or not path.is_file():  # a pipe would be waited for
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return False
