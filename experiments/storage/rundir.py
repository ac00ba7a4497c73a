"""The names in a run's folder, its lock, and its JSON files."""

import contextlib
import datetime
import fcntl
import json
import math
import os
import re
import socket
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import msgspec
import numpy as np

from ..errors import (
    CheckpointError,
    StorageError,
    UsageError,
    storage_errors,
)
from . import disk
from .disk import free_bytes, megabytes

CONFIG = "config.json"
ENVIRONMENT = "env.json"
STATUS = "status.json"
IDENTITY = "run.json"
METRICS = "metrics.jsonl"
ORPHANS = f"{METRICS}.orphan"
CHECKPOINTS = "checkpoints"
TRAJECTORIES = "trajectories.npz"

# What can only be one file or folder below another.
Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}\Z")]
_MAX_JSON_BYTES = 1_000_000
MODELS = "models"  # in the place of a preset
HALF_CHEETAH = "pets/half_cheetah"  # the robot of the paper, which no name mentions


def now() -> str:
    """Returns the time in UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def label(text: str) -> str:
    """Returns what folders and logs call a robot or an arm.

    That is its name, with dashes for what no file may be called; a function of a file,
    FILE.py:NAME, is FILE-NAME. One of which nothing is left is a checksum.
    """
    if own := re.fullmatch(r"(.+)\.py(?::(\w+))?", text, re.DOTALL):
        text = "-".join(filter(None, (Path(own[1]).name, own[2])))
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", text).lstrip("._-")[:64]
    return plain or f"{zlib.crc32(text.encode(errors='surrogateescape')):08x}"


def study(config: Mapping[str, Any]) -> str:
    """Returns what a config, in JSON, shares with those it may be compared with.

    That is the preset, and the robot unless it is the paper's, as paper-dmc-walker.
    """
    env = config.get("env", HALF_CHEETAH)
    robot = [] if env == HALF_CHEETAH else [label(env)]
    return "-".join([config["preset"], *robot])


def study_of(run_dir: Path, config: Mapping[str, Any]) -> str:
    """Returns the study of a run: of what a file's model does the preset is `models`.

    How such a model explored is none of the presets that are here.
    """
    is_file = find_json(run_dir / IDENTITY).get("model") is not None
    return study({**config, "preset": MODELS} if is_file else config)


def check_name(name: str) -> None:
    """Raises UsageError unless `name` can only be one folder below the output."""
    try:
        msgspec.convert(name, Name)
    except msgspec.ValidationError:
        shown = name if len(name) <= 64 else name[:61] + "..."
        raise UsageError(
            f"run {shown!r} is not a valid name (use letters, digits, '.', '_', '-', "
            "at most 64, starting with a letter or digit)."
        ) from None


@contextlib.contextmanager
def lock(run_dir: Path) -> Iterator[None]:
    """Holds a run directory for this process; the kernel frees it if we are killed.

    Raises:
      CheckpointError: Another process holds it; the message says which.
      StorageError: The directory cannot be made or locked, or is a link.
    """
    disk.check_own(run_dir, folder=True)
    with storage_errors(f"make {run_dir}"):
        disk.make(run_dir)
    # Never unlinked: a waiting process may have it open already.
    with disk.opened(run_dir / ".lock", os.O_RDWR) as file:
        with storage_errors(f"lock {run_dir}"):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise CheckpointError(
                    f"{run_dir} is in use by {_holder(file)}. Stop it or choose "
                    "another run directory."
                ) from None
            owner = {
                "pid": os.getpid(),
                "host": socket.gethostname(),
                "start": time.strftime("%Y-%m-%d %H:%M:%S"),
            }
            os.ftruncate(file, 0)
            os.pwrite(file, json.dumps(owner).encode(), 0)
        yield


def _holder(file: int) -> str:
    """Describes who wrote a lock file, as far as it can be read."""
    try:
        owner = json.loads(os.pread(file, 4096, 0))
        return f"pid {owner['pid']} on host {owner['host']} since {owner['start']}"
    except (ValueError, KeyError, TypeError):
        return "another process"


def probe(run_dir: Path, needed_bytes: int) -> None:
    """Makes a run directory, and writes and reads there before anything is compiled.

    Raises:
      StorageError: It cannot be written, a link leads out of it, or it has less than
        `needed_bytes` free.
    """
    data = os.urandom(4096)
    with storage_errors(f"write in {run_dir}"):
        disk.make(run_dir)
        disk.check_own(run_dir / CHECKPOINTS, folder=True)
        for name in (METRICS, ORPHANS):
            disk.check_own(run_dir / name)
        with disk.draft(run_dir / ".probe") as probe:
            probe.write_bytes(data)
            disk.sync(probe)
            same = probe.read_bytes() == data
    if not same:
        raise StorageError(f"{run_dir} does not read back what is written. Check it.")
    if (free := free_bytes(run_dir)) < needed_bytes:
        raise StorageError(
            f"no space in {run_dir} (a run needs {megabytes(needed_bytes)}, "
            f"{megabytes(free)} free). Free space or choose another run directory."
        )


def write_json(path: Path, data: Any) -> None:
    """Replaces a JSON file at once; a reader sees the old file or the new one."""
    text = json.dumps(plain(data), indent=2, allow_nan=False) + "\n"
    disk.write(path, text.encode())


def read_json(path: Path, limit: int = _MAX_JSON_BYTES) -> Any:
    """Reads a JSON file of a run of at most `limit` bytes.

    Raises:
      CheckpointError: It is missing, too large or not JSON; the message says where.
    """
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist or is not a file. Restore it.")
    try:
        with path.open("rb") as file:
            data = file.read(limit + 1)
        if len(data) > limit:
            raise CheckpointError(
                f"{path} is larger than {megabytes(limit)}. It is not a file of a run."
            )
        text = data.decode("utf-8")
        return json.loads(
            text, parse_constant=_refuse_constant, object_pairs_hook=_object
        )
    except json.JSONDecodeError as error:
        why = f"{error.msg}, line {error.lineno}, column {error.colno}"
    except (UnicodeDecodeError, ValueError, RecursionError, OSError) as error:
        why = str(error)
    raise CheckpointError(f"{path} cannot be read ({why}). Restore or remove it.")


def read_as(path: Path, form: Any, what: str) -> Any:
    """Reads a file of JSON in a form, such as a type of msgspec.

    Raises:
      CheckpointError: as `read_json`.
      UsageError: if it is not in that form, which has `what`.
    """
    try:
        return msgspec.convert(read_json(path), form)
    except msgspec.ValidationError as error:
        raise UsageError(f"{path} has no {what}: {error}") from error


def find_json(path: Path) -> dict[str, Any]:
    """Returns the object in a file, or an empty one if there is none to read."""
    try:
        found = read_json(path, 100 * _MAX_JSON_BYTES)
    except CheckpointError:
        return {}
    return found if isinstance(found, dict) else {}


def below(folder: Path, pattern: str) -> list[str]:
    """Returns the names of the folders in one that have such a name, and a config."""
    return sorted(path.parent.name for path in folder.glob(f"{pattern}/{CONFIG}"))


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    (name, count), *_ = Counter(name for name, _ in pairs).most_common(1) or [("", 1)]
    if count > 1:
        raise ValueError(f"{name!r} is there twice")
    return dict(pairs)


def plain(value: Any) -> Any:
    """Returns JSON values: arrays as lists, NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
