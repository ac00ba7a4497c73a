"""`python -m experiments.tools.shipped`: cards of the models that come along, again.

They are made of the files and of the committed logs.
"""

import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from jaxpets import models

from ..storage import disk
from ..storage.archive import unpack
from . import card

RESULTS = Path(__file__).parents[2] / "results"
# Zero-shots at the paper's size with the models that come along, in the runs that
# explored; those of the suite's domains are in an archive.
_SHIPPED = {
    "best": "paper/best-1-3/zero-shot-060-refit-400",
    "epistemic": "paper-no-refit/epistemic-0/zero-shot-060",
}
# Three of these explored once more, alone; logs of the others are with the arm's.
_SUITE = ("dmc20/shipped.tar.xz", "dmc20/best.tar.xz")


def text(name: str) -> str:
    """Returns the card of a model that comes along."""
    with _logs(name) as returns:
        return card.text(models.path(name), returns[0], returns)


@contextlib.contextmanager
def _logs(name: str) -> Iterator[list[Path]]:
    """Gives the zero-shots of a model, each in the folder of what explored."""
    laptop = sorted((RESULTS / "pretrained-laptop" / name).glob("zero-shot-???"))
    if name in _SHIPPED:
        yield [RESULTS / _SHIPPED[name], *laptop]
        return
    run = f"best-{name.replace('/', '-')}"
    with tempfile.TemporaryDirectory() as folder:
        for path in _SUITE:
            if unpack(RESULTS / path, Path(folder), f"./{run}/"):
                break
        yield [*sorted(Path(folder, run).glob("zero-shot-*")), *laptop]


def main() -> int:
    """Writes the cards; returns the exit code."""
    for name in models.names():
        disk.write(models.path(name).with_suffix(".md"), text(name).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
