"""Every number of the experiments: the flags, their ranges and the presets."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from experiments.errors import UsageError

Phase = Literal["explore", "zero-shot", "finetune", "report"]
Preset = Literal["laptop", "paper", "smoke"]
ArmName = Literal[
    "epistemic", "count", "random", "oracle", "one-step", "info-gain", "best"
]
EngineName = Literal["mjx", "mujoco"]
TaskName = Literal["all", "forward", "backward", "front-flip", "back-flip"]
NUM_TASKS = len(get_args(TaskName)) - 1  # of "all"


def number(default: Any, low: float, high: float) -> Any:
    """Returns a dataclass field with a default and the range of valid values."""
    return dataclasses.field(default=default, metadata={"range": (low, high)})


@dataclasses.dataclass(frozen=True)
class ModelNumbers:
    """The ensemble."""

    num_members: int = number(5, 1, 100)
    """Networks in the ensemble."""
    hidden_size: int = number(200, 1, 8192)
    """Width of every hidden layer."""
    num_layers: int = number(4, 1, 16)
    """Hidden layers."""
    state_margin: float | None = number(0.5, 0.0, 1e6)
    """Imagined states may leave the range of the data by this share; None: free."""


@dataclasses.dataclass(frozen=True)
class TrainingNumbers:
    """A fit: `training` and `tuning` after every trial, `refit` before phase 2."""

    num_epochs: int = number(5, 0, 10_000)
    """Passes over all data; refit: 0 goes on with the model as it was explored."""
    batch_size: int = number(32, 1, 65_536)
    """Rows per member and gradient step."""
    learning_rate: float = number(1e-3, 1e-9, 1.0)
    """Of Adam."""
    final_rate: float = number(1.0, 0.0, 1.0)
    """Share of the learning rate that is left at the end of a fit."""
    bootstrap: bool = True
    """Every member sees its own draw of the rows; otherwise all of them."""


@dataclasses.dataclass(frozen=True)
class PlannerNumbers:
    """The search at every step; `planner` explores, `task_planner` performs tasks."""

    optimizer: Literal["cem", "icem", "mppi"] = "cem"
    """How action sequences are searched."""
    horizon: int = number(30, 1, 1000)
    """Steps planned ahead."""
    num_samples: int = number(500, 2, 1_000_000)
    """Candidates per iteration."""
    num_elites: int = number(50, 2, 1_000_000)
    """Best candidates that shape the next iteration."""
    num_iterations: int = number(5, 1, 100)
    """Iterations per step."""
    num_particles: int = number(20, 1, 100_000)
    """Particles per candidate, over all members."""
    momentum: float = number(0.1, 0.0, 1.0)
    """Share of the old mean and variance that an iteration keeps."""
    legacy_variance: bool = False
    """cem: leave the variance without momentum, as PETS's code did in 2018."""
    noise_beta: float = number(2.0, 0.0, 10.0)
    """icem: exponent of the coloured noise; 0 is white."""
    temperature: float = number(1.0, 1e-6, 1e6)
    """mppi: 0.1 follows the few best candidates, 10 averages over all."""
    precision: Literal["f32", "tf32", "bf16"] = "bf16"
    """Of the matrix products while planning, on CPUs with --planner.no-fused only;
    training always uses tf32 or better."""
    fused: bool = True
    """Imagine in one kernel: on CPUs that have a C++ compiler, in float32 whatever the
    precision, and with bf16 on GPUs that can (H100, H200)."""


@dataclasses.dataclass(frozen=True)
class Config:
    """Unsupervised exploration with deep model-based RL on HalfCheetah.

    Phase explore learns a model without a reward, zero-shot uses it for four tasks,
    finetune goes on learning with their rewards, report makes tables and figures. The
    same command continues a run that was stopped.
    """

    phase: Phase
    """What to do."""
    preset: Preset = "laptop"
    """Numbers to start from: minutes on a laptop, the paper's, or seconds."""
    arm: ArmName = "epistemic"
    """What exploration seeks: disagreement of the ensemble (SU-PETS), rare states
    (count), nothing (random), the forward task (oracle), one-step disagreement,
    information gain, or disagreement in units of the data (best)."""
    task: TaskName = "all"
    """For zero-shot and finetune."""
    seeds: tuple[int, ...] = (0,)
    """One run each, side by side in one program; 0 to 2**32 - 1."""
    out: Path = Path("runs")
    """Folder of all runs."""
    name: str | None = None
    """Name of the exploration run; by default PRESET-ARM."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Exploration run for zero-shot and finetune; by default OUT/NAME."""
    at_trial: int | None = None
    """Use the explored model as it was after this trial; by default the last."""
    tag: str | None = None
    """Name of another attempt at phase 2, with other numbers: it has a folder of its
    own in the run, and, if it is a zero-shot, a row of its own in the report."""
    video: Path | None = None
    """Render a trial of each task to this mp4 (zero-shot and finetune)."""
    num_trials: int = number(60, 1, 100_000)
    """Exploration trials, the random ones included."""
    random_trials: int = number(1, 1, 100_000)
    """Trials with random actions at the start."""
    trial_length: int = number(1000, 1, 1_000_000)
    """Environment steps per exploration trial."""
    task_length: int = number(1000, 1, 1_000_000)
    """Environment steps per trial of zero-shot and finetune."""
    eval_trials: int = number(5, 1, 10_000)
    """zero-shot: trials per task and seed."""
    finetune_trials: int = number(20, 1, 10_000)
    """finetune: trials per task and seed."""
    chunk_length: int = number(50, 1, 1_000_000)
    """Environment steps per call of the compiled program."""
    milestones: tuple[int, ...] = (10, 20, 26, 40)
    """Trials whose checkpoints are kept for good; otherwise the last two are."""
    engine: EngineName = "mjx"
    """What steps the physics: mjx on the device of the program, or mujoco, which is C
    on the cores of the host."""
    pessimism: float = number(0.0, 0.0, 100.0)
    """Performing: standard deviations between members taken off a task's reward."""
    num_bits: int = number(32, 1, 32)
    """count: bits of the hash."""
    coordinator_address: str | None = None
    """HOST:PORT of process 0, where several processes share the seeds; the same command
    on each. auto: as SLURM, Open MPI or Kubernetes say, a process per GPU."""
    num_processes: int | None = number(None, 1, 100_000)
    """How many processes share the seeds."""
    process_id: int | None = number(None, 0, 99_999)
    """Which of them this is; only the folder of process 0 is used."""
    allow_cpu: bool = False
    """Start on a CPU although planning would take over an hour."""
    debug: bool = False
    """Show tracebacks."""
    model: ModelNumbers = ModelNumbers()
    training: TrainingNumbers = TrainingNumbers()
    refit: TrainingNumbers = TrainingNumbers(400, 128, final_rate=0.005)
    tuning: TrainingNumbers = TrainingNumbers(final_rate=0.02)
    planner: PlannerNumbers = PlannerNumbers()
    task_planner: PlannerNumbers = PlannerNumbers()


