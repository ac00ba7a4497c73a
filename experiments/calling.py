"""What commands are called, in texts that name one: as the user has called this one."""

import shlex
import sys
from pathlib import Path

COMMAND = "jaxpets"


def usage(module: str, *words: object) -> str:
    """Returns what a help calls a command: `experiments.run fly`, `jaxpets fly`.

    Args:
      module: of it.
      words: behind it.
    """
    called = [f"{__package__}.{module}"]
    if _is_command():
        called = [COMMAND] if module == "run" else [COMMAND, module]
    return " ".join([*called, *map(str, words)])


def line(module: str, *words: object) -> str:
    """Returns a command that can be copied to a shell; see `usage`."""
    quoted = (shlex.quote(str(word)) for word in words)
    return ("" if _is_command() else "python -m ") + usage(module, *quoted)


def _is_command() -> bool:
    return Path(sys.argv[0]).name == COMMAND
