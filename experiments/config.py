"""Every number of the experiments: the flags, their ranges and what each is for.

The fields of a Config are declared by what they do. What decides about the numbers of a
run is `Science`; what does not is in `place`, so that two runs are the same where their
`Run` parts are equal.
"""

import dataclasses
import enum
from typing import Annotated, Any, Literal, get_args

from msgspec import Meta

from jaxpets import EnsembleConfig, FitConfig
from jaxpets.policies import ActorCriticConfig, DistillConfig

from .place import Compute, Origin, Output, Process, Steps
from .storage.rundir import HALF_CHEETAH

Phase = Literal["explore", "zero-shot", "finetune", "distill", "report"]
Preset = Literal["laptop", "paper", "smoke"]
ArmName = Literal[
    "epistemic", "count", "random", "oracle", "one-step", "plan2explore", "info-gain",
    "best", "jensen-renyi", "opax", "ensemble-std", "rnd", "particle-entropy",
    "mixture", "pink-noise",
]  # fmt: skip
# Arms that act without a plan, and what a log calls the planner of each.
UNPLANNED = {"random": "random", "pink-noise": "noise"}
# Arms that one network will do for.
UNDIVIDED = (*UNPLANNED, "count", "oracle", "rnd", "particle-entropy")
EngineName = Literal["mjx", "mujoco"]
_ARMS = get_args(ArmName)
# An arm by its name, or a function of a file of the user's.
Arm = Annotated[
    str,
    Meta(
        pattern=rf"^({'|'.join(_ARMS)}|[^\0-\x1f]+\.py:[A-Za-z_]\w*)\Z",
        description=f"{', '.join(_ARMS)} or FILE.py:NAME",
    ),
]


class Mark(enum.Enum):
    """What else there is to know about a field."""

    EXPLORED = "part of an explored model, so that phase 2 cannot change it"
    COUNTED = "which runs and how many; the report says so beside its tables"
    GOAL = "when a run is complete, which may be said anew"


EXPLORED, COUNTED, GOAL = Mark
Seed = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Trials = Annotated[int, Meta(ge=1, le=100_000)]
TaskTrials = Annotated[int, Meta(ge=1, le=10_000)]


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The ensemble."""

    num_members: Annotated[int, Meta(ge=1, le=100), EXPLORED] = (
        EnsembleConfig.num_members
    )
    """Networks in the ensemble."""
    hidden_size: Annotated[int, Meta(ge=1, le=8192), EXPLORED] = (
        EnsembleConfig.hidden_sizes[0]
    )
    """Width of every hidden layer."""
    num_layers: Annotated[int, Meta(ge=1, le=16), EXPLORED] = len(
        EnsembleConfig.hidden_sizes
    )
    """Hidden layers."""
    activation: Annotated[Literal["swish", "tanh", "relu", "gelu"], EXPLORED] = "swish"
    """Of the hidden layers."""
    state_margin: Annotated[float, Meta(ge=0.0, le=1e6)] | None = (
        EnsembleConfig.state_margin
    )
    """Imagined states may leave the range of the data by this share; None: free."""


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """A fit: `training` and `tuning` come after every trial, `refit` before phase 2."""

    num_epochs: Annotated[int, Meta(ge=0, le=10_000)] = FitConfig.num_epochs
    """Passes over all data; a refit of 0 leaves the model as it explored."""
    batch_size: Annotated[int, Meta(ge=1, le=65_536)] = FitConfig.batch_size
    """Rows per member and gradient step."""
    learning_rate: Annotated[float, Meta(ge=1e-9, le=1.0)] = 1e-3
    """Of Adam."""
    final_rate: Annotated[float, Meta(ge=0.0, le=1.0)] = FitConfig.final_rate
    """Share of the learning rate that is left at the end of a fit."""
    bootstrap: bool = FitConfig.bootstrap
    """Every member sees its own draw of the rows; otherwise all of them."""
    fused: bool = False
    """Train in one kernel, on Hopper GPUs: for one seed or a few, small batches."""


@dataclasses.dataclass(frozen=True)
class PlannerConfig:
    """The search at every step; `planner` explores, `task_planner` performs tasks."""

    optimizer: Literal["cem", "icem", "mppi"] = "cem"
    """How action sequences are searched."""
    horizon: Annotated[int, Meta(ge=1, le=1000)] = 30
    """Steps planned ahead."""
    num_samples: Annotated[int, Meta(ge=2, le=1_000_000)] = 500
    """Candidates per iteration."""
    num_elites: Annotated[int, Meta(ge=2, le=1_000_000)] = 50
    """Best candidates that shape the next iteration."""
    num_iterations: Annotated[int, Meta(ge=1, le=100)] = 5
    """Iterations per step."""
    num_particles: Annotated[int, Meta(ge=1, le=100_000)] = 20
    """Particles per candidate, over all members."""
    means: bool = False
    """Imagine the members' means, not draws; a particle for each is then enough."""
    momentum: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.1
    """Share of the old mean and variance that an iteration keeps."""
    legacy_variance: bool = False
    """cem: leave the variance without momentum, as PETS's code did in 2018."""
    noise_beta: Annotated[float, Meta(ge=0.0, le=10.0)] = 2.0
    """icem: exponent of the coloured noise; 0 is white."""
    temperature: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    """mppi: 0.1 follows the few best candidates, 10 averages over all."""
    precision: Literal["f32", "tf32", "bf16"] = "bf16"
    """Of the matrix products of a plan; on CPUs, of plans with no-fused.
    Training always uses tf32 or better."""
    fused: bool = True
    """Imagine in one kernel, where there can be one: on CPUs with a C++ compiler,
    which takes float32 whatever the precision; with bf16 on GPUs from Ampere on."""


