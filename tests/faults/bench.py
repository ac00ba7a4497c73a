"""`make faults`: what is lost where anything fails while a run writes.

Every phase of a small run, and one that goes on, is killed, or refused by the disk, at
its file operations; it gets signals; its files get flipped bits; two processes want one
folder. After each the same command is run again, and what it leaves must be, bit for
bit, what a run leaves that met nothing. Damaged configs are only read. Needs Linux and
a C compiler. Prints a table in Markdown, and on stderr what was lost.
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
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from faults import configs
from faults.lab import FROM_THEN_ON, KILL, ONCE, PHASES, Bench, Fault, Outcome, flip


def main(argv: Sequence[str] | None = None) -> int:
    """Tries all faults; returns how many runs were lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stride", type=int, default=1, help="every how many points")
    parser.add_argument("--signals", type=int, default=60, help="signals per phase")
    parser.add_argument("--configs", type=int, default=100_000)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kinds whose name has this in it")
    parser.add_argument("--seconds", type=float, default=math.inf, help="time to spend")
    parser.add_argument("--limit", type=float, default=300, help="s until one hangs")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name).resolve()
        with contextlib.closing(Bench(folder, args.jobs, limit=args.limit)) as bench:
            outcomes = list(map(_told, _all(bench, args)))
        print(table(outcomes), flush=True)
        read = configs.damaged(args.configs, folder) if args.configs else {}
    print("\nDamaged configs:", ", ".join(f"{n} {what}" for what, n in read.items()))
    lost = sum(bool(outcome.wrong) for outcome in outcomes)
    return lost + sum(n for what, n in read.items() if what not in configs.GOOD_ENDS)


def _told(outcome: Outcome) -> Outcome:
    """Says at once what was lost, should the bench itself be ended."""
    if outcome.wrong:
        print(f"\n{outcome.wrong}: {outcome.fault}, exit {outcome.code}; it said:\n"
              f"{outcome.said[-4000:]}", file=sys.stderr, flush=True)  # fmt: skip
    return outcome


def _all(bench: Bench, args: argparse.Namespace) -> Iterator[Outcome]:
    begin = time.monotonic()
    faults = [fault for fault in _faults(bench, args) if args.only in fault.kind]
    random.Random(args.seed).shuffle(faults)  # if time ends, what is left is anything
    yield from bench.meet_all(faults, begin + args.seconds)
    if args.only in "two writers":
        yield from bench.two_writers(max(1, 20 // args.stride))


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
        for _ in range(args.signals):
            number = random_.choice([signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
            # Not before a run has begun: it is a fork of something else until then.
            after = random_.uniform(0.1, bench.seconds[phase])
            yield Fault("signal", phase, signal=number, after=after)
    for name in sorted(bench.files())[:: max(1, args.stride // 5)]:
        seed = random_.randrange(2**32)
        damage = partial(flip, name=name, seed=seed)
        yield Fault("bit flip", "resume", damage=damage)


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
