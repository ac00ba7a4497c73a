"""The folder `experiments` by the name that a wheel gives it, for editable installs.

Hatchling renames a folder in a wheel only: an editable install of it is a path.
"""

from pathlib import Path

__path__ = [str(Path(__file__).with_name("experiments"))]
