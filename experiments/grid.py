"""A sweep's file: which runs there are, and the command lines of each."""

import itertools
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec

from .errors import UsageError, printable
from .storage import rundir

_NAME = msgspec.Meta(
    pattern=r"^[a-z][a-z-]*(\.[a-z-]+)*\Z", description="a flag's name"
)
_OWN = ("out", "name")  # of the sweep, which looks for its runs there
Flags = dict[str, Any]  # a table in a table is a group: planner.horizon
Plain = bool | int | float | str
Grid = dict[Annotated[str, _NAME], Annotated[list[Any], msgspec.Meta(min_length=1)]]


class Where(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Flags of the runs whose place in the grid is among these."""

    grid: Grid
    flags: Flags


class Sweep(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """What a file says."""

    out: str
    grid: Grid
    flags: Flags = {}
    where: list[Where] = []
    then: list[Flags] = []
    slurm: dict[str, Any] = {}


class Job(NamedTuple):
    """One run: its folder in the sweep's, and a command line for each phase."""

    name: str
    commands: list[list[str]]


def read(path: Path) -> Sweep:
    """Returns what a file says.

    A file with a `base`, another one's path from its folder, says what differs from it:
    entries of the grid and flags one by one, everything else as a whole.

    Raises:
      UsageError: naming the file, and what in it is not valid.
    """
    said = _load(path)
    base = said.pop("base", None)
    if base is None:
        return _sweep(path, said)
    below = path.parent / str(base)
    under = _sweep(below, _load(below))  # which has no base itself
    own = _sweep(path, {"out": under.out, "grid": {}} | said)
    unsaid = {x: getattr(under, x) for x in own.__struct_fields__ if x not in said}
    both = {
        "grid": under.grid | own.grid,
        "flags": _flat(under.flags) | _flat(own.flags),
    }
    return msgspec.structs.replace(own, **unsaid | both)


def _load(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except (OSError, ValueError) as error:  # tomllib's is a ValueError
        raise UsageError(f"{path} is no sweep: {error}") from error


def _sweep(path: Path, said: Mapping[str, Any]) -> Sweep:
    try:
        return msgspec.convert(said, Sweep)
    except msgspec.ValidationError as error:
        raise UsageError(f"{path} is no sweep: {error}") from error


def jobs(sweep: Sweep) -> Iterator[Job]:
    """Returns the runs of a sweep, the last entry of its grid the fastest.

    Raises:
      UsageError: if there is no name for a run, or a value is not one of a flag.
    """
    for where in (*(x.grid for x in sweep.where), *(_split(x)[0] for x in sweep.then)):
        for name in where:
            if name not in sweep.grid:
                raise UsageError(
                    f"grid.{name} of where or then is not valid; the grid has "
                    f"{', '.join(sweep.grid) or 'nothing'}."
                )
    for values in itertools.product(*sweep.grid.values()):
        place = dict(zip(sweep.grid, values, strict=True))
        flags = _flat(sweep.flags)
        for where in sweep.where:
            if _is_at(place, where.grid):
                flags |= _flat(where.flags)
        flags |= {name: _checked(name, value) for name, value in place.items()}
        name = "-".join(rundir.label(_words(value)) for value in values)
        rundir.check_name(name)
        own = ["--out", sweep.out, "--name", name]
        commands = [["explore", *own, *_line(flags)]]
        # A user's file has to be named again, since no run's config may name one.
        own += _line({x: flags[x] for x in ("env", "arm") if x in flags})
        for later in itertools.chain.from_iterable(map(_variants, sweep.then)):
            grid, rest = _split(later)
            if _is_at(place, grid):
                phase, *rest = _phase(rest)
                commands.append([phase, *own, *rest])
        yield Job(name, commands)


def _variants(later: Flags) -> Iterator[Flags]:
    """Returns a later phase once for each combination of what it varies, if anything.

    What its values say goes into the tag, so that each has a folder of its own. A task
    alone would be no tag: its folder could be that of the phase which performs it.
    """
    flags = dict(later)
    vary = _table("vary", flags)
    for values in itertools.product(*vary.values()):
        chosen = dict(zip(vary, values, strict=True))
        given = [str(flags["tag"])] if flags.get("tag") else []
        words = [rundir.label(_words(value)) for value in values]
        if not given and list(vary) == ["task"]:
            given = ["task"]
        tag = "-".join(filter(None, [*given, *words]))
        yield flags | chosen | ({"tag": tag} if vary else {})


def _is_at(place: Mapping[str, Any], grid: Grid) -> bool:
    """Returns whether a run's place in the grid is among these."""
    return all(place.get(name) in among for name, among in grid.items())


def _split(later: Flags) -> tuple[Grid, Flags]:
    """Returns for which runs a later phase is, and its flags."""
    flags = dict(later)
    return _table("grid", flags), flags


def _table(name: str, flags: Flags) -> Grid:
    """Takes a table of lists out of a later phase, an empty one if there is none."""
    try:
        return msgspec.convert(flags.pop(name, {}), Grid)
    except msgspec.ValidationError as error:
        raise UsageError(f"then.{name} is not valid: {error}") from error


def _phase(later: Flags) -> list[str]:
    flags = _flat(later)
    phase = flags.pop("phase", None)
    if phase not in ("zero-shot", "finetune", "distill"):
        raise UsageError(
            f"then.phase {printable(repr(phase))} is not valid; it must be zero-shot, "
            "finetune or distill."
        )
    return [str(phase), *_line(flags)]


def _flat(flags: Mapping[str, Any], group: str = "") -> dict[str, Any]:
    """Returns the flags of tables in tables."""
    found: dict[str, Any] = {}
    for name, value in flags.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{group}{name}.")
        else:
            found[group + name] = _checked(group + name, value)
    return found


def _checked(name: str, value: Any) -> Any:
    if name in _OWN:
        raise UsageError(
            f"{name} = {printable(repr(value))} is not valid as a flag; the `out` of "
            "all runs is on top of the file, and their place in the grid names them."
        )
    try:
        msgspec.convert(name, Annotated[str, _NAME])
        return msgspec.convert(value, Plain | list[Plain])
    except msgspec.ValidationError:
        raise UsageError(
            f"{printable(name)} = {printable(repr(value))} is not valid; it must be "
            "the name of a flag without dashes, and text, a number, true or a list."
        ) from None


def _line(flags: Mapping[str, Any]) -> list[str]:
    """Returns a command line; true is a flag without a value, false its opposite."""
    words: list[str] = []
    for name, value in flags.items():
        if isinstance(value, bool):
            group, dot, last = name.rpartition(".")
            words.append(f"--{name}" if value else f"--{group}{dot}no-{last}")
            continue
        values = value if isinstance(value, list) else [value]
        words += [f"--{name}", *map(str, values)]
    return words


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
