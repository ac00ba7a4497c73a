"""Stops refits that would take minutes: each ends with 75 in five seconds.

    PYTHONPATH=.:tests python -m faults.refits --times 200

A process of its own, forked, compiles and refits a small model and gets a signal up to
ten seconds after its run has begun. Prints how many ended with which code and when.
"""

import argparse
import concurrent.futures
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from faults.lab import NAME, REFIT, Bench, Fault

from experiments.storage import status

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class End(NamedTuple):
    """How a refit ended."""

    code: int | None
    seconds: float  # after the signal
    said: str


def main() -> int:
    """Returns how many refits did not end as they should."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name).resolve()
        bench = Bench(folder, args.jobs, ("explore",), limit=3000)
        with concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
            ends = [pool.submit(_stop, bench, folder, i) for i in range(args.times)]
            found = []
            for end in concurrent.futures.as_completed(ends):
                found.append(end.result())
                print(found[-1], flush=True)
        bench.close()
    seconds = sorted(end.seconds for end in found)
    print(Counter(end.code for end in found), f"{seconds[0]:.1f}-{seconds[-1]:.1f} s")
    return sum(end.code != 75 or end.seconds > 5 for end in found)


def _stop(bench: Bench, folder: Path, i: int) -> End:
    """Begins a refit, and stops it."""
    own = Path(tempfile.mkdtemp(dir=folder))
    shutil.copytree(folder / "explore" / "out", own / "out")
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        run = pool.submit(bench.start, own, Fault("refit", REFIT))
        while not (begun := list((own / "out" / NAME).glob("zero-shot*/status.json"))):
            if run.done():
                raise RuntimeError(run.result()["said"])
            time.sleep(0.01)
        time.sleep(random.Random(i).uniform(0, 10))
        process = status.read(begun[0].parent).pid
        assert process is not None
        os.kill(process, SIGNALS[i % len(SIGNALS)])
        begin = time.monotonic()
        found = run.result()
        seconds = time.monotonic() - begin
    shutil.rmtree(own)
    return End(found["code"], seconds, found["said"])


if __name__ == "__main__":
    sys.exit(min(main(), 100))
