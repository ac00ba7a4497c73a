"""`make faults`: what is lost where anything fails while a run writes.

Every phase of a small run is killed, or refused by the disk, at its file operations; it
gets signals; its files get flipped bits; two processes want one folder. After each the
same command is run again, and what it leaves must be, bit for bit, what a run leaves
that met nothing. Damaged configs are only read. Needs Linux and a C compiler. Prints a
table in Markdown, and on stderr what was lost.
"""

import argparse
import concurrent.futures
import contextlib
import errno
import hashlib
import json
import os
import queue
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from faults import configs

from experiments.tools import digests

HERE = Path(__file__).parent
COUNT, KILL, ONCE, FROM_THEN_ON = 1, 2, 3, 4  # as in shim.c
LIMIT = 300.0  # seconds until a run counts as hung
# Exit codes that are promised: done, a checkpoint's, the disk's, interrupted.
PROMISED = (0, 3, 5, 75)
NAME = "smoke-random"  # of the run: exploring at random is the quickest
RUN = ["--preset", "smoke", "--arm", "random", "--engine", "mujoco"]
PHASES = {
    "explore": ["--phase", "explore", *RUN, "--milestones", "1", "2"],
    "zero-shot": ["--phase", "zero-shot", *RUN],
    "finetune": ["--phase", "finetune", *RUN, "--task", "forward",
                 "--refit.num-epochs", "1"],
}  # fmt: skip


class Fault(NamedTuple):
    """What happens to one run."""

    kind: str  # row of the table
    phase: str
    what: int = COUNT
    at: int = 0
    number: int = 0
    signal: int | None = None
    after: float = 0.0
    damage: Callable[[Path], str] | None = None  # done to the folder before the run


class Outcome(NamedTuple):
    """What came of it; `wrong` says what is not as it should be."""

    fault: Fault
    met: bool  # whether the run came to the fault at all
    wrong: str  # "", "not equal", "traceback", "hang" or "exit code"
    code: int | None
    said: str