def validate(config: Config) -> None:
    """Checks all numbers and combinations.

    Raises:
      UsageError: naming the flag, the value and what would be valid.
    """
    _check_ranges(config, "--")
    for seed in config.seeds:
        _require(0 <= seed < 2**32, "--seeds", seed, "0 to 4294967295")
    unique = 0 < len(config.seeds) == len(set(config.seeds))
    _require(unique, "--seeds", config.seeds, "one or more different seeds")
    _check_planner("--planner", config.planner, config.model)
    _check_planner("--task-planner", config.task_planner, config.model)
    for name in ("training", "tuning"):
        epochs = getattr(config, name).num_epochs
        _require(epochs > 0, f"--{name}.num-epochs", epochs, "1 to 10,000")
    members = config.model.num_members
    _require(
        members >= 2 or config.arm in ("count", "random", "oracle"),
        "--model.num-members",
        members,
        f"2 or more for --arm {config.arm}; one member never disagrees",
    )
    _require(
        members >= 2 or not config.pessimism,
        "--pessimism",
        config.pessimism,
        "0 with one member; it never disagrees",
    )
    random, trials = config.random_trials, config.num_trials
    valid = f"1 to --num-trials ({trials})"
    _require(random <= trials, "--random-trials", random, valid)
    for length in (config.trial_length, config.task_length):
        divides = length % config.chunk_length == 0
        valid = f"a divisor of the length of a trial ({length})"
        _require(divides, "--chunk-length", config.chunk_length, valid)
    if config.phase == "explore":
        later = "left out in explore; it is for zero-shot and finetune"
        _require(config.source is None, "--from", config.source, later)
        _require(config.at_trial is None, "--at-trial", config.at_trial, later)
        _require(config.tag is None, "--tag", config.tag, later)
        _require(config.task == "all", "--task", config.task, later)
    if config.video is not None:
        good = config.video.suffix == ".mp4" and config.phase in (
            "zero-shot",
            "finetune",
        )
        _require(good, "--video", config.video, "a .mp4 file, in zero-shot or finetune")


def _check_planner(flag: str, planner: PlannerNumbers, model: ModelNumbers) -> None:
    _require(
        planner.num_elites <= planner.num_samples or planner.optimizer == "mppi",
        f"{flag}.num-elites",
        planner.num_elites,
        f"2 to {flag}.num-samples ({planner.num_samples})",
    )
    _require(
        planner.num_particles % model.num_members == 0,
        f"{flag}.num-particles",
        planner.num_particles,
        f"a multiple of --model.num-members ({model.num_members})",
    )


def ranges(config: Any, prefix: str = "--") -> dict[str, str]:
    """Returns, per flag of a number, what is valid in words."""
    found = {}
    for field in dataclasses.fields(config):
        flag = prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value := getattr(config, field.name)):
            found |= ranges(value, f"{flag}.")
        elif "range" in field.metadata:
            low, high = field.metadata["range"]
            found[flag] = f"{low:,} to {high:,}"
    return found


def _check_ranges(config: Any, prefix: str) -> None:
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        flag = prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            _check_ranges(value, f"{flag}.")
        elif "range" in field.metadata and value is not None:
            low, high = field.metadata["range"]
            _require(low <= value <= high, flag, value, f"{low:,} to {high:,}")


def _require(holds: bool, flag: str, value: Any, valid: str) -> None:
    if not holds:
        raise UsageError(f"{flag} {value} is not valid; it must be {valid}.")
