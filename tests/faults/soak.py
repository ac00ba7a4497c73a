"""Stops a run at random times, again and again, and lets it go on until it is complete.

    PYTHONPATH=.:tests python -m faults.soak --stops 20 -- --preset paper --name x ...

After `--` are flags of `experiments.run`, --out and --name among them. Every other stop
is a SIGTERM, which has to be answered with 75 in five seconds; the others kill the
process. Prints the memory after each trial, and each stop. With `--stops 0` it prints
the memory of a run that is left alone.
"""

import argparse
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.errors import CheckpointError
from experiments.storage import status
from experiments.storage.status import Status

LIMIT = 5.0  # seconds in which a SIGTERM has to be answered


class End(NamedTuple):
    """How a process ended."""

    code: int
    seconds: float  # after it was stopped; 0 if it was not
    stopped_by: int | None


def main(argv: Sequence[str] | None = None) -> int:
    """Runs until the run is complete; returns how often a promise was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=20)
    parser.add_argument(
        "--after", type=float, nargs=2, default=(15.0, 45.0), metavar="SECONDS",
        help="a process is stopped after so many seconds at least, and at most",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("run", nargs="+", help="flags of experiments.run, after --")
    args = parser.parse_args(argv)
    where = argparse.ArgumentParser(allow_abbrev=False)
    where.add_argument("--out", type=Path, required=True)
    where.add_argument("--name", required=True)
    run = where.parse_known_args(args.run)[0]
    folder, random_ = run.out / run.name, random.Random(args.seed)
    broken, trial, stops = 0, 0, 0
    while True:
        after = random_.uniform(*args.after) if stops < args.stops else None
        number = signal.SIGTERM if stops % 2 else signal.SIGKILL
        end = _run(args.run, folder, after, number)
        before, trial = trial, _status(folder).trial or 0
        kept = trial >= before and _as_promised(end)
        broken += not kept
        print(
            f"{'kept' if kept else 'BROKEN'}: {end}, {trial} trials are saved",
            flush=True,
        )
        if end.stopped_by is None:
            return broken
        stops += 1


def _run(argv: Sequence[str], folder: Path, after: float | None, number: int) -> End:
    """Runs a process, and stops it after some seconds, if it still runs then."""
    process = subprocess.Popen([sys.executable, "-m", "experiments.run", *argv])
    begin, last = time.monotonic(), _status(folder).trial
    while process.poll() is None:
        now = time.monotonic()
        if after is not None and now - begin > after:
            process.send_signal(number)
            return End(process.wait(), time.monotonic() - now, number)
        found = _status(folder)
        if found.trial != last:
            last = found.trial
            held = f"host {found.host_bytes}, device {found.device_bytes} bytes"
            print(f"after trial {last}: {held}", flush=True)
        time.sleep(0.05)
    return End(process.returncode, 0.0, None)


def _as_promised(end: End) -> bool:
    if end.stopped_by is None:
        return end.code == 0
    if end.stopped_by == signal.SIGTERM:
        # Before a run handles signals they end it as they end any program.
        return end.code in (0, 75, -signal.SIGTERM) and end.seconds < LIMIT
    return end.code in (0, -signal.SIGKILL)


def _status(folder: Path) -> Status:
    try:
        return status.read(folder)
    except CheckpointError:  # the run has not begun
        return Status("")


if __name__ == "__main__":
    sys.exit(main())
