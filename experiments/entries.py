"""The entries of a config: what is valid for each, and their way to JSON and back.

What comes from outside, in a file or as flags, is read here and nowhere else: a value
is what the annotation of its field says, or it is refused by name.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from . import user_files
from .config import Config, Mark, Run
from .errors import CheckpointError

T = TypeVar("T")
# Makes an error of an entry's name, what it is and what it must be; None: not there.
Refuse = Callable[[str, Any, str | None], Exception]

# What phase 2 has from exploration as it was, and what its phases leave to each other.
_PAST = ("random_trials", "training", "planner")
_UNREAD = {
    "zero-shot": (*_PAST, "finetune_trials", "tuning", "distill"),
    "finetune": (*_PAST, "eval_trials", "critic", "policy", "distill"),
    "distill": (*_PAST, "finetune_trials", "tuning", "critic", "policy"),
}


class Entry(NamedTuple):
    """A field that is not a group of fields."""

    name: str  # behind the groups it is in: planner.horizon
    marks: tuple[Mark, ...]

    def of(self, config: Any) -> Any:
        """Returns what it is in a config."""
        return operator.attrgetter(self.name)(config)


@functools.cache
def hints(role: type) -> dict[str, Any]:
    """Returns the annotation of every field of a dataclass."""
    found = get_type_hints(role, include_extras=True)
    return {field.name: found[field.name] for field in dataclasses.fields(role)}


def entries(role: type, group: str = "") -> Iterator[Entry]:
    """Returns the entries of a dataclass and of the groups in it."""
    for name, hint in hints(role).items():
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            yield from entries(hint, f"{group}{name}.")
        else:
            about = getattr(hint, "__metadata__", ())
            yield Entry(group + name, tuple(x for x in about if isinstance(x, Mark)))


def is_read(name: str, phase: str) -> bool:
    """Returns whether a phase reads an entry; explore keeps all for later ones."""
    return name.partition(".")[0] not in _UNREAD.get(phase, ())


def flag(name: str) -> str:
    """Returns the flag of an entry."""
    return "--" + {"source": "from"}.get(name, name).replace("_", "-")


def valid(hint: Any) -> str:
    """Says in words what an annotation asks for."""
    if get_origin(hint) is Annotated:
        for about in hint.__metadata__:
            if isinstance(about, msgspec.Meta):
                return about.description or f"{about.ge:,} to {about.le:,}"
        return valid(hint.__origin__)
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(map(valid, get_args(hint)))
    if get_origin(hint) is Literal:
        return ", ".join(get_args(hint))
    if get_origin(hint) is tuple:
        return f"a list, each {valid(get_args(hint)[0])}"
    names = {bool: "true or false", int: "a whole number", str: "text", Path: "a path"}
    return names.get(hint, "None")


def read(
    role: type[T], data: Any, default: T, refuse: Refuse, group: str = ""
) -> T:  # fmt: skip
    """Returns a dataclass with the entries that were given, the others by default.

    Args:
      role: the dataclass.
      data: what was given, by the names of fields; groups are mappings too.
      default: the entries that were not.
      refuse: makes the error for an entry that is not valid, or not known.
      group: the names in front of these, with a dot.
    """
    if not isinstance(data, Mapping):
        raise refuse(group[:-1], data, "an object")
    given = {}
    for name, value in data.items():
        hint = hints(role).get(name)
        if hint is None:
            raise refuse(f"{group}{name}", value, None)
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            own = getattr(default, name)
            given[name] = read(hint, value, own, refuse, f"{group}{name}.")
            continue
        try:
            given[name] = msgspec.convert(value, hint, dec_hook=_from_text)
        except msgspec.ValidationError:
            raise refuse(f"{group}{name}", value, valid(hint)) from None
    return dataclasses.replace(default, **given)  # pyright: ignore[reportArgumentType]


def _from_text(kind: type, value: Any) -> Any:
    """Makes what JSON has as text; no text is none, though Path says it is `.`."""
    if not value:
        raise ValueError("empty")
    return kind(value)


def to_json(config: Any) -> Any:
    """Returns a config, or the value of an entry, as JSON values."""
    return msgspec.json.decode(msgspec.json.encode(config, enc_hook=str))


def from_json(data: Any, default: Config, where: str = "config.json") -> Config:
    """Returns the config that `to_json` wrote; what it lacks is taken from default.

    Args:
      data: of a file, or of any origin.
      default: the entries that are not there.
      where: what an error calls the file.

    Raises:
      CheckpointError: if an entry is not valid, or this version does not know it.
    """

    def refuse(name: str, value: Any, wanted: str | None) -> Exception:
        if wanted is None:
            return CheckpointError(
                f"{where} has an unknown entry {name!r}. Use the version that wrote it."
            )
        entry = f"{name} is" if name else "it is"
        return CheckpointError(f"{where}: {entry} {value!r}, not {wanted}.")

    return read(Config, data, default, refuse)


def differences(
    old: Any, new: Any, where: str = "config.json", run: Path | None = None
) -> list[str]:
    """Returns where two configs in JSON are not of the same run: `entry: old vs new`.

    Which trial completes it may change, and what its phase does not read.

    An entry that `old` lacks, because an older version wrote it, was what is now the
    default. A group of entries that it lacks cannot differ. `where` is what an error
    calls the file of `old`. A file of the user's may be called otherwise than in
    `old`, from another folder, where `run` is the folder of the run.

    Raises:
      CheckpointError: if one of them cannot be read.
    """
    now, then = from_json(new, Config()), from_json(old, Config(), where)
    # distill read it until it had its own.
    once = () if _has_group(old, "distill.critic.") else ("critic.",)
    pairs = {
        entry.name: (entry.of(then), entry.of(now))
        for entry in entries(Run)
        if Mark.GOAL not in entry.marks
        and (is_read(entry.name, now.phase) or entry.name.startswith(once))
        and _has_group(old, entry.name)
    }
    return [
        f"{name}: {to_json(pair[0])} (there) vs {to_json(pair[1])} (now)"
        for name, pair in sorted(pairs.items())
        if pair[0] != pair[1]
        and not (run and user_files.is_same(pair[1], pair[0], run))
    ]


def _has_group(data: Any, name: str) -> bool:
    """Returns whether JSON has the groups that an entry of this name is in."""
    *groups, _ = name.split(".")
    for group in groups:
        if group not in data:
            return False
        data = data[group]
    return True
