"""The command line as tyro reads it: which flags a phase has, and what was given."""

import contextlib
import dataclasses
import difflib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import msgspec
import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
)

from . import calling
from .config import Basics, Config, Science, Variant, part
from .entries import entries, flag, hints, is_read, read
from .errors import UsageError
from .place import Compute, Origin, Output, Process

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Explore(Process, Compute, Science, Output, Basics):
    """Phase 1: learns a model, without a reward.

    Flags of phase 2 are kept for the commands that start from this run.
    """


@dataclasses.dataclass(frozen=True)
class ZeroShot(Process, Compute, Science, Origin, Variant, Output, Basics):
    """Phase 2: performs tasks with an explored model and learns nothing.

    Settings are those of the exploration run unless a flag says otherwise.
    """


@dataclasses.dataclass(frozen=True)
class Finetune(ZeroShot):
    """Phase 2 goes on: learns from the trials of a task, too.

    Settings are those of the exploration run unless a flag says otherwise.
    """


@dataclasses.dataclass(frozen=True)
class Distill(ZeroShot):
    """Phase 2 in a network: performs any task without a plan.

    Settings are those of the exploration run unless a flag says otherwise.
    """


@dataclasses.dataclass(frozen=True)
class Report:
    """Makes tables and figures of all logs in a folder."""

    out: Path = Path("runs")
    """Folder of all runs; the report is in OUT/report."""
    debug: bool = False
    """Show tracebacks."""


@dataclasses.dataclass(frozen=True)
class Overview(Origin, Variant, Output, Basics):
    """The flags that are used most."""


COMMANDS = {
    "explore": Explore,
    "zero-shot": ZeroShot,
    "finetune": Finetune,
    "distill": Distill,
    "report": Report,
}
_ABOUT = """Unsupervised exploration with deep model-based RL, of any robot.

{}

The same command continues a run that was stopped.

`--phase explore`, anywhere among the flags, means the same as `explore`.

These are the flags used most. `explore --help` shows all flags of a phase, and
`--list envs` all robots."""


def of(
    role: type[T], argv: Sequence[str], default: T, command: str | None = None
) -> tuple[T, list[str]]:
    """Returns the flags of a dataclass and what is left of a command line.

    Args:
      role: its entries are the flags.
      argv: the command line.
      default: what flags that are not given are.
      command: the phase that `--help` explains; None to leave that to others.

    Raises:
      UsageError: if the value of a flag is not valid.
      SystemExit: after `--help`.
    """
    shown = default
    # Without a help tyro need not read the source of every class for its texts.
    quick = (tyro.conf.HelptextFromCommentsOff,)
    if command is not None and {"-h", "--help"} & set(argv):
        shown, quick = _without_unread(default, command), ()
    found, rest = tyro.cli(
        type(shown),
        args=list(argv),
        default=shown,
        return_unknown_args=True,
        add_help=command is not None,
        config=quick,
        registry=_AS_WRITTEN,
        prog=calling.usage("run", command),
    )
    return read(role, _given(found), default, refuse), rest


def _without_unread(default: T, phase: str) -> T:
    """Returns defaults whose `--help` leaves out what a phase does not read.

    It does not take such flags, either, which are to be refused by name.
    """
    hidden = [
        (name, Annotated[hint, tyro.conf.Suppress], getattr(default, name))
        for name, hint in hints(type(default)).items()
        if not is_read(name, phase)
    ]
    role: Any = dataclasses.make_dataclass(
        "Shown", hidden, bases=(type(default),), frozen=True
    )
    role.__doc__ = type(default).__doc__
    return role(**vars(default))


def explain(default: Config) -> None:
    """Prints what there is to do and the flags that are used most.

    Raises:
      SystemExit: when that is done.
    """
    docs = {name: str(role.__doc__) for name, role in COMMANDS.items()}
    phases = [f"- {name}: {doc.splitlines()[0]}" for name, doc in docs.items()]
    tyro.cli(
        Overview,
        args=["--help"],
        default=part(default, Overview),
        description=_ABOUT.format("\n".join(phases)),
        registry=_AS_WRITTEN,
        prog=calling.usage("run", "PHASE"),
    )


