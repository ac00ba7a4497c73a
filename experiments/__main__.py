"""The command `jaxpets`: a word for each thing there is to do."""

import difflib
import importlib
import sys
from collections.abc import Sequence
from importlib import metadata
from typing import Any, NoReturn

from . import signals
from .calling import COMMAND
from .errors import RunError, UsageError

_PHASES = {
    "explore": "learn a model of a robot, without a reward",
    "zero-shot": "perform tasks with an explored model",
    "distill": "learn a policy that performs tasks without a plan",
    "finetune": "go on learning, with the rewards of tasks",
    "report": "make tables and figures of all runs",
}
# Modules with a `main` of their own, by the word that calls them.
_OTHERS = {
    "study": "explore, perform all tasks and report, one after the other",
    "sweep": "do a grid of runs, on this machine's GPUs or on SLURM",
    "status": "show what runs do, or how they ended",
    "compare": "show what differs between runs",
    "play": "show a robot in the browser, which does what you type",
    "doctor": "say whether runs can start here, and what would help",
}
_ABOUT = f"""usage: {COMMAND} WORD [FLAG ...]

Unsupervised exploration with deep model-based RL, of any robot.

{{}}

{COMMAND} WORD --help       shows the flags of a word
{COMMAND} --list envs       shows all robots
{COMMAND} completion bash   prints the completion of a shell; also zsh, fish"""
_SHELLS = ("bash", "zsh", "fish")


def main(argv: Sequence[str]) -> int:
    """Does what the first word says; returns the exit code, as `run.main`."""
    word, *rest = argv or ["--help"]
    try:
        if word in ("-h", "--help"):
            words = {**_PHASES, **_OTHERS}
            print(_ABOUT.format("\n".join(f"  {n:<11}{t}" for n, t in words.items())))
        elif word == "--version":
            print(f"{COMMAND} {metadata.version('jaxpets')}")
        elif word == "completion":
            print(_completion(rest))
        elif word in _OTHERS:
            module = "play.__main__" if word == "play" else word
            return _module(module).main(rest)
        else:
            _check_word(word)
            return _module("run").main(argv)
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _check_word(word: str) -> None:
    """Refuses what is neither a phase nor a flag of `run`."""
    known = [*_PHASES, *_OTHERS]
    if word.startswith("-") or word in known:
        return
    near = difflib.get_close_matches(word, known, 1)
    hint = f"Perhaps {near[0]}?" if near else f"It must be {', '.join(known)}."
    raise UsageError(f"{word} is no word of {COMMAND}. {hint}")


def _completion(shells: Sequence[str]) -> str:
    if len(shells) != 1 or shells[0] not in _SHELLS:
        said = " ".join(shells) or "with no value"
        raise UsageError(
            f"completion {said} is not valid; it must be {', '.join(_SHELLS)}."
        )
    return _module("flags").completion(shells[0], _OTHERS)


def _module(name: str) -> Any:
    """Returns a module of this folder; the library alone lacks what they need."""
    try:
        return importlib.import_module(f".{name}", __package__)
    except ModuleNotFoundError as error:
        need = f'pip install "{COMMAND}[experiments]"'
        raise UsageError(f"{error.name} is not installed; {need} brings it.") from error


def command() -> NoReturn:
    """Runs `main` as a program, and leaves."""
    signals.as_program(lambda: main(sys.argv[1:]))


if __name__ == "__main__":
    command()
