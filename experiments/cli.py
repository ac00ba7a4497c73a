"""From the command line to a Config, and to the folders that it speaks of."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from . import flags, model_file, robots, user_files
from .config import (
    Basics,
    Compute,
    Config,
    CriticConfig,
    Phase,
    Phased,
    Process,
    Science,
    part,
)
from .entries import flag, from_json
from .errors import CheckpointError, UsageError
from .parallel.distributed import ProcessSpec
from .presets import preset_config
from .storage import rundir
from .validate import (
    check_explored,
    check_names,
    check_process,
    require,
    validate,
)


def parse(argv: Sequence[str], source: Config | None = None) -> Config:
    """Returns the validated Config of a command line.

    zero-shot, finetune and distill take their defaults from the run they start from, so
    that a preset or a number need not be said twice.

    Args:
      argv: the command line.
      source: explores what they start from, where that is not there yet.

    Raises:
      UsageError: with one line for the user.
      CheckpointError: if there is no run to start from, or it cannot be read.
      SystemExit: after `--help`.
    """
    for word in argv:
        try:
            word.encode()
        except UnicodeEncodeError as error:
            valid = "it must be text in UTF-8"
            raise UsageError(f"{word!a} is not valid; {valid}.") from error
    phase, rest = _phase(argv)
    config = _config(phase, rest, _preset(rest))  # what is wrong comes before the run
    if phase in ("zero-shot", "finetune", "distill"):
        explored = _numbers(source) if source else _explored(config)
        if phase != "zero-shot":  # which alone has one
            explored = dataclasses.replace(explored, critic=CriticConfig())
        config = _config(phase, rest, explored)
        check_explored(config, explored)
        _check_file(config)
    validate(config)
    if phase != "report":
        robots.check_tasks(config, robots.of(config))
        if user_files.is_file(config.arm):
            from . import build

            build.check_arm(config)
    return config


def process_spec(argv: Sequence[str]) -> ProcessSpec | None:
    """Returns which process of several this one is; None if it is alone.

    Raises:
      UsageError: with one line for the user.
      SystemExit: after `--help`.
    """
    phase, rest = _phase(argv)
    process, _ = flags.of(Process, rest, Process())
    if process == Process(debug=process.debug):
        return None
    config = _config(phase, rest, _preset(rest))
    if config.coordinator_address == "auto":
        return ProcessSpec(None, None, None)
    return ProcessSpec(
        config.coordinator_address, config.num_processes, config.process_id
    )


def explored_run(config: Config) -> Path:
    """Returns the folder of the exploration run that a config speaks of."""
    return _source(config).resolve()


def run_name(config: Config) -> str:
    """Returns what the folder of an exploration is called in that of all runs."""
    return config.name or f"{rundir.study(vars(config))}-{rundir.label(config.arm)}"


def results_folder(config: Config) -> Path:
    """Returns where later phases put theirs: in the run they start from, if it is one.

    What starts from a file of a model goes into a folder of its name.

    Raises:
      UsageError: if that is a file, or the folder of a run.
    """
    source = explored_run(config)
    if not source.is_file():
        return source
    assert config.source is not None
    name = "-".join(config.source.with_suffix("").parts)
    shipped = config.source.parts[:1] == (model_file.PRETRAINED,)
    folder = config.out.resolve() / (name if shipped else source.stem)
    own = folder.is_file() or (folder / rundir.CONFIG).exists()
    valid = f"another; what {config.source} does goes to {folder}, which is "
    valid += "a file" if folder.is_file() else "an exploration's"
    require(not own, "--out", config.out, valid)
    return folder


def variant(config: Config, step: int) -> str:
    """Returns the name of the folder of a later phase: zero-shot-060-TASKS-TASK-TAG."""
    tasks = [rundir.label(config.tasks)] if config.tasks else []
    task = [rundir.label(config.task)] if config.task != "all" else []
    tag = [config.tag] if config.tag else []
    return "-".join([config.phase, f"{step:03d}", *tasks, *task, *tag])


def _phase(argv: Sequence[str]) -> tuple[Phase, list[str]]:
    """Returns the phase and the rest of a command line; it may be the first word."""
    word = bool(argv) and not argv[0].startswith("-")
    chosen, rest = flags.of(Phased, ["--phase", *argv] if word else argv, Phased())
    if len(rest) == len(argv) and not word:
        if {"-h", "--help"} & set(argv):
            flags.explain(_preset(argv))
        phases = ", ".join(get_args(Phase))
        raise UsageError(f"--phase is missing; it must be {phases}.")
    return chosen.phase, rest


def _preset(argv: Sequence[str]) -> Config:
    """Returns the numbers of the preset, arm and robot that a command line names."""
    basics, _ = flags.of(Basics, argv, Basics())
    return preset_config(basics.preset, basics.arm, basics.env)


def _config(phase: Phase, argv: Sequence[str], default: Config) -> Config:
    """Returns the config of a command line that has no phase."""
    role: Any = flags.COMMANDS[phase]
    own, rest = flags.of(role, argv, part(default, role), phase)
    if rest:
        default = flags.beside(rest, default, phase)
    config = dataclasses.replace(default, **vars(own), phase=phase)
    check_names(config)
    check_process(config)
    return config


def _source(config: Config) -> Path:
    """Returns the folder of a run, or the file of a model."""
    return model_file.named(config.source or config.out / run_name(config))


def _explored(config: Config) -> Config:
    """Returns the defaults that an exploration run gives to a later phase.

    They are numbers: what to call it and where to write are never another run's.
    """
    folder = _source(config)
    if folder.is_file():
        return _numbers(model_file.config_of(folder, config))
    path = folder / rundir.CONFIG
    if not path.is_file():
        raise CheckpointError(
            f"there is no exploration run in {folder}. Run --phase explore first, or "
            "name a run with --from."
        )
    data = rundir.read_json(path)
    # What an older version did not write is that of the run's own preset, arm and
    # robot, not of those that happen to be said again.
    own = from_json(data, config, str(path))
    phase = data.get("phase", "explore")
    valid = f"an exploration; name the run that it began with, as {folder.parent}"
    require(phase == "explore", "--from", folder, valid)
    if "critic" not in data.get("distill", {}):
        data.pop("distill", None)  # another recipe, which no exploration depends on
    explored = from_json(data, preset_config(own.preset, own.arm, own.env), str(path))
    for entry in ("env", "arm"):
        said, found = getattr(config, entry), getattr(explored, entry)
        named = user_files.named(flag(entry), said, found, path)
        explored = dataclasses.replace(explored, **{entry: named})
    return _numbers(explored)


def _numbers(explored: Config) -> Config:
    return Config(**vars(part(explored, Science)), **vars(part(explored, Compute)))


def _check_file(config: Config) -> None:
    """Refuses to learn where nothing is to learn on."""
    if explored_run(config).is_file():
        valid = "zero-shot or distill; a file of a model has no data"
        require(config.phase != "finetune", "--phase", config.phase, valid)
        valid = "0; a file of a model has no data"
        epochs, updates = config.refit.num_epochs, config.critic.num_updates
        require(epochs == 0, "--refit.num-epochs", epochs, valid)
        require(updates == 0, "--critic.num-updates", updates, valid)
