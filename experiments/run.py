"""`python -m experiments.run --phase {explore,zero-shot,finetune,report}`."""

import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments import cli
from experiments.config import NUM_TASKS, Config, PlannerNumbers
from experiments.errors import (
    CheckpointError,
    InterruptedRun,
    OutOfMemoryError,
    RunError,
    StorageError,
    UsageError,
)
from experiments.parallel import distributed
from experiments.presets import PRESETS
from experiments.progress import stoppable

if TYPE_CHECKING:  # it brings orbax, which wrong flags need not wait for
    from experiments.storage.folder import RunFolder

# Two checkpoints and one being written, of a paper-sized run of one seed and task.
_NEEDED_BYTES = 64 * 2**20


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one phase and returns the exit code.

    0 done, 1 a bug, 2 usage, 3 checkpoint, 4 diverged, 5 storage, 6 out of memory,
    75 interrupted and resumable.
    """
    arguments = sys.argv[1:] if argv is None else list(argv)
    try:
        # The library logs what a user cannot act on.
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
        with distributed.joined(cli.place(arguments)):
            plain = distributed.on_first(lambda: cli.to_json(cli.parse(arguments)))
            config = cli.from_json(plain, PRESETS["smoke"])
            with _plain_errors(config):
                _dispatch(config)
    except RunError as error:
        if "--debug" in arguments:
            traceback.print_exc()
        kind = "stopped" if isinstance(error, InterruptedRun) else "error"
        print(f"{kind}: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def _dispatch(config: Config) -> None:
    if config.phase == "report":
        from experiments.report import report

        for path in report.write_report(config.out, config.out / "report"):
            distributed.say(f"wrote {path}")
        return
    from experiments.storage.folder import RunFolder

    source = RunFolder(cli.explored_run(config))
    _check_cpu(config)
    if config.phase == "explore":
        with _opened(config, source.path) as run:
            from experiments import phases

            phases.explore(config, run)
        run.say(f"next: python -m experiments.run --phase zero-shot --from {run.path}")
        return
    step = _explored_step(config, source)
    folder = cli.results_folder(config) / _variant(config, step)
    with _opened(config, folder) as run:
        from experiments import phases

        phase = phases.zero_shot if config.phase == "zero-shot" else phases.finetune
        phase(config, source, run, step)
    if config.video is not None and distributed.is_first():
        _video(config, run)


def _variant(config: Config, step: int) -> str:
    """Returns the name of the folder of a later phase: zero-shot-060-forward-TAG."""
    task = [config.task] if config.task != "all" else []
    tag = [config.tag] if config.tag else []
    return "-".join([config.phase, f"{step:03d}", *task, *tag])


@contextmanager
def _opened(config: Config, path: Path) -> Iterator["RunFolder"]:
    """Holds the folder of a run that a signal may stop."""
    from experiments.storage import folder

    plain, default = cli.to_json(config), cli.to_json(PRESETS["paper"])

    def differences(old: dict[str, Any]) -> list[str]:
        return cli.differences(old, plain, cli.CONTINUED, default)

    branches = len(config.seeds)
    if (config.phase, config.task) == ("finetune", "all"):
        branches *= NUM_TASKS
    size = _NEEDED_BYTES * branches
    with (
        _without_gl(),
        stoppable(),
        folder.open_run(path, plain, differences, size) as run,
    ):
        yield run


def _explored_step(config: Config, source: "RunFolder") -> int:
    """Returns the trial whose checkpoint phase 2 starts from."""
    steps = source.steps()
    if not steps:
        raise CheckpointError(f"there is no checkpoint in {source.path}.")
    step = config.at_trial if config.at_trial is not None else steps[-1]
    if step not in steps:
        kept = ", ".join(map(str, steps))
        raise UsageError(f"--at-trial {step} is not valid; it must be one of {kept}.")
    return step


def _video(config: Config, run: "RunFolder") -> None:
    """Renders the first trial of each task; failing at it does not fail the run."""
    from experiments.tools import video
    from jaxpets.envs.half_cheetah import TASK_NAMES

    assert config.video is not None
    names = TASK_NAMES if config.task == "all" else (config.task,)
    for name in names:
        target = config.video
        if len(names) > 1:
            target = target.with_stem(f"{target.stem}-{name}")
        try:
            video.render(
                run.trajectories,
                target,
                task=name,
                seed=config.seeds[0],
                trial=1,
            )
        except RunError as error:
            distributed.say(f"warning: no video; the run is complete: {error}")
            return
        distributed.say(f"wrote {target}")


def _check_cpu(config: Config) -> None:
    """Refuses what would take over an hour on a CPU by mistake."""
    import jax

    if jax.default_backend() != "cpu" or config.allow_cpu:
        return
    _, planner = _search(config)
    model = config.model
    width = model.hidden_size
    products = 24 * width + (model.num_layers - 1) * width**2 + width * 36
    rows = planner.num_samples * planner.num_particles * planner.num_iterations
    steps = _planned_steps(config) * len(config.seeds)
    hours = 2 * products * rows * planner.horizon * steps / 1e11 / 3600
    if hours > 1:
        raise UsageError(
            f"--phase {config.phase} of --preset {config.preset} would take about "
            f"{hours:.0f} hours on this CPU; use a GPU, smaller numbers or --allow-cpu."
        )


@contextmanager
def _plain_errors(config: Config) -> Iterator[None]:
    """Turns what the system says about memory and disk into one line."""
    try:
        yield
    except MemoryError as error:
        raise OutOfMemoryError(_memory_advice(config)) from error
    except OSError as error:
        raise StorageError(f"{error.strerror} ({error.filename}).") from error
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise OutOfMemoryError(_memory_advice(config)) from error


@contextmanager
def _without_gl() -> Iterator[None]:
    """Lets mujoco be imported without OpenGL, which only a video's process needs.

    A MUJOCO_GL that does not work here would end the run on that import.
    """
    chosen = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        del os.environ["MUJOCO_GL"]
        if chosen is not None:
            os.environ["MUJOCO_GL"] = chosen


def _memory_advice(config: Config) -> str:
    flag, planner = _search(config)
    trials = _num_tasks(config)
    flags = ["--seeds", f"--{flag}.num-samples", f"--{flag}.num-particles"]
    if config.phase == "zero-shot":
        trials *= config.eval_trials
        flags.insert(1, "--eval-trials")
    return (
        f"out of memory. {len(config.seeds)} seeds x {trials} trials x "
        f"{planner.num_samples} samples x {planner.num_particles} particles x horizon "
        f"{planner.horizon} are planned at once; lower one of {', '.join(flags)}. The "
        "last checkpoint is intact."
    )


def _search(config: Config) -> tuple[str, PlannerNumbers]:
    """Returns the search of a phase, and what its flags are called."""
    if config.phase == "explore":
        return "planner", config.planner
    return "task-planner", config.task_planner


def _num_tasks(config: Config) -> int:
    """Returns how many tasks are planned for at once; exploration is one."""
    return NUM_TASKS if config.phase != "explore" and config.task == "all" else 1


def _planned_steps(config: Config) -> int:
    """Returns how many steps of environments a seed plans for in a phase."""
    if config.phase == "explore":
        planned = config.num_trials - config.random_trials
        return planned * config.trial_length if config.arm != "random" else 0
    zero_shot = config.phase == "zero-shot"
    trials = config.eval_trials if zero_shot else config.finetune_trials
    return _num_tasks(config) * trials * config.task_length


if __name__ == "__main__":
    sys.exit(main())
