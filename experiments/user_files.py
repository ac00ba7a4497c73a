"""Files of the user's, named as FILE.py or FILE.py:NAME: a robot, tasks, an objective.

They run because a command line names them. The config of a run, which may come from a
stranger, is never reason enough; see `cli`.
"""

import contextlib
import hashlib
import os
import re
import runpy
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from .errors import UsageError, reason
from .storage import rundir

T = TypeVar("T")
_FORM = re.compile(r"(.+\.py)(?::(\w+))?", re.DOTALL)


def is_file(text: str | None) -> bool:
    """Returns whether a text names a file."""
    return _FORM.fullmatch(text or "") is not None


def flags(env: str, arm: str) -> list[str]:
    """Returns the flags that name the files among a run's robot and arm, again."""
    named = ["--env", env] * is_file(env)
    return named + ["--arm", arm] * is_file(arm)


def digests(texts: Iterable[str | None]) -> dict[str, str]:
    """Returns which files are named, in words, each with a digest of its content."""
    named = (_FORM.fullmatch(text) or [text, text] for text in texts if text)
    files = {Path(form[1]) for form in named}
    return {
        _content(file): _digest(file)
        for file in sorted(files)
        if file.suffix and file.is_file()
    }


def _content(file: str | Path) -> str:
    return f"the content of {Path(file)}"


def _digest(file: str | Path) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:8]


def named(flag: str, said: str | None, found: str, where: Path) -> str:
    """Returns what to run of what the config of a run has: a file only as it is said.

    Args:
      flag: that would name it.
      said: what the command line has there.
      found: what the config has.
      where: is the config.

    Raises:
      UsageError: if that is a file, and another or none is said.
    """
    if not is_file(found):
        return found
    if said is None or not is_file(said):
        raise UsageError(
            f"{where} has {found}, a file, which runs only if you name it: "
            f"{flag} {found}."
        )
    if not is_same(said, found, where.parent):
        raise UsageError(
            f"{flag} {said} is not valid; it must be the file that {where} has, {found}"
            ", seen from here or from a folder that the run is in, or else one of its "
            "name with the same content."
        )
    return said  # and never what the config says, which is another file from here


def is_same(said: Any, found: Any, run: Path) -> bool:
    """Returns whether a command line and a config name one function of one file.

    A config does not say where its command was started. Most are in the folder of that,
    or below it. A file that was moved is known by its name and its content.

    Args:
      said: in the command line; files alone are compared by more than their text.
      found: in the config.
      run: the folder of the config.
    """
    if said == found:
        return True
    texts = [x for x in (said, found) if isinstance(x, str)]
    forms = [form for x in texts if (form := _FORM.fullmatch(x))]
    if len(forms) < 2 or forms[0][2] != forms[1][2]:
        return False
    own, its = (form[1] for form in forms)
    folders = (Path(), run.resolve(), *run.resolve().parents)
    try:
        if any(_is_same(str(folder / its), own) for folder in folders):
            return True
        began = rundir.find_json(run / rundir.ENVIRONMENT).get(_content(its))
        moved = Path(own).name == Path(its).name and Path(own).is_file()
        return moved and began == _digest(own)
    except (OSError, ValueError):  # as of a stranger's text that names no file
        return False


def made(
    flag: str, text: str, name: str, check: Callable[[Any], T], *args: Any
) -> T:  # fmt: skip
    """Runs a file, calls a function of it, and returns what `check` makes of that.

    Args:
      flag: that named the file.
      text: FILE.py or FILE.py:NAME.
      name: of the function, where the text does not say it.
      check: of what the function returns; raises what is wrong with it.
      *args: of the function.

    Raises:
      UsageError: in one line with file, line and reason, whatever goes wrong.
    """
    form = _FORM.fullmatch(text)
    if form is None:
        raise _refused(flag, text, "it must be FILE.py or FILE.py:NAME")
    file, name = form[1], form[2] or name
    if not Path(file).is_file():
        raise _refused(flag, text, "there is no such file")
    with _blamed(flag, text, file, 1):
        function = runpy.run_path(file).get(name)
    if not callable(function):
        raise _refused(flag, text, f"{file} has no function {name}")
    code = getattr(function, "__code__", None)
    with _blamed(flag, text, file, code.co_firstlineno if code else 1):
        return check(function(*args))


@contextlib.contextmanager
def _blamed(flag: str, text: str, file: str, line: int) -> Iterator[None]:
    """Names the line of a file that an error came by, or else this one."""
    try:
        yield
    except (Exception, SystemExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [x.lineno for x in frames if _is_same(x.filename, file) and x.lineno]
        if isinstance(error, SyntaxError) and _is_same(error.filename, file):
            own.append(error.lineno or line)
        place = f"{file}:{own[-1] if own else line}"
        raise _refused(flag, text, f"{place}: {reason(error)}") from error


def _is_same(one: str | None, other: str) -> bool:
    return one is not None and os.path.realpath(one) == os.path.realpath(other)


def _refused(flag: str, text: str, why: str) -> UsageError:
    return UsageError(f"{flag} {text} is not valid; {why.rstrip('.')}.")
