"""What planning and compiling cost: operations, hours on a CPU, memory, seconds."""

import itertools
from collections.abc import Sequence

from . import robots
from .config import UNPLANNED, Config, ImaginationConfig, PlannerConfig
from .errors import UsageError

# Floating-point operations that a CPU does in an hour, about 100 GFLOP/s.
_CPU_FLOPS_AN_HOUR = 1e11 * 3600
# Programs, and the seconds that they take to compile on two CPU cores, and on a GPU.
_PROGRAMS = {"plan": ("planner", 30, 10), "fit": ("fit", 10, 8)}
_PHYSICS = ("physics", 10, 10)  # MJX; physics in C takes none


def compiling(program: str) -> str:
    """Returns what is said while a program compiles.

    Args:
      program: plan, fit, or another planner, of which only physics takes long.
    """
    import jax

    name, on_cpu, on_gpu = _PROGRAMS.get(program, _PHYSICS)
    seconds = on_cpu if jax.default_backend() == "cpu" else on_gpu
    return f"compiling the {name}, about {seconds} s, once"


def model_flops(widths: Sequence[int]) -> float:
    """Returns the operations of a particle's step, two per multiply-add.

    Only the network's matrix products are counted.

    Args:
      widths: of the layers, from what the network reads to what it says.
    """
    return 2.0 * sum(a * b for a, b in itertools.pairwise(widths))


def check_cpu(config: Config) -> None:
    """Refuses what would take over an hour on a CPU by mistake.

    Raises:
      UsageError: with the hours that it would take.
    """
    import jax
    import jax.numpy as jnp

    if jax.default_backend() != "cpu" or config.allow_cpu:
        return
    _, search = _search(config)
    rows = search.num_samples * search.num_particles * search.num_iterations
    steps = _planned_steps(config) * len(config.seeds)
    robot = robots.of(config)
    obs_size, action_size = robots.sizes(robot)
    obs = jax.ShapeDtypeStruct((obs_size,), jnp.float32)
    read = jax.eval_shape(robot.space.features, obs).shape[0] + action_size
    hidden = [config.model.hidden_size] * config.model.num_layers
    flops = model_flops([read, *hidden, 2 * obs_size])
    if config.phase == "zero-shot" and config.critic.acts:
        rows = 0
    steps = rows * search.horizon * steps + _critic_steps(config)
    hours = flops * steps / _CPU_FLOPS_AN_HOUR
    if hours > 1:
        raise UsageError(
            f"--phase {config.phase} of --preset {config.preset} would take about "
            f"{hours:.0f} hours on this CPU; use a GPU, smaller numbers or --allow-cpu."
        )


def memory_advice(config: Config) -> str:
    """Returns what is planned at once, and with which flags it would be less."""
    group, search = _search(config)
    seeds, trials = len(config.seeds), _num_tasks(config)
    flags = [f"--{group}.num-samples", f"--{group}.num-particles"]
    learned = ""
    own, _, critics = _imagined(config)
    if critics:
        learned = f"{critics} critics learn at once, and "
        flags = [f"--{own}.batch-size", *flags[: 2 * (not config.critic.acts)]]
    if config.phase == "zero-shot":
        trials *= config.eval_trials
        flags.insert(0, "--eval-trials")
    if config.phase == "distill":
        trials = max(trials * config.eval_trials, config.distill.num_trials)
        flags = ["--eval-trials", "--distill.num-trials", *flags]
    return (
        f"out of memory. {learned}{seeds} seeds x {trials} trials x "
        f"{search.num_samples} samples x {search.num_particles} particles x horizon "
        f"{search.horizon} are planned at once; lower one of "
        f"{', '.join(['--seeds', *flags])}. The last checkpoint is intact."
    )


def _search(config: Config) -> tuple[str, PlannerConfig]:
    """Returns the search of a phase, and what its flags are called."""
    if config.phase == "explore":
        return "planner", config.planner
    return "task-planner", config.task_planner


def _critic_steps(config: Config) -> int:
    """Returns about as many imagined steps as critics cost."""
    _, critic, count = _imagined(config)
    rows = critic.num_updates * critic.batch_size * critic.horizon
    # The networks cost six times a model of the paper's size, as measured on two cores.
    return 7 * rows * count


def _imagined(config: Config) -> tuple[str, ImaginationConfig, int]:
    """Returns what the flags of critics are called, and how many learn at once.

    Of distill one has all tasks.
    """
    group, critic, tasks = "critic", config.critic, _num_tasks(config)
    if config.phase == "distill":
        group, critic, tasks = "distill.critic", config.distill.critic, 1
    learns = critic.num_updates and config.phase in ("zero-shot", "distill")
    return group, critic, len(config.seeds) * tasks if learns else 0


def _num_tasks(config: Config) -> int:
    """Returns how many tasks are planned for at once; exploration is one."""
    if config.phase == "explore":
        return 1
    return len(robots.names(config, robots.of(config)))


def _planned_steps(config: Config) -> int:
    """Returns how many steps of environments a seed plans for in a phase."""
    if config.phase == "explore":
        planned = config.num_trials - config.random_trials
        return planned * config.trial_length if config.arm not in UNPLANNED else 0
    tuned = config.phase == "finetune"
    trials = config.finetune_trials if tuned else config.eval_trials
    planned = _num_tasks(config) * trials * config.task_length
    if config.phase == "distill":  # the planner performs alone and with the policy
        asked = config.distill
        planned = 2 * planned + asked.num_rounds * asked.num_trials * asked.horizon
    return planned
