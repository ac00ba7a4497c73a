"""From the command line to a Config, and from a Config to JSON and back."""

import argparse
import contextlib
import dataclasses
import io
import operator
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import tyro

from experiments.config import Config, TaskName, ranges, validate
from experiments.errors import CheckpointError, UsageError
from experiments.parallel.distributed import Place
from experiments.presets import PRESETS, numbers_of
from experiments.storage import rundir

# Explored models that come with the code; see `experiments.tools.pretrained`.
PRETRAINED = Path(__file__).parents[1] / "results" / "pretrained"
# What belongs to a process and not to its run.
_PLACE = Place._fields
# Where a run that is continued may differ from its start.
CONTINUED = (
    "out", "name", "video", "allow_cpu", "debug", "chunk_length", "source", "at_trial",
    *_PLACE,
)  # fmt: skip
# What an explored model is; the names of sizes are those of flags.
_OF_THE_RUN = (
    "preset", "arm", "seeds", "num_bits", "num_trials", "trial_length",
    "model.num_members", "model.hidden_size", "model.num_layers",
)  # fmt: skip


def parse(argv: Sequence[str]) -> Config:
    """Returns the validated Config of a command line.

    zero-shot and finetune take their defaults from the run they start from, so that a
    preset or a number need not be said twice.

    Raises:
      UsageError: with one line for the user.
      SystemExit: after `--help`.
    """
    first = _first_flags(argv)
    for flag in ("name", "tag"):
        _check_name(flag, getattr(first, flag))
    default = numbers_of(first.preset, first.arm)
    if first.phase in ("zero-shot", "finetune"):
        _tyro(argv, default)  # what is wrong with the flags comes before the run
        default = _explored(first, default)
    config = _tyro(argv, default)
    if config.phase in ("zero-shot", "finetune"):
        _check_same_run(config, default)
    validate(config)
    return config


def place(argv: Sequence[str]) -> Place | None:
    """Returns which process of several this one is; None if it is alone.

    Raises:
      UsageError: with one line for the user.
      SystemExit: after `--help`.
    """
    flags = {"--" + name.replace("_", "-") for name in _PLACE}
    if flags.isdisjoint(arg.partition("=")[0] for arg in _joined(argv)):
        return None
    config = _tyro(argv, PRESETS[_first_flags(argv).preset])
    found = Place(*(getattr(config, name) for name in _PLACE))
    _check_place(found, config.phase)
    auto = found.coordinator_address == "auto"
    return Place(None, None, None) if auto else found


def explored_run(config: Config) -> Path:
    """Returns the folder of the exploration run that a config speaks of."""
    name = config.name or f"{config.preset}-{config.arm}"
    return _found(config.source or config.out / name).resolve()


def results_folder(config: Config) -> Path:
    """Returns where later phases put theirs: the run they start from, if it is ours."""
    source = explored_run(config)
    if source.parent != PRETRAINED.resolve():
        return source
    return config.out.resolve() / f"pretrained-{source.name}"


def _found(source: Path) -> Path:
    """Returns a folder, or what comes with the code by the name `pretrained/NAME`."""
    if source.exists() or source.parts[:1] != ("pretrained",):
        return source
    return PRETRAINED.joinpath(*(source.parts[1:] or ("epistemic",)))