def main(argv: Sequence[str] | None = None) -> int:
    """Tries all faults; returns how many runs were lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stride", type=int, default=1, help="every how many points")
    parser.add_argument("--signals", type=int, default=60, help="signals per phase")
    parser.add_argument("--configs", type=int, default=100_000)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kinds whose name has this in it")
    parser.add_argument("--seconds", type=float, default=np.inf, help="time to spend")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="faults-") as name:
        folder = Path(name).resolve()
        with contextlib.closing(Bench(folder, args.jobs)) as bench:
            outcomes = list(_all(bench, args))
        print(table(outcomes), flush=True)
        read = configs.damaged(args.configs, folder) if args.configs else {}
    print("\nDamaged configs:", ", ".join(f"{n} {what}" for what, n in read.items()))
    lost = [outcome for outcome in outcomes if outcome.wrong]
    for outcome in lost:
        print(f"\n{outcome.wrong}: {outcome.fault}, exit {outcome.code}; it said:\n"
              f"{outcome.said[-4000:]}", file=sys.stderr)  # fmt: skip
    return len(lost) + sum(
        n for what, n in read.items() if what not in configs.GOOD_ENDS
    )


def _all(bench: "Bench", args: argparse.Namespace) -> Iterator[Outcome]:
    begin = time.monotonic()
    faults = [fault for fault in _faults(bench, args) if args.only in fault.kind]
    random.Random(args.seed).shuffle(faults)  # if time ends, what is left is anything
    yield from bench.meet_all(faults, begin + args.seconds)
    if args.only in "two writers":
        yield from bench.two_writers(max(1, 20 // args.stride))


def _faults(bench: "Bench", args: argparse.Namespace) -> Iterator[Fault]:
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
        yield Fault(
            "bit flip", "explore", damage=lambda x, n=name, s=seed: flip(x, n, s)
        )


def flip(folder: Path, name: str, seed: int) -> str:
    """Flips a bit of a file; returns its name."""
    path, random_ = folder / name, random.Random(seed)
    data = bytearray(path.read_bytes())
    if data:
        data[random_.randrange(len(data))] ^= 1 << random_.randrange(8)
        path.write_bytes(data)
    return name


class Bench:
    """Reference runs, servers that fork runs, and a folder for all of it."""

    def __init__(
        self, folder: Path, jobs: int, phases: Sequence[str] = tuple(PHASES)
    ) -> None:
        self.folder, self._jobs, self._phases = folder, jobs, phases
        shim = folder / "shim.so"
        flags = ["-std=c11", "-O1", "-shared", "-fPIC", "-o", shim, HERE / "shim.c"]
        subprocess.run(["cc", *map(str, flags), "-ldl"], check=True)
        self._servers: queue.Queue[Server] = queue.Queue()
        for _ in range(jobs):
            self._servers.put(Server(shim, folder / "jax-cache"))
        self.operations: dict[str, tuple[int, int]] = {}
        self.seconds: dict[str, float] = {}
        self.wanted: dict[str, dict[str, str]] = {}
        self.before: dict[str, Path] = {}
        self._refer()

    def close(self) -> None:
        while not self._servers.empty():
            self._servers.get().close()

    def _refer(self) -> None:
        """Runs every phase without a fault, on what the phases before it left."""
        before = self.folder / "nothing"
        (before / "out").mkdir(parents=True)
        for phase in self._phases:
            self.before[phase] = before
            for number in (errno.ENOSPC, errno.EIO):  # writes only, then everything
                after = self.folder / f"{phase}-{number}"
                shutil.copytree(before, after, ignore=shutil.ignore_patterns("list"))
                found = self.start(after, Fault("none", phase, number=number))
                assert found["code"] == 0, found
            counts = [
                len(
                    (self.folder / f"{phase}-{number}" / "list").read_text().split("\n")
                )
                for number in (errno.ENOSPC, errno.EIO)
            ]
            self.operations[phase] = counts[0], counts[1]
            self.seconds[phase] = found["seconds"]
            self.wanted[phase] = contents(after / "out")
            assert (
                contents(self.folder / f"{phase}-{errno.ENOSPC}" / "out")
                == (self.wanted[phase])
            ), "two runs without a fault differ"
            if phase == "explore":
                before = after
                # To go on from: the last trial is missing.
                self._two = self.folder / "two"
                shutil.copytree(after, self._two)
                shutil.rmtree(self._two / "out" / NAME / "checkpoints" / "3")

    def files(self) -> list[str]:
        """Returns what is read of a run that has a trial to go."""
        out = self._two / "out"
        every = (path for path in out.rglob("*") if path.is_file())
        return [
            str(x.relative_to(out)) for x in every if "checkpoints/1/" not in str(x)
        ]

    def start(self, folder: Path, fault: Fault) -> dict[str, Any]:
        """Runs a phase; the answer of `server` and what it said."""
        server = self._servers.get()
        try:
            return server.run(folder, fault)
        finally:
            self._servers.put(server)

    def meet_all(self, faults: Sequence[Fault], end: float) -> Iterator[Outcome]:
        def meet(i: int) -> Outcome | None:
            return self.meet(faults[i], i) if time.monotonic() < end else None

        with concurrent.futures.ThreadPoolExecutor(self._jobs) as pool:
            for outcome in pool.map(meet, range(len(faults))):
                if outcome is not None:
                    yield outcome

    def meet(self, fault: Fault, number: int) -> Outcome:
        """Lets a run meet a fault, runs it again, and compares."""
        folder = self.folder / f"try-{number}"
        shutil.copytree(self._two if fault.damage else self.before[fault.phase], folder)
        if fault.damage:
            fault.damage(folder / "out")
        first = self.start(folder, fault)
        again = self.start(folder, Fault("none", fault.phase))
        met = fault.damage is not None or first["code"] != 0
        wrong = self._judge(fault, first, again, folder)
        shutil.rmtree(folder)
        said = first["said"] + again["said"]
        return Outcome(fault, met, wrong, again["code"], said)

    def _judge(
        self, fault: Fault, first: dict[str, Any], again: dict[str, Any], folder: Path
    ) -> str:
        if None in (first["code"], again["code"]):
            return "hang"
        if "Traceback" in first["said"] + again["said"]:
            return "traceback"
        killed = (-signal.SIGKILL,) if fault.what == KILL else ()
        # Before a run handles signals they end it as they end any program.
        killed += (-fault.signal,) if fault.signal else ()
        if first["code"] not in (*PROMISED, *killed):
            return "exit code"
        if again["code"] != 0:
            # A damaged config cannot be guessed: it has to be refused, in one line.
            refused = again["code"] == 3 and again["said"].count("\n") == 1
            return "" if fault.damage and refused else "exit code"
        same = contents(folder / "out") == self.wanted[fault.phase]
        return "" if same else "not equal"

    def two_writers(self, times: int) -> Iterator[Outcome]:
        """Starts the same command twice at once: one runs, the other is refused."""
        fault = Fault("two writers", "explore")
        for i in range(times):
            folder = self.folder / f"two-{i}"
            shutil.copytree(self.before["explore"], folder)
            with concurrent.futures.ThreadPoolExecutor(2) as pool:
                found = list(pool.map(lambda _: self.start(folder, fault), range(2)))  # noqa: B023
            codes = Counter(x["code"] for x in found)
            if codes[0] != 2 and codes != Counter({0: 1, 3: 1}):
                wrong = "exit code"
            else:
                same = contents(folder / "out") == self.wanted["explore"]
                wrong = "" if same else "not equal"
            said = "".join(x["said"] for x in found)
            yield Outcome(fault, True, wrong, max(codes), said)
            shutil.rmtree(folder)


class Server:
    """A process that forks runs."""

    def __init__(self, shim: Path, cache: Path) -> None:
        shared = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        env = {
            "LD_PRELOAD": str(shim),
            "PYTHONPATH": str(Path(digests.__file__).parents[2]),
            "JAX_PLATFORMS": "cpu",
            "JAX_COMPILATION_CACHE_DIR": shared or str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
            "MUJOCO_GL": "disable",
            "TF_CPP_MIN_LOG_LEVEL": "2",
        }
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "server.py")],
            env=os.environ | env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def run(self, folder: Path, fault: Fault) -> dict[str, Any]:
        """Runs a phase in a folder; what it said is added to the answer."""
        said = Path(tempfile.mkstemp(dir=folder)[1])
        request = {
            "argv": [*PHASES[fault.phase], "--out", str(folder / "out")],
            "out": str(said),
            "root": str(folder / "out"),
            "what": fault.what if fault.number else 0,
            "at": fault.at,
            "number": fault.number,
            "listed": str(folder / "list") if fault.kind == "none" else None,
            "signal": fault.signal,
            "after": fault.after,
            "limit": LIMIT,
        }
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline())
        return answer | {"said": said.read_text(errors="replace")}

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(30)


def contents(out: Path) -> dict[str, str]:
    """Returns digests of what a run's numbers are: logs, checkpoints, trajectories."""
    found = dict(digests.found_in(out))
    for path in out.rglob("trajectories.npz"):
        try:
            arrays = dict(np.load(path))
        except Exception as error:
            arrays = {"unreadable": np.frombuffer(str(error).encode(), np.uint8)}
        for name, array in arrays.items():
            key = f"{path.relative_to(out)}:{name}"
            found[key] = hashlib.sha256(array.tobytes()).hexdigest()
    for path in out.rglob("status.json"):
        state = json.loads(path.read_text())["state"]
        found[str(path.relative_to(out))] = state
    return found


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
