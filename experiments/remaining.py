"""Which runs of a sweep are left; what is not valid is refused before any starts."""

from collections.abc import Sequence
from pathlib import Path

from . import cli, grid
from .config import Config
from .entries import differences, to_json
from .errors import CheckpointError, UsageError
from .grid import Job, Sweep
from .storage import rundir
from .storage.status import COMPLETE, read


def named(sweep: Sweep) -> list[Job]:
    """Returns all runs; each must have a name of its own."""
    jobs = list(grid.jobs(sweep))
    if len({job.name for job in jobs}) < len(jobs):
        raise UsageError("grid is not valid; two of its runs have one name.")
    return jobs


def left(sweep: Sweep, jobs: Sequence[Job]) -> list[Job]:
    """Returns the runs that are not complete; what is not valid is refused first."""
    out = Path(sweep.out)
    return [job for job in jobs if not _complete(out / job.name, job.commands)]


def _complete(folder: Path, commands: Sequence[Sequence[str]]) -> bool:
    explored = cli.parse(commands[0])
    whole = _is_complete(folder, explored, explored.num_trials)
    trials = read(folder).trial or 0 if whole else 0
    folders: set[str] = set()
    for command in commands[1:]:
        try:
            config, is_explored = cli.parse(command), True
        except CheckpointError:  # nothing is explored yet
            config, is_explored = cli.parse(command, explored), False
        step = explored.num_trials if config.at_trial is None else config.at_trial
        if config.at_trial is None and trials > step:
            raise UsageError(
                f"num-trials is {step}, but {folder} has explored {trials}, after "
                f"which phase 2 would begin. Say at-trial = {step} in then, or choose "
                "another out."
            )
        name = cli.variant(config, step)
        if name in folders:
            raise UsageError(
                f"then is not valid; two phases would write {folder / name}. Give one "
                "of them a tag."
            )
        folders.add(name)
        whole &= is_explored and _is_complete(folder / name, config, None)
    return whole


def _is_complete(folder: Path, config: Config, trial: int | None) -> bool:
    if not (folder / rundir.STATUS).is_file():
        return False
    began = rundir.find_json(folder / rundir.CONFIG)
    where = str(folder / rundir.CONFIG)
    if differences(began, to_json(config), where, folder):
        return False  # the run itself refuses, and says what differs
    try:
        found = read(folder)
    except CheckpointError:  # torn, where a disk was full: the run writes it anew
        return False
    return found.state == COMPLETE and (trial is None or (found.trial or 0) >= trial)
