"""status.json: what a run is doing or how it ended, and which process says so.

A process that was killed cannot write that. Its number, its host and when it started
are in the file, so that a reader on that host sees that it is gone.
"""

import contextlib
import dataclasses
import os
import socket
import threading
from pathlib import Path
from typing import Any

import msgspec

from ..errors import CheckpointError, StorageError, storage_errors
from . import disk, rundir

RUNNING, INTERRUPTED, FAILED, COMPLETE, KILLED = (
    "running", "interrupted", "failed", "complete", "killed",
)  # fmt: skip
_LOCK_SECONDS = 1.0


@dataclasses.dataclass(frozen=True)
class Status:
    """What status.json says; None is what it does not, as those of older versions."""

    state: str
    """running, interrupted, failed or complete; as it is read also killed."""
    reason: str = ""
    """Why it was interrupted or failed."""
    phase: str | None = None
    trial: int | None = None
    """The last one that is saved."""
    num_trials: int | None = None
    """The trial that completes the run."""
    steps_per_second: float | None = None
    """Environment steps of a branch, by this process."""
    seconds_left: float | None = None
    line: str | None = None
    """What it said last."""
    host_bytes: int | None = None
    """Memory that the process holds, as far as the system tells."""
    device_bytes: int | None = None
    """Memory of its arrays on a device, the most of any, as far as devices tell."""
    pid: int | None = None
    host: str | None = None
    process_start: int | None = None
    """When the process started, in the clock ticks since boot that /proc has."""
    time: str | None = None
    """Of this entry, in UTC."""


class Writer:
    """Keeps the status.json of a run; any thread may call it."""

    def __init__(self, folder: Path, phase: str) -> None:
        self._path = folder / rundir.STATUS
        self._phase = phase
        self._lock = threading.Lock()
        self._status = Status("")

    def begin(self) -> None:
        """Says that this process runs it; how far it got before is kept.

        Raises:
          StorageError: if it cannot be written.
        """
        try:
            before = _parsed(self._path)
        except CheckpointError:
            before = Status("")
        self._status = dataclasses.replace(
            before,
            state=RUNNING,
            reason="",
            phase=self._phase,
            steps_per_second=None,
            seconds_left=None,
            pid=os.getpid(),
            host=socket.gethostname(),
            process_start=_started(os.getpid()),
        )
        self._change()

    def update(self, **changes: Any) -> None:
        """Writes how far the run is; a disk that fails is found by what must be kept.

        Args:
          **changes: fields of Status.
        """
        with contextlib.suppress(StorageError):
            self._change(**changes)

    def end(self, state: str, reason: str = "") -> None:
        """Writes how the run ended; nothing is written after it.

        Raises:
          StorageError: if it cannot be written.
        """
        self._change(state=state, reason=reason, seconds_left=None)

    def _change(self, **changes: Any) -> None:
        # Not for ever: what a signal starts may come while a disk hangs.
        if not self._lock.acquire(timeout=_LOCK_SECONDS):
            return
        try:
            if self._status.state == RUNNING:
                changes |= {"time": rundir.now(), "host_bytes": _resident()}
                self._status = dataclasses.replace(self._status, **changes)
                _write(self._path, dataclasses.asdict(self._status))
        finally:
            self._lock.release()


def read(folder: Path) -> Status:
    """Returns the status of a run, which was killed if its process is gone.

    Raises:
      CheckpointError: if there is no status.json, or it is not that of a run.
    """
    status = _parsed(folder / rundir.STATUS)
    pid = status.pid
    if status.state != RUNNING or not is_here(status) or pid is None:
        return status
    if _is_there(pid, status.process_start):
        return status
    return dataclasses.replace(status, state=KILLED, reason=f"process {pid} is gone")


def is_here(status: Status) -> bool:
    """Returns whether a process of this host wrote it."""
    return status.host == socket.gethostname()


def _parsed(path: Path) -> Status:
    data = rundir.read_json(path)
    try:
        return msgspec.convert(data, Status)
    except msgspec.ValidationError as error:
        raise CheckpointError(f"{path} is no status of a run ({error}).") from None


def _write(path: Path, data: dict[str, Any]) -> None:
    """Replaces the file; a full disk has room for no draft, but for what is there."""
    try:
        rundir.write_json(path, data)
    except StorageError:
        text = msgspec.json.encode(data)
        with storage_errors(f"write {path}"), disk.opened(path, os.O_WRONLY) as file:
            os.pwrite(file, text, 0)
            os.ftruncate(file, len(text))


def _is_there(pid: int, started: int | None) -> bool:
    """Tells if a process of this host still runs, and is not another of its number."""
    if _started(os.getpid()) is not None:
        return started is not None and _started(pid) == started
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


def _resident() -> int | None:
    """Returns the bytes of memory that this process holds, None without a /proc."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGESIZE")


def _started(pid: int) -> int | None:
    """Returns when a process that is not over started, None where /proc has none."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    state, *numbers = text.rpartition(")")[2].split()  # the name may hold anything
    return None if state in "ZX" else int(numbers[18])
