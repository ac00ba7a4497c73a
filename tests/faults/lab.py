"""Runs that meet a fault, and are compared with one that met none."""

import concurrent.futures
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
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.tools import digests

HERE = Path(__file__).parent
ROOT = Path(digests.__file__).parents[2]  # of the code that runs
COUNT, KILL, ONCE, FROM_THEN_ON = 1, 2, 3, 4  # as in shim.c
# Exit codes that are promised: done, a checkpoint's, the disk's, interrupted.
PROMISED = (0, 3, 5, 75)
NAME = "smoke-random"  # of the run: exploring at random is the quickest
RUN = ["--preset", "smoke", "--arm", "random", "--engine", "mujoco"]
EXPLORE = ["--phase", "explore", *RUN, "--milestones", "1", "2"]
PHASES = {
    "explore": EXPLORE,
    "resume": EXPLORE,  # of a run whose last trial is missing
    "zero-shot": ["--phase", "zero-shot", *RUN],
    "finetune": ["--phase", "finetune", *RUN, "--task", "forward",
                 "--refit.num-epochs", "1"],
}  # fmt: skip
REFIT = "refit"  # of minutes, to be stopped
COMMANDS = PHASES | {
    REFIT: ["--phase", "zero-shot", *RUN, "--refit.num-epochs", "10000",
            "--refit.batch-size", "1"],
}  # fmt: skip


class Fault(NamedTuple):
    """What happens to one run."""

    kind: str  # row of the table
    phase: str
    what: int = COUNT
    at: int = 0  # which operation meets it; else its number among those of its kind
    number: int = 0
    signal: int | None = None
    after: float = 0.0
    damage: Callable[[Path], None] | None = None  # done to the folder before the run


class Outcome(NamedTuple):
    """What came of it; `wrong` says what is not as it should be."""

    fault: Fault
    met: bool  # whether the run came to the fault at all
    wrong: str  # "", "not equal", "traceback", "hang" or "exit code"
    code: int | None
    said: str


def listed(folder: Path) -> list[str]:
    """Returns the operations of the runs in a folder, a line each; see shim.c."""
    return (folder / "list").read_text().splitlines()


def flip(folder: Path, name: str, seed: int) -> None:
    """Flips a bit of a file."""
    path, random_ = folder / name, random.Random(seed)
    data = bytearray(path.read_bytes())
    if data:
        data[random_.randrange(len(data))] ^= 1 << random_.randrange(8)
        path.write_bytes(data)