@dataclasses.dataclass(frozen=True)
class ImaginationConfig:
    """An actor and a critic of all tasks, from which the policy of distill begins."""

    num_updates: Annotated[int, Meta(ge=0, le=10_000_000)] = 0
    """Gradient steps, at least; 0: there is no critic."""
    learning_rate: Annotated[float, Meta(ge=1e-9, le=1.0)] = 1e-3
    """Of Adam, at first; it falls to a twentieth."""
    batch_size: Annotated[int, Meta(ge=1, le=65_536)] = ActorCriticConfig.batch_size
    """Imagined rows per gradient step, at least."""
    horizon: Annotated[int, Meta(ge=1, le=1000)] = ActorCriticConfig.horizon
    """Steps that are imagined in a gradient step."""
    discount: Annotated[float, Meta(ge=0.0, le=0.9999)] = 0.99
    """Per step of the environment; a plan that ends with the critic has it too."""
    trace: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.5
    """lambda of the returns that the critic learns."""
    noise: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.5
    """On imagined actions, in half widths of their range."""
    restart: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.02
    """Chance per gradient step that an imagined trial begins anew."""
    target_rate: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.02
    """Share of the critics that their slow copies take over in a gradient step."""
    pessimism: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """1: learn from the lesser of two critics; 0: from their mean."""
    squash: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    """Critics learn logarithms, this much steeper at 0; 0: they learn values."""


@dataclasses.dataclass(frozen=True)
class CriticConfig(ImaginationConfig):
    """zero-shot: an actor and a critic of every task, with which a plan ends."""

    hidden_size: Annotated[int, Meta(ge=1, le=8192)] = ActorCriticConfig.hidden_size
    """Width of the networks' layers."""
    acts: bool = False
    """The actor acts alone: nothing is planned."""


@dataclasses.dataclass(frozen=True)
class DistillingConfig:
    """A policy for all tasks that acts without a plan."""

    num_rounds: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """Times that the planner is asked, the policy learns and acts; 0: as imagined."""
    num_trials: Annotated[int, Meta(ge=1, le=10_000)] = DistillConfig.num_trials
    """Imagined trials side by side in which the planner is asked, at least."""
    horizon: Annotated[int, Meta(ge=1, le=100_000)] = 250
    """Steps that they are imagined for in a round."""
    num_updates: Annotated[int, Meta(ge=1, le=1_000_000)] = 4000
    """Gradient steps in a round."""
    learning_rate: Annotated[float, Meta(ge=1e-9, le=1.0)] = 1e-3
    """Of Adam, at first; it falls to a twentieth."""
    hidden_size: Annotated[int, Meta(ge=1, le=8192)] = DistillConfig.hidden_size
    """Width of the policy's two layers."""
    critic: ImaginationConfig = ImaginationConfig(60_000, batch_size=1024, horizon=10)
    """How it is imagined."""


@dataclasses.dataclass(frozen=True)
class Phased:
    """What is to be done."""

    phase: Phase = "explore"
    """What to do."""


