"""The folder `experiments` by the name that a wheel gives it, for editable installs."""

from pathlib import Path

__path__ = [str(Path(__file__).with_name("experiments"))]
