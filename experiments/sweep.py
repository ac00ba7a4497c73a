"""`python -m experiments.sweep SWEEP.toml`: a grid of runs with all their phases."""

import argparse
import contextlib
import ctypes
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from . import calling, grid, remaining, robots, run, signals, status
from .errors import (
    InterruptedRun,
    RunEnd,
    RunError,
    UsageError,
    last_line,
    storage_errors,
)
from .grid import Job, Sweep
from .storage import disk

_EPILOG = """
A sweep is a file like this:

  out = "runs/sweep"

  [grid]                      # a run for each combination, as best-dmc-walker
  arm = ["best", "random"]
  env = ["dmc/cartpole", "dmc/walker"]

  [flags]                     # of explore, for all runs; also what phase 2 starts from
  preset = "laptop"
  seeds = [0, 1, 2]
  planner.horizon = 20

  [[where]]                   # other flags for some of the runs
  grid.env = ["dmc/cartpole"]
  flags.trial-length = 250

  [[then]]                    # after exploration, in this order
  phase = "zero-shot"

  [[then]]
  grid.env = ["dmc/walker"]   # for these alone
  phase = "zero-shot"
  task = "stand,walk"
  tag = "horizon"             # once for each: horizon-20 and horizon-30
  vary."task-planner.horizon" = [20, 30]

  [slurm]                     # of submitit, with --slurm
  slurm_partition = "gpu"
  timeout_min = 60

With base = "other.toml" a file says what differs from another one: entries of its grid
and flags one by one, everything else as a whole.

The same command continues a sweep: it leaves out what is complete."""
_POLL = 0.5  # seconds
_PR_SET_PDEATHSIG = 1  # of prctl, in <linux/prctl.h>


class _Phases:
    """One run, as a job of a cluster has it; it goes on when it was preempted."""

    def __init__(self, command: Sequence[str]) -> None:
        self.command = list(command)

    def __call__(self) -> int:
        with subprocess.Popen(self.command) as process:
            try:
                return process.wait()
            finally:
                process.terminate()  # if submitit leaves first: it stops as it should

    def checkpoint(self) -> Any:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs what is left; returns the first exit code that is not 0."""
    parser = argparse.ArgumentParser(
        prog=calling.usage("sweep"),
        description="Runs a grid of runs, each with all its phases.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, metavar="SWEEP.toml", help="as below")
    parser.add_argument(
        "--jobs", type=int, metavar="N",
        help="runs at a time; by default one for each GPU. With more, runs share GPUs",
    )  # fmt: skip
    parser.add_argument("--only", default="", help="the runs whose name has this in it")
    parser.add_argument("--list", action="store_true", help="show the runs, start none")
    parser.add_argument("--slurm", action="store_true", help="run jobs of SLURM")
    parser.add_argument("--run", help="do this run alone, here; jobs call it")
    parser.add_argument("--parent", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.jobs is not None and args.jobs < 1:
        parser.error(f"--jobs {args.jobs} is not valid; it must be 1 or more.")
    try:
        if args.parent is not None:
            _end_with(args.parent)
        sweep = grid.read(args.file)
        jobs = [job for job in remaining.named(sweep) if args.only in job.name]
        if not jobs:
            raise UsageError(f"--only {args.only} is not valid; no run is called so.")
        if args.run is not None:
            return _run(jobs, args.run)
        with robots.without_gl():
            left = remaining.left(sweep, jobs)
        print(f"{len(jobs)} runs, {len(jobs) - len(left)} of them complete", flush=True)
        if args.list:
            for job in jobs:
                print(job.name, "left" if job in left else "complete", sep="  ")
        if args.list or not left:
            return 0
        module = f"{__package__}.sweep"
        command = [sys.executable, "-m", module, str(args.file), "--run"]
        start = _on_slurm if args.slurm else _here
        code = start(sweep, left, command, args.jobs)
    except RunEnd as error:
        signals.say(last_line(error))
        return error.exit_code
    status.main([sweep.out])
    return code


def _run(jobs: Sequence[Job], name: str) -> int:
    """Runs the phases of one run until one does not end well."""
    for job in jobs:
        if job.name == name:
            return next(filter(None, map(run.main, job.commands)), 0)
    raise UsageError(f"--run {name} is not valid; there is no such run.")


def _end_with(parent: int) -> None:
    """Has the end of the sweep that started this run be a SIGHUP to it; on Linux.

    A sweep that is killed stops no run, and this one would keep its folder from the
    same command. The kernel signals as each thread of the sweep ends: of the signals
    that stop a run only a SIGHUP may come again.

    Raises:
      InterruptedRun: if the sweep is gone already.
    """
    if sys.platform != "linux":
        return
    # A sweep under nohup would have it ignored; this session has no terminal.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    # The first of these threads is that of `_here`, which waits for this run.
    libc = ctypes.CDLL(None)
    libc.prctl(_PR_SET_PDEATHSIG, ctypes.c_ulong(signal.SIGHUP))
    if os.getppid() != parent:
        raise InterruptedRun("the sweep that has started it is gone")


def _here(
    sweep: Sweep, left: Sequence[Job], command: Sequence[str], jobs: int | None
) -> int:
    """Runs several at a time on this machine, each on one of its GPUs."""
    gpus = _gpus()
    count = jobs or max(len(gpus), 1)
    devices: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    for i in range(count):
        devices.put(gpus[i % len(gpus)] if gpus else None)
    shared = -(-count // len(gpus)) if gpus else 1
    logs = Path(sweep.out) / "logs"
    with storage_errors(f"use {logs}"):
        disk.make(logs)
    stop = threading.Event()

    def one(job: Job) -> int:
        if stop.is_set():
            return InterruptedRun.exit_code
        device, begin = devices.get(), time.monotonic()
        log = logs / f"{job.name}.txt"
        try:
            with storage_errors(f"start {job.name}"):
                code = started(job, log, device)
        except RunError as error:  # of this one; the others go on
            print(f"{job.name}: {error}", flush=True)
            return error.exit_code
        finally:
            devices.put(device)
        return _told(job, code, log, f"  {time.monotonic() - begin:.0f} s")

    def started(job: Job, log: Path, device: str | None) -> int:
        with disk.opened(log, os.O_WRONLY | os.O_APPEND) as file:
            process = subprocess.Popen(
                [*command, job.name, "--parent", str(os.getpid())],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=_environment(device, shared),
                # A terminal's Ctrl-C would be a second signal, which ends it at once.
                start_new_session=True,
            )
            while process.poll() is None:
                if stop.wait(_POLL):
                    process.send_signal(signal.SIGTERM)
                    process.wait()
        return process.returncode

    with (
        signals.first_signal(lambda number: stop.set()),
        ThreadPoolExecutor(count) as pool,
    ):
        codes = list(pool.map(one, left))
    return next(filter(None, codes), 0)


def _environment(gpu: str | None, shared: int) -> dict[str, str]:
    """Returns what a run sees of this machine: one GPU, or its share of one."""
    found = dict(os.environ)
    if gpu is not None:
        found["CUDA_VISIBLE_DEVICES"] = gpu
    if shared > 1:
        found.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{0.9 / shared:.2f}")
    return found


def _gpus() -> list[str]:
    """Returns the GPUs that runs may use; asking jax would take their memory."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [x for x in chosen.split(",") if x]
    # CUDA counts from 0 what a container has, whatever the files are called.
    return [str(i) for i, _ in enumerate(Path("/dev").glob("nvidia[0-9]*"))]


