"""The work that is timed: planning and training on HalfCheetah.

Weights are as initialised and the data are drawn, not simulated: no program here takes
longer or shorter for other values.
"""

import argparse
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from benchmarks import rows
from jaxpets.envs import half_cheetah


@dataclasses.dataclass(frozen=True)
class Size:
    """How much a planner imagines, with which network; the defaults are the paper's."""

    num_samples: int = 500
    num_elites: int = 50
    num_iterations: int = 5
    horizon: int = 30
    num_particles: int = 20
    num_members: int = 5
    hidden_sizes: tuple[int, ...] = (200, 200, 200, 200)


# "sm_90" is the kernel that other GPUs have, on Hopper, which has one of its own.
ENGINES = ("scan", "kernel", "sm_90")
PRECISIONS = tuple(precision.value for precision in jaxpets.Precision)
OPTIMIZERS = ("cem", "icem")
REWARDS = ("epistemic", "task")
_OTHERS = ("num_particles", "num_iterations", "num_elites")


def named_size(name: str) -> Size:
    """Returns `paper`, `laptop` (the preset of the experiments) or `tiny`."""
    if name == "tiny":
        return Size(16, 4, 2, 3, 5, hidden_sizes=(8, 8, 8, 8))
    if name == "paper":
        return Size()
    from experiments.presets import PRESETS  # needs the extra `experiments`

    numbers = PRESETS["laptop"]
    planner = numbers.planner
    search = Size(
        num_samples=planner.num_samples,
        num_elites=planner.num_elites,
        num_iterations=planner.num_iterations,
        horizon=planner.horizon,
        num_particles=planner.num_particles,
    )
    return with_network(search, numbers.model)


def with_network(size: Size, network: Any) -> Size:
    """Returns the size with the network of an experiment, its `ModelConfig`."""
    return dataclasses.replace(
        size,
        num_members=network.num_members,
        hidden_sizes=(network.hidden_size,) * network.num_layers,
    )


def add_size_flag(parser: argparse.ArgumentParser, *more: str) -> None:
    """Adds `--size`, and what may differ from it; `more` names others of its fields."""
    parser.add_argument(
        "--size", choices=("paper", "laptop"), default="paper", help="of the planner"
    )
    for name in (*_OTHERS, *more):
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=rows.positive, help="in place of the size's")


def chosen_size(args: argparse.Namespace, *more: str) -> Size:
    """Returns the size that the flags ask for, with `more` as `add_size_flag` had."""
    size = named_size(args.size)
    others = {name: getattr(args, name, None) for name in (*_OTHERS, *more)}
    return dataclasses.replace(size, **{x: n for x, n in others.items() if n})


def ensemble_config(size: Size, precision: str) -> jaxpets.EnsembleConfig:
    """Returns the configuration of the ensemble of PETS."""
    return jaxpets.EnsembleConfig(
        num_members=size.num_members,
        hidden_sizes=size.hidden_sizes,
        weight_decays=1e-4,  # as good as any for time
        precision=jaxpets.Precision(precision),
    )


def model(size: Size, precision: str) -> jaxpets.Ensemble:
    """Returns the ensemble of PETS on HalfCheetah."""
    return jaxpets.ensemble(
        ensemble_config(size, precision),
        half_cheetah.model_space(),
        obs_size=half_cheetah.OBS_SIZE,
        action_size=half_cheetah.ACTION_SIZE,
    )


@rows.refused(ValueError)
def rollout_fn(
    size: Size, precision: str, engine: str = "scan"
) -> jaxpets.typing.RolloutFn:
    """Returns the particle rollout of the ensemble; raises what `kernel_of` does."""
    if engine == "scan":
        return jaxpets.particle_rollout(
            model(size, precision).sample,
            num_members=size.num_members,
            num_particles=size.num_particles,
        )
    arch = "sm_90" if engine == "sm_90" else None
    return kernel_of(model(size, precision), precision, size.num_particles, arch)