@dataclasses.dataclass(frozen=True)
class Basics:
    """The part of the science that one chooses first."""

    preset: Annotated[Preset, EXPLORED, COUNTED] = "laptop"
    """Numbers to start from: minutes on a laptop, the paper's, or seconds."""
    env: Annotated[str, EXPLORED, COUNTED] = HALF_CHEETAH
    """The robot: a name of `--list envs`, or a file of your own,
    FILE.py with `def robot(backend)` or FILE.py:NAME."""
    arm: Annotated[Arm, EXPLORED, COUNTED] = "epistemic"
    """What exploration seeks:
    epistemic: disagreement of the ensemble (SU-PETS);
    best: the same, in units of the data;
    one-step, plan2explore: disagreement about one step;
    info-gain: the information that a step gives; random, pink-noise: nothing;
    count: rare states; oracle: the first task; mixture: that and disagreement;
    jensen-renyi (MAX), opax, ensemble-std (CEE-US), rnd,
    particle-entropy (APT): what other methods seek;
    FILE.py:NAME: an objective of your own."""
    seeds: Annotated[tuple[Seed, ...], EXPLORED, COUNTED] = (0,)
    """One run each, side by side in one program; 0 to 2**32 - 1."""
    engine: EngineName = "mjx"
    """mjx: physics on the device; mujoco: in C, quicker for hundreds of trials."""
    num_trials: Annotated[Trials, EXPLORED, COUNTED, GOAL] = 60
    """Exploration trials, the random ones included; a run may be given more later."""


@dataclasses.dataclass(frozen=True)
class Exploration(Basics):
    """What phase 1 depends on, and all that follows it."""

    random_trials: Trials = 1
    """Trials with random actions at the start."""
    trial_length: Annotated[Steps, EXPLORED] = 1000
    """Environment steps per exploration trial."""
    num_bits: Annotated[int, Meta(ge=1, le=32), EXPLORED, COUNTED] = 32
    """count: bits of the hash."""
    milestones: Annotated[tuple[Trials, ...], COUNTED] = (10, 20, 26, 40)
    """Trials whose checkpoints are kept for good; otherwise the last two are."""
    model: ModelConfig = ModelConfig()
    training: TrainingConfig = TrainingConfig()
    planner: PlannerConfig = PlannerConfig()


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What phase 2 depends on besides."""

    task_length: Steps = 1000
    """Environment steps per trial of zero-shot and finetune."""
    eval_trials: Annotated[TaskTrials, COUNTED] = 5
    """zero-shot, distill: trials per task and seed; policies learn from them, too."""
    pessimism: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0
    """How many standard deviations between members a task's reward is lowered by."""
    refit: TrainingConfig = TrainingConfig(400, 128, final_rate=0.005)
    task_planner: PlannerConfig = PlannerConfig()
    critic: CriticConfig = CriticConfig()


@dataclasses.dataclass(frozen=True)
class Tuning:
    """What fine-tuning depends on besides."""

    finetune_trials: Annotated[TaskTrials, COUNTED] = 20
    """finetune: trials per task and seed."""
    tuning: TrainingConfig = TrainingConfig(final_rate=0.02)


@dataclasses.dataclass(frozen=True)
class Science(Tuning, Evaluation, Exploration):
    """Everything that decides about numbers."""

    distill: DistillingConfig = DistillingConfig()


@dataclasses.dataclass(frozen=True)
class Variant:
    """Which tasks phase 2 is about, and which variant of it this is."""

    task: str = "all"
    """The tasks to perform, as walk,run; by default all of the robot."""
    tasks: str | None = None
    """FILE.py of your own: `def tasks()` gives rewards, in place of the robot's."""
    policy: str | None = None
    """zero-shot: FILE of distill, or pretrained/best: plans begin with its actions."""
    tag: str | None = None
    """Name of a variant of phase 2, with other numbers and its own folder."""


@dataclasses.dataclass(frozen=True)
class Run(Variant, Science, Phased):
    """What a run is: where these are equal, it is the same one."""


@dataclasses.dataclass(frozen=True)
class Config(Process, Compute, Origin, Output, Run):
    """One command: what a run is, and where and how it is computed."""


def part(config: Any, role: Any) -> Any:
    """Returns the fields of `config` that a dataclass, `role`, has too, as one."""
    return role(**{f.name: getattr(config, f.name) for f in dataclasses.fields(role)})