def _on_slurm(
    sweep: Sweep, left: Sequence[Job], command: Sequence[str], jobs: int | None,
    cluster: str = "slurm",
) -> int:  # fmt: skip
    """Gives every run to SLURM, and waits; the runs need this process no more."""
    try:
        import submitit
    except ImportError:
        need = 'pip install "jaxpets[slurm]"'
        raise UsageError(f"--slurm needs submitit; {need} brings it.") from None
    try:
        executor = submitit.AutoExecutor(Path(sweep.out) / "slurm", cluster=cluster)
        executor.update_parameters(**sweep.slurm)
        if jobs is not None:
            executor.update_parameters(slurm_array_parallelism=jobs)
    except (RuntimeError, NameError, TypeError, ValueError) as error:
        raise UsageError(f"--slurm is not valid here: {error}") from error
    try:
        with executor.batch():
            started = [executor.submit(_Phases([*command, job.name])) for job in left]
    except (RuntimeError, OSError) as error:  # as sbatch says it
        raise UsageError(f"SLURM took no job: {error}") from error
    codes = [_ended(job, task) for job, task in zip(left, started, strict=True)]
    return next(filter(None, codes), 0)


def _ended(job: Job, task: Any) -> int:
    """Waits for a job of a cluster; returns the exit code of its run."""
    try:
        code = task.result()
    except Exception as error:  # submitit's are of many kinds
        print(f"{job.name}: {str(error).splitlines()[0]}", flush=True)
        return 1
    return _told(job, code, task.paths.stderr)


def _told(job: Job, code: int, log: Path, after: str = "") -> int:
    """Says how a run has ended; returns its exit code."""
    how = "complete" if code == 0 else f"exit code {code}, see {log}"
    # Another end leaves no such line, but the log may have one of an earlier start.
    why = _error(log) if 1 < code < InterruptedRun.exit_code else ""
    print(f"{job.name}: {how}{after}{why}", flush=True)
    return code


def _error(log: Path) -> str:
    """Returns the last error that a log tells of, behind which another may write."""
    lines: list[str] = []
    with contextlib.suppress(OSError):
        lines = log.read_text(errors="replace").splitlines()
    told = (f"  {line}" for line in reversed(lines) if line.startswith("error: "))
    return next(told, "")


if __name__ == "__main__":
    signals.as_program(main)
