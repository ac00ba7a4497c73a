"""Archives of logs, as results keep them."""

import tarfile
from pathlib import Path


def unpack(path: Path, folder: Path, prefix: str = "") -> bool:
    """Unpacks what an archive has below a prefix.

    Args:
      path: of the archive.
      folder: where to.
      prefix: of the names that are wanted, as `./best-dmc-walker/`.

    Returns:
      Whether there is anything.
    """
    found = False
    with tarfile.open(path) as archive:
        # Nothing outside of the folder; a Python before 3.11.4 knows of no filter.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        for member in archive:  # as they come: going back would decompress all again
            if member.name.startswith(prefix):
                archive.extract(member, folder)
                found = True
    return found
