"""The code of the pages: what is in their fences, and running an example."""

import contextlib
import io
import re
import runpy
import sys
from pathlib import Path
from unittest import mock

REPOSITORY = Path(__file__).parents[2]
GUIDES = sorted(path.stem for path in (REPOSITORY / "docs").glob("*.md"))


def blocks(page, language="python"):
    """Returns what stands in the fences of a page."""
    text = (REPOSITORY / page).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def is_of_an_example(block):
    """Returns whether a block is a stretch of an example, which runs."""
    examples = (path.read_text() for path in (REPOSITORY / "examples").glob("*.py"))
    return any(f"\n{block}" in f"\n{text}" for text in examples)


def own(page):
    """Returns the blocks of a page that are no example's."""
    return [block for block in blocks(page) if not is_of_an_example(block)]


def execute(page, given=()):
    """Runs what is a page's own, in order; returns the names that it leaves."""
    names = dict(given)
    for block in own(page):
        exec(block, names)
    return names


def run(name, *flags):
    """Runs an example with flags; returns its names and the lines that it printed."""
    printed = io.StringIO()
    argv = mock.patch.object(sys, "argv", [name, *flags])
    with argv, contextlib.redirect_stdout(printed):
        names = runpy.run_path(str(REPOSITORY / "examples" / name), run_name="__main__")
    return names, printed.getvalue().splitlines()