def to_json(config: Config) -> dict[str, Any]:
    """Returns the config as JSON values."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {
                field.name: plain(getattr(value, field.name))
                for field in dataclasses.fields(value)
            }
        if isinstance(value, tuple):
            return list(value)
        return str(value) if isinstance(value, Path) else value

    return plain(config)


def from_json(data: dict[str, Any], default: Config) -> Config:
    """Returns the config that `to_json` wrote; what it lacks is taken from default.

    Raises:
      CheckpointError: if there is an entry that this version does not know.
    """

    def fill(data: dict[str, Any], default: Any) -> Any:
        known = {field.name: getattr(default, field.name) for field in fields(default)}
        for name in data:
            if name not in known:
                raise CheckpointError(f"config.json has an unknown entry {name!r}.")
        changes = {}
        for name, value in data.items():
            if dataclasses.is_dataclass(known[name]):
                changes[name] = fill(value, known[name])
            elif name in ("out", "source", "video") and value is not None:
                changes[name] = Path(value)
            else:
                changes[name] = tuple(value) if isinstance(value, list) else value
        return dataclasses.replace(default, **changes)

    fields = dataclasses.fields
    return fill(data, default)


def differences(
    old: dict[str, Any], new: dict[str, Any], ignore: Sequence[str],
    default: dict[str, Any],
) -> list[str]:  # fmt: skip
    """Returns what differs between two configs in JSON, as `field: old vs new`.

    An entry that `old` lacks, because an older version wrote it, stands for that of
    `default`, a config in JSON. A group of entries that it lacks, or an entry that
    `new` lacks, cannot differ.
    """
    lines = []
    for name in sorted({*new} - set(ignore)):
        now = new[name]
        unsaid = now if isinstance(now, dict) else default.get(name, now)
        before = old.get(name, unsaid)
        if isinstance(before, dict) and isinstance(now, dict):
            groups = differences(before, now, (), default.get(name, {}))
            lines += [f"{name}.{line}" for line in groups]
        elif before != now:
            lines.append(f"{name}: {before} (there) vs {now} (now)")
    return lines


def _check_place(place: Place, phase: str) -> None:
    address, count, own = place
    if address in (None, "auto"):
        alone = "left out, unless --coordinator-address is HOST:PORT"
        _require(count is None, "--num-processes", count, alone)
        _require(own is None, "--process-id", own, alone)
    else:
        named = re.fullmatch(r"\S+:[0-9]{1,5}", str(address)) is not None
        _require(named, "--coordinator-address", address, "HOST:PORT or auto")
        given = "1 or more, with --coordinator-address"
        _require(count is not None and count > 0, "--num-processes", count, given)
        below = count is not None and own is not None and 0 <= own < count
        valid = f"0 to one less than --num-processes ({count})"
        _require(below, "--process-id", own, valid)
    one = phase != "report" or address is None
    _require(one, "--coordinator-address", address, "left out in report")


def _require(holds: bool, flag: str, value: Any, valid: str) -> None:
    if not holds:
        raise UsageError(f"{flag} {value} is not valid; it must be {valid}.")


def _first_flags(argv: Sequence[str]) -> argparse.Namespace:
    """Reads the flags that decide about the defaults of the others."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for flag, value in (
        ("--phase", None), ("--preset", "laptop"), ("--arm", "epistemic"),
        ("--out", "runs"), ("--name", None), ("--tag", None), ("--from", None),
    ):  # fmt: skip
        parser.add_argument(flag, default=value, nargs="?")
    first, _ = parser.parse_known_args(_joined(argv))
    if first.preset not in PRESETS:
        wanted = ", ".join(PRESETS)
        raise UsageError(f"--preset {first.preset} is not valid; it must be {wanted}.")
    return first


def _check_name(flag: str, name: str | None) -> None:
    """Refuses what is no name of a folder, or names another folder of phase 2."""
    if name is None:
        return
    try:
        rundir.check_name(name)
    except UsageError as error:
        raise UsageError(f"--{flag}: {error}") from None
    if flag == "tag" and name in get_args(TaskName):
        raise UsageError(f"--tag {name} is not valid; it must not be a task.")


def _check_same_run(config: Config, explored: Config) -> None:
    """Refuses to call a model what it is not, and to learn where nothing is to."""
    for name in _OF_THE_RUN:
        given, found = map(operator.attrgetter(name), (config, explored))
        flag = f"--{name.replace('_', '-')}"
        _require(given == found, flag, given, f"{found}, as in the exploration run")
    if explored_run(config).parent == PRETRAINED.resolve():
        valid = "zero-shot; a model that comes with the code performs, no more"
        _require(config.phase == "zero-shot", "--phase", config.phase, valid)
        epochs = config.refit.num_epochs
        valid = "0; a model that comes with the code has no data"
        _require(epochs == 0, "--refit.num-epochs", epochs, valid)


def _joined(argv: Sequence[str]) -> list[str]:
    """Spells every flag with dashes, as tyro accepts underscores too."""

    def spell(arg: str) -> str:
        flag, equals, value = arg.partition("=")
        return flag.replace("_", "-") + equals + value

    return [spell(arg) if arg.startswith("--") else arg for arg in argv]


def _explored(first: argparse.Namespace, default: Config) -> Config:
    """Returns the defaults that an exploration run gives to a later phase."""
    name = first.name or f"{first.preset}-{first.arm}"
    folder = _found(Path(getattr(first, "from") or Path(first.out) / name))
    path = folder / "config.json"
    if not path.is_file():
        raise CheckpointError(
            f"there is no exploration run in {folder}. Run --phase explore first, or "
            "name a run with --from."
        )
    data = rundir.read_json(path)
    # What an older version did not write is that of the run's preset and arm, not of
    # those that happen to be said again.
    own = from_json(data, default)
    explored = from_json(data, numbers_of(own.preset, own.arm))
    return dataclasses.replace(explored, **dict.fromkeys(_PLACE))


def _tyro(argv: Sequence[str], default: Config) -> Config:
    default = dataclasses.replace(default, phase=tyro.MISSING)
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                Config, args=list(argv), default=default, prog="experiments.run"
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        line = _one_line(errors.getvalue())
        raise UsageError(f"{line.rstrip('.')}.{_range(line)}") from None


def _one_line(text: str) -> str:
    """Shortens the boxed message of tyro to its words."""
    text = text.partition("For full helptext")[0].partition("Argument helptext:")[0]
    lines = [re.sub(r"[─━╭╮╰╯│]+", " ", line) for line in text.splitlines()]
    # The first one is the title of the box.
    return " ".join(" ".join(lines[1:]).split()) or "the flags cannot be read"


def _range(line: str) -> str:
    """Returns what is valid for the number whose flag a message names first."""
    named = re.search(r"--[a-z][a-z.-]*[a-z]", line)
    valid = ranges(PRESETS["smoke"]).get(named.group()) if named else None
    return f" It must be {valid}." if valid else ""
