"""The command line: `python -m experiments.run {explore,zero-shot,...,report}`."""

import functools
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import calling, cli, robots, signals, user_files
from .config import Config
from .cost import check_cpu, memory_advice
from .entries import differences, from_json, to_json
from .errors import (
    CheckpointError,
    ExitCode,
    OutOfMemoryError,
    RunEnd,
    RunError,
    StorageError,
    UsageError,
    last_line,
    stop_behind,
)
from .model_file import ModelFile, Source
from .parallel import distributed
from .progress import Watch

if TYPE_CHECKING:  # it brings orbax, which wrong flags need not wait for
    from .storage.folder import RunFolder

# Two checkpoints and one being written, of a paper-sized run of one seed and task.
_NEEDED_BYTES = 64 * 2**20


def main(argv: Sequence[str] | None = None, watch: Watch | None = None) -> int:
    """Runs one phase and returns the exit code.

    0 done, 1 a bug, 2 usage, 3 checkpoint, 4 diverged, 5 storage, 6 out of memory,
    75 interrupted and resumable.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        # The library logs what a user cannot act on.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
        if arguments[:1] == ["--list"]:
            _list(arguments[1:])
            return 0
        with _plain_warnings(), distributed.joined(cli.process_spec(arguments)):
            with robots.without_gl():
                plain = distributed.on_first(lambda: to_json(cli.parse(arguments)))
            config = from_json(plain, Config())
            with _plain_errors(config):
                _dispatch(config, watch or Watch())
    except RunEnd as error:
        if "--debug" in arguments:
            traceback.print_exc()
        signals.say(last_line(error))
        return ExitCode(error)
    return 0


def _list(words: Sequence[str]) -> None:
    """Prints what there is of a kind."""
    if list(words) != ["envs"]:
        said = " ".join(words) or "with no value"
        raise UsageError(f"--list {said} is not valid; it must be envs.")
    with robots.without_gl(), _plain_errors(Config()):
        print(robots.listing("mujoco"), flush=True)


def _dispatch(config: Config, watch: Watch) -> None:
    if config.phase == "report":
        from .report import report

        for path in report.write_report(config.out, config.out / "report"):
            distributed.say(f"wrote {path}")
        return
    with ExitStack() as stack:
        stack.enter_context(robots.without_gl())
        _run(config, stack.close, watch)


def _run(config: Config, with_gl: Callable[[], None], watch: Watch) -> None:
    """Runs a phase that leaves a folder; `with_gl` allows what comes after OpenGL."""
    from . import programs
    from .storage.folder import RunFolder

    check_cpu(config)
    programs.keep_on_gpu()
    path = cli.explored_run(config)
    source: Source = ModelFile(path) if path.is_file() else RunFolder(path)
    if config.phase == "explore":
        with _opened(config, source.path, source) as run:
            from . import phases

            phases.explore(config, run, watch)
        named = ["--from", str(run.path), *user_files.flags(config.env, config.arm)]
        run.say(f"next: {calling.line('run', 'zero-shot', *named)}")
        return
    step = _explored_step(config, source)
    folder = cli.results_folder(config) / cli.variant(config, step)
    begins = None
    if config.policy:
        from . import policy

        # A folder that is made with a wrong one is refused to the corrected command.
        robot = robots.of(config)
        names = robots.names(config, robot)
        begins = policy.of_file(Path(config.policy), robot, config.env, names)
    with _opened(config, folder, source) as run:
        from . import distilling, phases

        perform = {
            "zero-shot": functools.partial(phases.zero_shot, begins=begins),
            "finetune": phases.finetune,
            "distill": distilling.distill,
        }[config.phase]
        perform(config, source, run, step, watch)
        if config.video is not None and distributed.is_first():
            with_gl()
            _video(config, run, step, watch)


@contextmanager
def _opened(config: Config, path: Path, source: Source) -> Iterator["RunFolder"]:
    """Holds the folder of a run that a signal may stop.

    Args:
      config: of the run.
      path: of its folder.
      source: what it starts from; an exploration from itself.
    """
    from .storage import environment, folder, rundir

    plain = to_json(config)
    model = source.digest() if isinstance(source, ModelFile) else None
    branches = len(config.seeds)
    if config.phase == "finetune":
        branches *= len(robots.names(config, robots.of(config)))
    size = _NEEDED_BYTES * branches
    differ = functools.partial(differences, run=path)
    entries = robots.entries(config)
    with (
        signals.stoppable() as late,
        folder.open_run(path, plain, differ, size, model, entries) as run,
        _plain_errors(config),
    ):
        if distributed.is_first() and not distributed.is_alone():
            late.seconds += 0.5  # the others first: jax aborts them when this one goes
        late.tell = run.interrupted
        files = (config.env, config.arm, config.tasks, config.policy)
        robot = robots.digests(config)
        lines = run.computes(**user_files.digests(files), **robot)
        if not isinstance(source, ModelFile):
            explored = source.find_json(rundir.ENVIRONMENT)
            lines += environment.compare_environment(explored, robot)
        for line in dict.fromkeys(lines):
            run.say(f"warning: {line}; what was computed before is kept as it is")
        yield run


def _explored_step(config: Config, source: Source) -> int:
    """Returns the trial whose checkpoint phase 2 starts from."""
    steps = source.steps()
    if not steps:
        raise CheckpointError(f"there is no checkpoint in {source.path}.")
    step = config.at_trial if config.at_trial is not None else steps[-1]
    if step not in steps:
        kept = ", ".join(map(str, steps))
        raise UsageError(f"--at-trial {step} is not valid; it must be one of {kept}.")
    return step


def _video(config: Config, run: "RunFolder", step: int, watch: Watch) -> None:
    """Renders the first trial of each task; failing at it does not fail the run."""
    from .tools import video

    assert config.video is not None
    names = robots.chosen(config, robots.of(config)).names
    for i, name in enumerate(names):
        watch.begin("video")
        watch.says(f"video {i + 1} of {len(names)}")
        target = config.video
        if len(names) > 1:
            target = target.with_stem(f"{target.stem}-{name}")
        try:
            video.render(
                run.trajectories,
                target,
                env=config.env,
                task=name,
                seed=config.seeds[0],
                trial=1,
            )
        except RunError as error:
            distributed.say(f"warning: no video; the run is complete: {error}")
            return
        watch.did("video", 1)
        distributed.say(f"wrote {target}")
        run.track_video(step, name, target)


@contextmanager
def _plain_errors(config: Config) -> Iterator[None]:
    """Turns what the system says about signals, memory and disk into one line."""
    try:
        yield
    except RunError:
        raise
    except Exception as error:
        if (plain := _plain(error, config)) is None:
            raise
        raise plain from error


def _plain(error: Exception, config: Config) -> RunEnd | None:
    if (stop := stop_behind(error)) is not None:
        return stop
    full = isinstance(error, RuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
    if full or isinstance(error, MemoryError):
        return OutOfMemoryError(memory_advice(config))
    if isinstance(error, OSError):
        doing = f"use {error.filename}" if error.filename else "go on"
        return StorageError(
            f"cannot {doing} ({error.strerror or error}). Check the disk, and what "
            "reads the output, and run the same command."
        )
    return None


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Shows warnings as a line each, without the source that they come from."""

    def show(message: Warning | str, *_: Any) -> None:
        distributed.say(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        # Here and not where it writes, as that is done by another thread.
        warnings.filterwarnings("ignore", module="orbax")
        yield


if __name__ == "__main__":
    signals.as_program(main)
