"""`python -m experiments.status [FOLDER...]`: a table of runs and how far they are."""

import argparse
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from . import calling, signals
from .errors import CheckpointError, printable
from .storage import rundir, status
from .storage.status import Status

_HEADER = ("run", "state", "trial", "steps/s", "left", "memory", "last line")
_EPILOG = """
states:
  running      by a process of this host, or of the one that is named
  interrupted  by a signal; the same command continues
  failed       with an error, which is shown
  complete
  killed       the process is gone and could not say why; the same command continues

It only reads, and may be called while runs write."""


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the table and returns the exit code: 2 if a folder is not there."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("status"),
        description="Shows the runs below folders: what each does, or how it ended.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "folders", nargs="*", type=Path, default=[Path("runs")], metavar="FOLDER",
        help="runs, or folders of runs; by default runs/",
    )  # fmt: skip
    folders = parser.parse_args(argv).folders
    for folder in folders:
        if not folder.is_dir():
            print(f"error: {folder} is no folder.", file=sys.stderr)
            return 2
    rows = [_row(run) for folder in folders for run in _runs(folder)]
    if not rows:
        print(f"no runs in {', '.join(map(str, folders))}")
        return 0
    _print([_HEADER, *rows])
    return 0


def _runs(folder: Path) -> Iterator[Path]:
    """Returns the runs in a folder, but for hidden ones."""
    for run in sorted(path.parent for path in folder.rglob(rundir.STATUS)):
        if not any(part.startswith(".") for part in run.relative_to(folder).parts):
            yield run


def _row(run: Path) -> tuple[str, ...]:
    try:
        found = status.read(run)
    except CheckpointError as error:
        return _cells(run, "unreadable", "", "", "", "", error)
    trial = f"{found.trial}" if found.trial is not None else ""
    trial += f"/{found.num_trials}" if found.num_trials is not None else ""
    running, rate = found.state == status.RUNNING, found.steps_per_second
    speed = f"{rate:.1f}" if running and rate is not None else ""
    left = _left(found.seconds_left) if running else ""
    memory = _memory(found) if running else ""
    return _cells(run, found.state, trial, speed, left, memory, _said(found))


def _cells(*values: object) -> tuple[str, ...]:
    """Returns what is shown of values, which may come from the files of a stranger."""
    return tuple(printable(str(value)).replace("\n", " ") for value in values)


def _said(found: Status) -> str:
    if found.state == status.RUNNING and found.host and not status.is_here(found):
        return f"on {found.host}, {found.time}: {found.line or ''}"
    return found.reason or found.line or ""


def _left(seconds: float | None) -> str:
    if seconds is None:
        return ""
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 60 else f"{minutes / 60:.1f} h"


def _memory(found: Status) -> str:
    """Returns what the host and the device hold, as in `1.2 + 3.4 GB`."""
    held = [x for x in (found.host_bytes, found.device_bytes) if x is not None]
    return " + ".join(f"{x / 1e9:.1f}" for x in held) + " GB" if held else ""


def _print(rows: Sequence[Sequence[str]]) -> None:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    for row in rows:
        cells = (cell.ljust(size) for cell, size in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip()[:width])


if __name__ == "__main__":
    signals.as_program(main)