@rows.refused(ValueError)
def kernel_of(
    model: jaxpets.Ensemble, precision: str, num_particles: int, arch: str | None
) -> jaxpets.typing.FusedRollout:
    """Returns the particle rollout of an ensemble as a kernel.

    Raises:
      SystemExit: if there can be none: a scan must not be timed in its name, nor
        float32 in the name of another precision.
    """
    if jax.default_backend() == "cpu" and precision != "f32":
        raise SystemExit("no kernel to time: that of a CPU is --precision f32 only")
    fused = jaxpets.fused_rollout(model, num_particles=num_particles, arch=arch)
    if not fused.uses_kernel:
        raise SystemExit(f"no kernel to time: {fused.reason}")
    return fused


def arch(size: Size, precision: str, engine: str) -> str:
    """Returns for which GPU the kernel was built, as nvcc calls it, or nothing."""
    rollout = rollout_fn(size, precision, engine)
    return rollout.arch if isinstance(rollout, jaxpets.typing.FusedRollout) else ""


def rollout_work(
    size: Size, precision: str, engine: str = "scan"
) -> tuple[jaxpets.typing.RolloutFn, tuple]:
    """Returns the rollout of one iteration of planning, and what it is called with."""
    params_key, action_key, key = jax.random.split(jax.random.key(0), 3)
    start = jax.jit(lambda key: params(size, key))(params_key)
    shape = (size.num_samples, size.horizon, half_cheetah.ACTION_SIZE)
    actions = jax.random.uniform(action_key, shape, jnp.float32, -1.0, 1.0)
    obs = jnp.zeros((half_cheetah.OBS_SIZE,), jnp.float32)
    return rollout_fn(size, precision, engine), (start, key, obs, actions)


@rows.refused(ValueError)
def optimizer(
    size: Size, name: str, engine: str = "scan"
) -> jaxpets.optimizers.TrajectoryOptimizer:
    """Returns `cem` or `icem` at this size, as the experiment has it for the engine."""
    one = jnp.ones((half_cheetah.ACTION_SIZE,), jnp.float32)
    unroll = engine != "scan" and jax.default_backend() == "gpu"
    cem = functools.partial(jaxpets.optimizers.cem, unroll=unroll)
    build = {"cem": cem, "icem": jaxpets.optimizers.icem}[name]
    return build(
        horizon=size.horizon,
        action_low=-one,
        action_high=one,
        num_samples=size.num_samples,
        num_elites=size.num_elites,
        num_iterations=size.num_iterations,
    )


def planner(
    size: Size,
    precision: str,
    search: str = "cem",
    reward: str = "epistemic",
    chunk_size: int | None = None,
    engine: str = "scan",
) -> jaxpets.Planner:
    """Returns the model-predictive controller of PETS."""
    rewards = {
        "epistemic": jaxpets.rewards.epistemic,
        "task": half_cheetah.task_reward,
    }
    return jaxpets.plan(
        rollout_fn(size, precision, engine),
        rewards[reward],
        optimizer(size, search, engine),
        chunk_size=chunk_size,
    )


def fitter(
    size: Size, num_epochs: int = 5, batch_size: int = 32, engine: str = "scan"
) -> jaxpets.typing.Fitter:
    """Returns the trainer of PETS, in TF32 where the hardware has it.

    Raises:
      SystemExit: if there can be no kernel: the scan must not be timed in its name.
    """
    config = jaxpets.FitConfig(num_epochs=num_epochs, batch_size=batch_size)
    build = {"scan": jaxpets.fitter, "kernel": jaxpets.fused_fitter}[engine]
    built = build(model(size, "tf32"), optax.adam(1e-3), config)
    if built.reason:
        raise SystemExit(f"no kernel to time: {built.reason}")
    return built


