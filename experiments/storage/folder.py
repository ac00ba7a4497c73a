"""A run's folder and who writes to it: the one owner of its files.

Every process of a run may call what is here: process 0 has the folder, and what it
reads or fails at gets to the others.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import errors
from ..errors import StorageError
from ..parallel import distributed
from . import checkpoint, disk, identity, metrics, pytrees, rundir, status, trajectories
from .environment import environment, remember
from .identity import Differences
from .status import Writer
from .trackers import Tracked


class RunFolder(NamedTuple):
    """The folder of a run; `open_run` gives one to write to, any path one to read."""

    path: Path
    milestones: Sequence[int] = ()  # trials whose checkpoints are never dropped
    # Of a run that is written to:
    started: Mapping[str, Any] | None = None  # its config
    differences: Differences = lambda then, now, where: []
    status: Writer | None = None  # on process 0
    tracked: Tracked | None = None  # likewise

    def say(self, text: str) -> None:
        """Prints lines for the user; the last one gets into status.json."""
        distributed.say(text)
        self.update(line=text.splitlines()[-1])

    # Reading.

    def config(self) -> dict[str, Any]:
        """Returns the config that the run was started with, in JSON."""
        return distributed.on_first(lambda: rundir.read_json(self.path / rundir.CONFIG))

    def steps(self) -> list[int]:
        """Returns the trials that have a checkpoint, oldest first."""
        return distributed.on_first(lambda: checkpoint.steps(self._checkpoints))

    def below(self, pattern: str) -> list["RunFolder"]:
        """Returns the folders in this one that have such a name, and a config."""
        names = distributed.on_first(partial(rundir.below, self.path, pattern))
        return [RunFolder(self.path / name) for name in names]

    def find_json(self, name: str) -> dict[str, Any]:
        """Returns the object in a file of this name, an empty one if there is none."""
        return distributed.on_first(lambda: rundir.find_json(self.path / name))

    def has_trajectories(self) -> bool:
        """Returns whether what a video is made of is there, and whole."""
        return distributed.on_first(lambda: trajectories.is_whole(self.trajectories))

    def performed(self, num_rows: int, *files: str) -> bool:
        """Returns whether a phase that ends with so many rows, and files, has ended.

        If it has and then lost a part, what is left of its log is set aside.
        """
        return distributed.on_first(lambda: self._performed(num_rows, files))

    def restore(self, template: Any, *, part: bool = False) -> tuple[int, Any] | None:
        """Returns trial and state of the last checkpoint, None before the first.

        Args:
          template: as in `checkpoint.restore`.
          part: whether the template may be a part of what was saved.
        """
        found = self._restore(template, None, part)
        return found[:2] if found else None

    def restore_trial(self, trial: int, template: Any, *, part: bool = False) -> Any:
        """Returns the state after a trial.

        Raises:
          CheckpointError: if it was not kept.
        """
        found = self._restore(template, trial, part)
        assert found is not None  # a trial that is asked for and not there is an error
        return found[1]

    def resume(self, template: Any, first: int = 0) -> tuple[int, Any] | None:
        """Returns what `restore` does, and cuts off what was logged after it.

        What the log has lost is said: it costs rows, never a run.

        Args:
          template: as in `checkpoint.restore`.
          first: the trial before those of this run.
        """
        found = self._restore(template, None, False)
        last, meta = (found[0], found[2]) if found else (first, {})
        resume = partial(metrics.resume, self._log, first, last, meta.get("rows"))
        for line in distributed.on_first(resume):
            self.say(f"warning: {line}")
        return found[:2] if found else None

    # Writing.

    def record(
        self, trial: int, rows: Sequence[Mapping[str, Any]], state: Any, finite: Any
    ) -> None:
        """Logs a trial and saves what was learned; it is on the disk on return.

        Args:
          trial: newer than all before.
          rows: of the log.
          state: what to go on from.
          finite: the part of it whose floats must be finite.
        """

        def write() -> None:
            metrics.append_rows(self._log, rows)
            self._save(trial, state, {"rows": len(rows)}, finite)
            if self.tracked is not None:
                self.tracked.rows(trial, rows)

        distributed.on_first(write)

    def save(self, step: int, state: Any) -> None:
        """Saves a state whose floats must be finite."""
        distributed.on_first(lambda: self._save(step, state, {}, state))

    def log(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Writes the log of a phase that ends with it, all rows at once."""

        def write() -> None:
            metrics.replace_rows(self._log, rows)
            if self.tracked is not None:
                self.tracked.rows(rows[0]["explored_trials"], rows)

        distributed.on_first(write)

    def track_video(self, step: int, name: str, path: Path) -> None:
        """Shows a video in the tracker, if there is one."""
        if self.tracked is not None:
            self.tracked.video(step, name, path)

    def save_trajectories(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes what a video is made of."""
        distributed.on_first(lambda: trajectories.save(self.trajectories, arrays))

    def export(self, name: str, write: Callable[[Path], object]) -> None:
        """Replaces a file that only others read by what `write` writes."""

        def replace() -> None:
            with disk.replaced(self.path / name) as target:
                write(target)

        distributed.on_first(replace)

    def computes(self, **entries: str) -> list[str]:
        """Keeps what computes the run's numbers beside the rest of its environment.

        Returns:
          A line per entry that is another one than when the run began.
        """
        path = self.path / rundir.ENVIRONMENT
        return distributed.on_first(lambda: remember(path, entries))

    def write_json(self, name: str, data: Any) -> None:
        """Replaces a JSON file."""
        distributed.on_first(lambda: rundir.write_json(self.path / name, data))

    def update(self, **changes: Any) -> None:
        """Puts into status.json how far the run is.

        Args:
          **changes: fields of `status.Status`.
        """
        if self.status is not None:
            self.status.update(**changes)

    def interrupted(self, reason: str) -> None:
        """Puts into status.json that this process was stopped; any thread may."""
        if self.status is not None:
            self.status.end(status.INTERRUPTED, reason)

    def lost_steps(self, trial: int) -> list[int]:
        """Returns, of every row of a trial, the steps from where physics diverged."""
        return distributed.on_first(lambda: metrics.lost_steps(self._log, trial))

    @property
    def trajectories(self) -> Path:
        """The file of `save_trajectories`."""
        return self.path / rundir.TRAJECTORIES

    # On process 0, but for `_restore`.

    @property
    def _checkpoints(self) -> Path:
        return self.path / rundir.CHECKPOINTS

    @property
    def _log(self) -> Path:
        return self.path / rundir.METRICS

    def _restore(
        self, template: Any, step: int | None, part: bool
    ) -> tuple[int, Any, dict[str, Any]] | None:
        kept = []

        def read() -> tuple[int, dict[str, Any], dict[str, Any]] | None:
            found = checkpoint.restore(
                self._checkpoints, template, step=step, part=part,
                warn=lambda line: self.say(f"warning: {line}"), foreign=self._foreign,
            )  # fmt: skip
            if found is None:
                return None
            kept.append(found[1])
            return found[0], found[2], pytrees.describe(found[1])

        found = distributed.on_first(read)
        if found is None:
            return None
        number, meta, leaves = found
        like = template(leaves) if callable(template) else template
        return number, pytrees.shared(kept[0] if kept else None, like), meta

    def _foreign(self, meta: dict[str, Any]) -> str | None:
        return identity.foreign(self.path, meta, self.started, self.differences)

    def _save(self, step: int, state: Any, meta: dict[str, Any], finite: Any) -> None:
        checkpoint.save(
            self._checkpoints, step, state, meta | identity.of(self.path),
            finite=finite, milestones=self.milestones,
        )  # fmt: skip

    def _performed(self, num_rows: int, files: Sequence[str]) -> bool:
        found = metrics.rows_by_trial(self._log).total()
        lost = [path for path in map(self.path.joinpath, files) if not path.is_file()]
        lost += [self.trajectories] * (not trajectories.is_whole(self.trajectories))
        lost += [self._log] * (found != num_rows)
        if not lost:
            return True
        if found or self.trajectories.exists():
            self.say(f"warning: {lost[-1]} is not whole: performing again.")
        metrics.cut_log(self._log, 0)
        return False


@contextlib.contextmanager
def open_run(
    path: Path, config: dict[str, Any], differences: Differences, needed_bytes: int,
    model: str | None = None, entries: Sequence[str] = (),
) -> Iterator[RunFolder]:  # fmt: skip
    """Holds a run's folder for as long as the run lasts: locked, and accounted for.

    Args:
      path: made if it is not there.
      config: in JSON; kept beside what comes of it.
      differences: says what of two configs differs and may not.
      needed_bytes: how much must be free there.
      model: digest of the file of a model that the run starts from, if it is one.
      entries: names of what the robot observes, in order, if they have any.

    Raises:
      CheckpointError: if the folder is in use, or of another config, model or robot.
      StorageError: if it cannot be written to.
    """
    writer = Writer(path, config["phase"])
    tracked = Tracked(path, config)
    settle = partial(identity.settle, path, config, differences, model, entries)
    held = _held(path, settle, needed_bytes, writer, tracked)
    with distributed.held_by_first(held):
        own = (writer, tracked) if distributed.is_first() else (None, None)
        yield RunFolder(path, tuple(config["milestones"]), config, differences, *own)


@contextlib.contextmanager
def _held(
    path: Path, settle: Callable[[], None], needed_bytes: int,
    writer: Writer, tracked: Tracked,
) -> Iterator[None]:  # fmt: skip
    with rundir.lock(path):
        disk.sweep(path)
        rundir.probe(path, needed_bytes)
        settle()
        for line in remember(path / rundir.ENVIRONMENT, environment()):
            distributed.say(f"warning: {line}")
        writer.begin()
        try:
            with contextlib.closing(tracked):
                yield
        except BaseException as error:
            stopped = isinstance(error, KeyboardInterrupt)  # InterruptedRun is one
            with contextlib.suppress(StorageError):  # the first error says more
                state = status.INTERRUPTED if stopped else status.FAILED
                writer.end(state, errors.reason(error))
            raise
        writer.end(status.COMPLETE)
