"""Where a command reads and writes, and what it runs on: no number depends on it."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

Steps = Annotated[int, Meta(ge=1, le=1_000_000)]


@dataclasses.dataclass(frozen=True)
class Output:
    """Where runs are."""

    out: Path = Path("runs")
    """Folder of all runs."""
    name: str | None = None
    """Name of the exploration run; by default PRESET-ARM, or PRESET-ROBOT-ARM."""
    track: Literal["tensorboard", "wandb", "trackio"] | None = None
    """Show the run in a tracker, too."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """What phase 2 starts from, and its video."""

    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """The exploration run to start from; by default OUT/NAME."""
    at_trial: int | None = None
    """Use the explored model as it was after this trial; by default the last."""
    video: Path | None = None
    """Render a trial of each task to this mp4."""


@dataclasses.dataclass(frozen=True)
class Compute:
    """How much is computed at a time; no number depends on it."""

    chunk_length: Steps = 50
    """Environment steps per call of the compiled program."""
    allow_cpu: bool = False
    """Start on a CPU although planning would take over an hour."""


@dataclasses.dataclass(frozen=True)
class Process:
    """Which process of how many this is."""

    coordinator_address: str | None = None
    """HOST:PORT of process 0, where several processes share the seeds; the same command
    on each. auto: as SLURM, Open MPI or Kubernetes say, a process per GPU."""
    num_processes: Annotated[int, Meta(ge=1, le=100_000)] | None = None
    """How many processes share the seeds."""
    process_id: Annotated[int, Meta(ge=0, le=99_999)] | None = None
    """Which of them this is; only the folder of process 0 is used."""
    debug: bool = False
    """Show tracebacks."""