class Bench:
    """Reference runs, servers that fork runs, and a folder for all of it."""

    def __init__(
        self, folder: Path, jobs: int, phases: Sequence[str] = tuple(PHASES),
        limit: float = 300.0,
    ) -> None:  # fmt: skip
        self._folder, self._jobs, self._phases = folder, jobs, phases
        shim = folder / "shim.so"
        flags = ["-std=c11", "-O1", "-shared", "-fPIC", "-o", shim, HERE / "shim.c"]
        subprocess.run(["cc", *map(str, flags), "-ldl"], check=True)
        self._servers: queue.Queue[Server] = queue.Queue()
        for _ in range(jobs):
            self._servers.put(Server(shim, folder / "jax-cache", limit))
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
        before = self._folder / "nothing"
        (before / "out").mkdir(parents=True)
        for phase in self._phases:
            self.before[phase] = before
            folder, writes, every, seconds = self.counted(phase, phase)
            self.operations[phase], self.seconds[phase] = (writes, every), seconds
            self.wanted[phase] = contents(folder / "out")
            if phase == "explore":
                before = self._folder / "two-trials"
                shutil.copytree(folder, before)
                shutil.rmtree(before / "out" / NAME / "checkpoints" / "3")
            else:
                before = folder if phase == "resume" else before

    def counted(self, phase: str, name: str) -> tuple[Path, int, int, float]:
        """Runs a phase; where, its writes, all its operations, and seconds."""
        folder = self._folder / name
        ignored = shutil.ignore_patterns("list")
        shutil.copytree(self.before[phase], folder, ignore=ignored)
        found = self.start(folder, Fault("none", phase, number=errno.EIO))
        assert found["code"] == 0, found
        operations = listed(folder)
        writes = sum(line.startswith("write ") for line in operations)
        return folder, writes, len(operations), found["seconds"]

    def files(self) -> list[str]:
        """Returns what is read of a run that goes on."""
        out = self.before["resume"] / "out"
        every = (str(x.relative_to(out)) for x in out.rglob("*") if x.is_file())
        return [name for name in every if "checkpoints/1/" not in name]

    def start(self, folder: Path, fault: Fault) -> dict[str, Any]:
        """Runs a phase; the answer of `server` and what it said."""
        server = self._servers.get()
        try:
            return server.run(folder, fault)
        finally:
            self._servers.put(server)

    def meet_all(
        self, faults: Sequence[Fault], over: Callable[[], bool] = lambda: False
    ) -> Iterator[Outcome]:
        """Yields outcomes as they come; begins with none once it is over."""

        def meet(fault: Fault) -> Outcome | None:
            return None if over() else self.meet(fault)

        with concurrent.futures.ThreadPoolExecutor(self._jobs) as pool:
            begun = [pool.submit(meet, fault) for fault in faults]
            try:
                for done in concurrent.futures.as_completed(begun):
                    if (outcome := done.result()) is not None:
                        yield outcome
            finally:
                pool.shutdown(cancel_futures=True)

    def meet(self, fault: Fault) -> Outcome:
        """Lets a run meet a fault, runs it again, and compares."""
        folder = self._copied(fault.phase)
        if fault.damage:
            fault.damage(folder / "out")
        first = self.start(folder, fault)
        # One error may strike what a run can do without: it then ends well.
        is_struck = fault.number != 0 and len(listed(folder)) >= fault.at
        again = self.start(folder, Fault("none", fault.phase))
        met = fault.damage is not None or first["code"] != 0 or is_struck
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
        # A log that was damaged has lost rows, and the run has said so.
        lost = fault.damage is not None and "has lost rows of" in first["said"]
        return self._differs(fault.phase, folder, ("metrics.jsonl",) if lost else ())

    def _differs(self, phase: str, folder: Path, but: tuple[str, ...] = ()) -> str:
        found, wanted = contents(folder / "out"), self.wanted[phase]
        names = [name for name in found | wanted if not name.endswith(but)]
        same = all(found.get(name) == wanted.get(name) for name in names)
        return "" if same else "not equal"

    def two_writers(self, fault: Fault) -> Outcome:
        """Starts the same command twice at once: one runs, the other is refused."""
        folder = self._copied(fault.phase)
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            found = list(pool.map(self.start, [folder] * 2, [fault] * 2))
        codes = Counter(x["code"] for x in found)
        if codes in (Counter({0: 2}), Counter({0: 1, 3: 1})):
            wrong = self._differs(fault.phase, folder)
        else:
            wrong = "hang" if None in codes else "exit code"
        shutil.rmtree(folder)
        said = "".join(x["said"] for x in found)
        return Outcome(fault, True, wrong, found[-1]["code"], said)

    def _copied(self, phase: str) -> Path:
        """Returns a new folder with what there is before a phase."""
        folder = Path(tempfile.mkdtemp(prefix="try-", dir=self._folder))
        ignored = shutil.ignore_patterns("list")
        before = self.before[phase]
        return shutil.copytree(before, folder, ignore=ignored, dirs_exist_ok=True)


class Server:
    """A process that forks runs."""

    def __init__(self, shim: Path, cache: Path, limit: float) -> None:
        self._limit = limit  # seconds until a run counts as hung
        shared = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        env = {
            "LD_PRELOAD": str(shim),
            "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}",
            "JAX_PLATFORMS": "cpu",
            "JAX_COMPILATION_CACHE_DIR": shared or str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
            "MUJOCO_GL": "disable",
            "TF_CPP_MIN_LOG_LEVEL": "2",
            # What cannot be cached is compiled each time, and soon: it runs once.
            "XLA_FLAGS": "--xla_backend_optimization_level=0 "
            + os.environ.get("XLA_FLAGS", ""),
        }
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "server.py")],
            env=os.environ | env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for the bench, which sees it through
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def run(self, folder: Path, fault: Fault) -> dict[str, Any]:
        """Runs a phase in a folder; what it said is added to the answer."""
        said = Path(tempfile.mkdtemp(dir=folder)) / "said"
        request = {
            "argv": [*COMMANDS[fault.phase], "--out", str(folder / "out")],
            "out": str(said),
            "root": str(folder / "out"),
            "what": fault.what if fault.number else 0,
            "at": fault.at,
            "number": fault.number,
            "listed": str(folder / "list"),
            "signal": fault.signal,
            "after": fault.after,
            "limit": self._limit,
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