def transitions(key: Array, num_rows: int) -> jaxpets.Transition:
    """Draws transitions with about the spread of HalfCheetah's, `[num_rows, ...]`."""
    obs_key, action_key, change_key = jax.random.split(key, 3)
    std = jnp.array([0.6, 0.05, 0.5, *[0.3] * 6, 0.8, 0.8, 1.8, *[9.0] * 6])
    shape = (num_rows, half_cheetah.OBS_SIZE)
    obs = std * jax.random.normal(obs_key, shape, jnp.float32)
    change = 0.3 * std * jax.random.normal(change_key, shape, jnp.float32)
    action_shape = (num_rows, half_cheetah.ACTION_SIZE)
    action = jax.random.uniform(action_key, action_shape, jnp.float32, -1.0, 1.0)
    return jaxpets.Transition(obs, action, obs + change)


def dataset(key: Array, num_rows: int, capacity: int) -> jaxpets.datasets.Dataset:
    """Returns a dataset with `num_rows` drawn transitions."""
    empty = jaxpets.datasets.init(
        capacity, half_cheetah.OBS_SIZE, half_cheetah.ACTION_SIZE
    )
    return jaxpets.datasets.append(empty, transitions(key, num_rows))


def params(size: Size, key: Array) -> jaxpets.EnsembleParams:
    """Returns an ensemble as initialised, with a scaler fitted to drawn data."""
    init_key, data_key = jax.random.split(key)
    ensemble = model(size, "tf32")
    data = transitions(data_key, 1000)
    scaler = ensemble.fit_scaler(data, jnp.asarray(1000, jnp.int32))
    return ensemble.init(init_key)._replace(scaler=scaler)


def prepare_fit(
    size: Size, fitter: jaxpets.typing.Fitter, keys: Array, num_rows: int, capacity: int
) -> tuple[jaxpets.EnsembleParams, jaxpets.typing.FitState, jaxpets.datasets.Dataset]:
    """Returns what a fitter reads, one of each per key."""

    def prepare(key: Array) -> tuple:
        model_key, data_key = jax.random.split(key)
        start = params(size, model_key)
        return start, fitter.init(start), dataset(data_key, num_rows, capacity)

    axes = (0, 0, jaxpets.datasets.AXES)
    return jax.jit(jax.vmap(prepare, out_axes=axes))(keys)


def fit_seeds(fitter: jaxpets.typing.Fitter) -> Callable[..., Any]:
    """Returns `fitter.step` mapped over seeds with equally many rows."""
    many = jax.vmap(fitter.step, (0, 0, 0, jaxpets.datasets.AXES))

    def step(
        params: Any, keys: Array, state: Any, data: jaxpets.datasets.Dataset
    ) -> Any:
        if len(keys) > 1:
            return many(params, keys, state, data)
        # An axis of one would cost a third more, and nobody trains one seed so.
        first = jax.tree.map(lambda x: x[0] if x.ndim else x, (params, state, data))
        return fitter.step(first[0], keys[0], *first[1:])

    return step


def plan_params(size: Size, key: Array, reward: str) -> jaxpets.PlanParams:
    """Returns what a planner of one seed reads."""
    dynamics = params(size, key)
    if reward == "task":
        return jaxpets.PlanParams(dynamics, half_cheetah.task("forward"))
    return jaxpets.PlanParams(dynamics, jaxpets.rewards.max_variance(dynamics))


def plan_inputs(
    size: Size, planner: jaxpets.Planner, reward: str = "epistemic"
) -> Callable[[Array], tuple[jaxpets.PlanParams, Array, Any, Array]]:
    """Returns a function from a key to what `planner.step` is called with."""

    def prepare(key: Array) -> tuple[jaxpets.PlanParams, Array, Any, Array]:
        model_key, obs_key, key = jax.random.split(key, 3)
        obs = 0.1 * jax.random.normal(obs_key, (half_cheetah.OBS_SIZE,), jnp.float32)
        return plan_params(size, model_key, reward), key, planner.init(), obs

    return prepare