def completion(shell: str, others: Mapping[str, str]) -> str:
    """Returns what a shell must read to complete the command `jaxpets`.

    Args:
      shell: bash, zsh or fish.
      others: what words that are not phases do.
    """
    plain = {
        name: dataclasses.make_dataclass(name, [], namespace={"__doc__": text})
        for name, text in others.items()
    }
    plain["study"] = Explore  # whose flags it takes
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(
            {**COMMANDS, **plain},
            args=["--tyro-print-completion", shell],
            prog=calling.COMMAND,
        )
    return printed.getvalue()


def beside(rest: Sequence[str], default: Config, command: str) -> Config:
    """Returns what is left of a command line, as flags of other phases.

    In a report they do nothing, so that one command line may serve all phases. Others
    must say what is so anyway.

    Raises:
      UsageError: for what is no flag, or is not for this phase.
    """
    found, rest = of(Config, rest, default)
    if rest:
        said = rest[0].partition("=")[0]
        flags = [flag(entry.name) for entry in entries(COMMANDS[command])]
        near = difflib.get_close_matches(said.replace("_", "-"), flags, 1)
        hint = f"Perhaps {near[0]}?" if near else "See --help."
        raise UsageError(f"{said} is not a flag of {command}. {hint}")
    for entry in entries(Config):
        if command != "report" and entry.of(found) != entry.of(default):
            phases = [name for name, role in COMMANDS.items() if entry in entries(role)]
            wanted = f"left out in {command}; it is for {' and '.join(phases)}"
            raise refuse(entry.name, entry.of(found), wanted)
    return found


_AS_WRITTEN = ConstructorRegistry()


@_AS_WRITTEN.primitive_rule
def _words(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Leaves the words behind a flag to `read`, whose errors say what is valid."""
    if info.type is bool or dataclasses.is_dataclass(info.type):
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=_metavar(info.type),
        instance_from_str=list,
        is_instance=lambda value: True,
        str_from_instance=lambda value: (
            list(map(str, value)) if isinstance(value, tuple) else [str(value)]
        ),
    )


def _metavar(hint: Any) -> str:
    """Returns what a help calls a value."""
    first, *_ = *get_args(hint), None
    if get_origin(hint) is Literal:
        return "{" + ",".join(get_args(hint)) + "}"
    if get_origin(hint) is tuple:
        return f"[{_metavar(first)} ...]"
    if first is not None:
        return _metavar(first)
    return {int: "INT", float: "FLOAT", Path: "PATH"}.get(hint, "TEXT")


def _given(found: Any) -> dict[str, Any]:
    """Returns the values of the flags that were given, by the names of fields."""
    given: dict[str, Any] = {}
    for name, hint in hints(type(found)).items():
        value = getattr(found, name)
        if dataclasses.is_dataclass(value):
            given[name] = _given(value)
        elif isinstance(value, list):
            given[name] = _values(hint, value)
        elif isinstance(value, bool):
            given[name] = value
    return given


def _values(hint: Any, words: list[str]) -> Any:
    """Returns what is meant by the words behind a flag; a single one is no list."""
    hint = hint.__origin__ if get_origin(hint) is Annotated else hint
    if get_origin(hint) is tuple:
        return [_value(get_args(hint)[0], word) for word in words]
    return _value(hint, words[0]) if len(words) == 1 else words


def _value(hint: Any, word: str) -> Any:
    """Returns a word, or the number or None that it stands for where that is valid."""
    for meant in (int, float, {"None": None}.__getitem__):
        with contextlib.suppress(ValueError, KeyError, msgspec.ValidationError):
            return msgspec.convert(meant(word), hint)
    return word


def refuse(name: str, value: Any, wanted: str | None) -> UsageError:
    """Returns the error for a flag's value, of one or of several words."""
    shown = value
    if isinstance(value, list):
        shown = " ".join(map(str, value)) or "with no value"
    return UsageError(f"{flag(name)} {shown} is not valid; it must be {wanted}.")
