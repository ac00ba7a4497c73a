"""What is installed, against what the package asks for and is tested with."""

import enum
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from importlib import metadata
from typing import Any, NamedTuple

_NEEDED = "experiments"  # the extra that brings what a run needs


class Mark(enum.Enum):
    """How a thing is: its sign, the same in ASCII, and its colour on a terminal."""

    GOOD = ("✓", "+", 32)
    NOTE = ("-", "-", 2)  # it is not there, and need not be
    POOR = ("!", "!", 33)
    BAD = ("✗", "x", 31)  # no run can start


class Finding(NamedTuple):
    """A line of the output, and what to do where it is not right."""

    mark: Mark
    text: str
    advice: str = ""


def python() -> Iterator[Finding]:
    """Python, against those that the package is tested with."""
    version = platform.python_version()
    text = f"Python {version}, {sys.executable}"
    try:
        own = metadata.metadata("jaxpets")
    except metadata.PackageNotFoundError:
        text = f"{text}; jaxpets is not installed, so that versions are not checked"
        yield Finding(Mark.POOR, text, 'pip install --editable ".[dev]"')
        return
    named = [line.rpartition(" ")[2] for line in own.get_all("Classifier", [])]
    tested = [name for name in named if re.fullmatch(r"3\.\d+", name)]
    mark, advice = Mark.GOOD, ""
    if tuple(map(int, tested[0].split("."))) > sys.version_info:
        mark, advice = Mark.BAD, f"use Python {tested[0]} or later"
    elif version.rpartition(".")[0] not in tested:
        mark, advice = Mark.POOR, f"tested with {', '.join(tested)}"
    yield Finding(mark, text, advice)


def packages() -> Iterator[Finding]:
    """What a run imports, against the versions that pyproject.toml asks for."""
    asked = requirements_of(_NEEDED)
    if not asked:
        return
    found = list(problems(asked))
    if not found:
        shown = ("jax", "mujoco", "mujoco-mjx", "brax", "orbax-checkpoint")
        named = ", ".join(f"{name} {metadata.version(name)}" for name in shown)
        own = metadata.version("jaxpets")
        text = f"jaxpets {own}; {len(asked)} packages as asked for: {named}, ..."
        yield Finding(Mark.GOOD, text)
    yield from found


def extras() -> Iterator[Finding]:
    """What only some runs import."""
    if not requirements_of(_NEEDED):
        return
    named = metadata.metadata("jaxpets").get_all("Provides-Extra", [])
    ours = [x for x in named if x not in ("all", "cuda12", "cuda13", "dev", _NEEDED)]
    lacking: list[str] = []
    for extra in sorted(ours):
        found = list(problems(requirements_of(extra)))
        absent = [finding for finding in found if finding.mark is Mark.BAD]
        lacking += [extra] * bool(absent)
        yield from (finding for finding in found if not absent)
    text = "extras: " + (", ".join(x for x in sorted(ours) if x not in lacking))
    if not lacking:
        yield Finding(Mark.GOOD, text)
        return
    text = f"{text}; without {', '.join(lacking)}"
    yield Finding(Mark.NOTE, text, f'pip install "jaxpets[{",".join(lacking)}]"')


def problems(asked: Sequence[Any]) -> Iterator[Finding]:
    """Finds what is not installed, and what has another version than is asked for."""
    for requirement in asked:
        want = f"{requirement.name}{requirement.specifier}"
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            text = f"{requirement.name} is not installed"
            yield Finding(Mark.BAD, text, f'pip install "{want}"')
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            text = f"{requirement.name} {version}: tested with {requirement.specifier}"
            yield Finding(Mark.POOR, text, f'pip install "{want}"')


def requirements_of(extra: str) -> list[Any]:
    """Returns what an extra and the library ask for, extras in it resolved.

    That is nothing where the code is not installed, but only on the path.
    """
    from packaging.requirements import Requirement

    try:
        every = metadata.requires("jaxpets") or []
    except metadata.PackageNotFoundError:
        return []
    found: dict[str, Any] = {}
    extras = [extra]
    for one in extras:  # which grows
        for text in every:
            requirement = Requirement(text)
            marker = requirement.marker
            if marker is not None and not marker.evaluate({"extra": one}):
                continue
            if requirement.name == "jaxpets":
                extras += [x for x in requirement.extras if x not in extras]
            else:
                found[requirement.name] = requirement
    return list(found.values())
