"""`make faults`: what is lost where anything fails while a run writes.

Every phase of a small run, and one that goes on, is killed, or refused by the disk, at
its file operations; it gets signals; its files get flipped bits; two processes want one
folder. After each the same command is run again, and what it leaves must be, bit for
bit, what a run leaves that met nothing. Damaged configs are only read. Needs Linux and
a C compiler. Prints a table in Markdown, and on stderr what was lost. When time ends,
or at SIGTERM or SIGINT, the faults that have begun are seen through, and the table is
of what was tried.
"""

import argparse
import contextlib
import errno
import math
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from faults import configs, log
from faults.lab import FROM_THEN_ON, KILL, ONCE, PHASES, Bench, Fault, Outcome, flip

TWO = "two writers"  # they need both servers, and come last


def main(argv: Sequence[str] | None = None) -> int:
    """Tries all faults; returns how many runs were lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stride", type=int, default=1, help="every how many points")
    parser.add_argument("--signals", type=int, default=60, help="signals per phase")
    parser.add_argument("--flips", type=int, default=5, help="bits per file")
    parser.add_argument("--configs", type=int, default=100_000)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kinds whose name has this in it")
    parser.add_argument("--seconds", type=float, default=math.inf, help="time to spend")
    parser.add_argument("--limit", type=float, default=300, help="s until one hangs")
    parser.add_argument(
        "--log", type=Path, metavar="FILE",
        help="a line of JSON for each fault, as soon as it was tried. Those that the "
        "file has are not tried again, but are in the table: so a bench that was ended "
        "goes on, of the same code. How many operations a run has differs by some per "
        "cent each time, since threads write and poll; a fault is known by its number.",
    )  # fmt: skip
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name).resolve()
        with _ended() as ended:
            outcomes = _tried(folder, args, ended)
        count = 0 if ended() else args.configs
        read = configs.damaged(count, folder) if count else {}
    print("\nDamaged configs:", ", ".join(f"{n} {what}" for what, n in read.items()))
    lost = sum(bool(outcome.wrong) for outcome in outcomes)
    return lost + sum(n for what, n in read.items() if what not in configs.GOOD_ENDS)


def _tried(
    folder: Path, args: argparse.Namespace, ended: Callable[[], bool]
) -> list[Outcome]:
    """Tries what the log does not have; prints the table of both."""
    outcomes = log.read(args.log) if args.log else []
    before = log.tried(outcomes)
    with contextlib.closing(Bench(folder, args.jobs, limit=args.limit)) as bench:
        faults = [x for x in _faults(bench, args) if args.only in x.kind]
        left = [fault for fault in faults if log.name(fault) not in before]
        for outcome in _all(bench, left, args, ended):
            outcomes.append(_told(outcome))
            if args.log:
                log.add(args.log, outcome)
    print(table(outcomes))
    print(f"\n{len(outcomes)} were tried of some {len(faults)}.", flush=True)
    return outcomes


def _told(outcome: Outcome) -> Outcome:
    """Says at once what was lost, should the bench itself be ended."""
    if outcome.wrong:
        print(f"\n{outcome.wrong}: {outcome.fault}, exit {outcome.code}; it said:\n"
              f"{outcome.said[-4000:]}", file=sys.stderr, flush=True)  # fmt: skip
    return outcome


@contextlib.contextmanager
def _ended() -> Iterator[Callable[[], bool]]:
    """Whether a signal has asked for the end; a second one ends the process."""
    event = threading.Event()
    before = {}

    def ask(*_: object) -> None:
        event.set()
        for number, handler in before.items():
            signal.signal(number, handler)

    for number in (signal.SIGTERM, signal.SIGINT):
        before[number] = signal.signal(number, ask)
    try:
        yield event.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _all(
    bench: Bench, faults: list[Fault], args: argparse.Namespace,
    ended: Callable[[], bool],
) -> Iterator[Outcome]:  # fmt: skip
    begin = time.monotonic()

    def over() -> bool:
        return ended() or time.monotonic() - begin > args.seconds

    random.Random(args.seed).shuffle(faults)  # if time ends, what is left is anything
    pairs = [fault for fault in faults if fault.kind == TWO]
    alone = [fault for fault in faults if fault.kind != TWO]
    yield from bench.meet_all(alone, over)
    yield from (bench.two_writers(pair) for pair in pairs if not over())


def _faults(bench: Bench, args: argparse.Namespace) -> Iterator[Fault]:
    random_ = random.Random(args.seed)
    first = random_.randrange(args.stride)
    for phase in PHASES:
        writes, every = bench.operations[phase]
        for i in range(1 + first, writes + 1, args.stride):
            yield Fault("kill -9 at a write", phase, KILL, i, errno.ENOSPC)
            yield Fault("ENOSPC, lasting", phase, FROM_THEN_ON, i, errno.ENOSPC)
        for i in range(1 + first, every + 1, args.stride):
            yield Fault("EIO, once", phase, ONCE, i, errno.EIO)
        # The first run has compiled what the others find compiled: they are shorter.
        seconds = bench.counted(phase, f"{phase}-again")[-1] if args.signals else 0
        for i in range(args.signals):
            number = random_.choice([signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
            # Not before a run has begun: it is a fork of something else until then.
            after = random_.uniform(0.1, seconds)
            yield Fault("signal", phase, at=i, signal=number, after=after)
    files = sorted(bench.files())[:: max(1, args.stride // 5)]
    for i, name in enumerate(files * args.flips):
        damage = partial(flip, name=name, seed=random_.randrange(2**32))
        yield Fault("bit flip", "resume", at=i, damage=damage)
    for i in range(max(1, 20 // args.stride)):
        yield Fault(TWO, "explore", at=i)


def table(outcomes: Sequence[Outcome]) -> str:
    """Returns what was tried and what was lost, a row per kind and phase."""
    columns = ("not equal", "traceback", "hang", "exit code")
    rows = ["| fault | phase | tried | met | " + " | ".join(columns) + " |"]
    rows.append("|---" * (4 + len(columns)) + "|")
    kinds = sorted({(x.fault.kind, x.fault.phase) for x in outcomes})
    for kind, phase in kinds:
        own = [x for x in outcomes if (x.fault.kind, x.fault.phase) == (kind, phase)]
        wrong = Counter(x.wrong for x in own)
        cells = [kind, phase, len(own), sum(x.met for x in own)]
        cells += [wrong[name] for name in columns]
        rows.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(rows)


if __name__ == "__main__":
    sys.exit(min(main(), 100))
