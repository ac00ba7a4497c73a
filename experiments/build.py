"""From a config to the parts of the library: environment, model, planners, learner."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from experiments.arms import make_arm
from experiments.config import (
    Config,
    ModelConfig,
    PlannerConfig,
    TrainingConfig,
    part,
)
from jaxpets.envs import half_cheetah

State = jaxpets.typing.LearnerState
KERNEL, SCAN = "kernel", "scan"
Learn = Callable[[Array, State, Any], tuple[State, Any]]

# Every phase draws from its own stream of keys.
EXPLORE, ZERO_SHOT, FINETUNE, REFIT = 0, 1, 2, 3

ENGINES = {
    "mjx": half_cheetah.half_cheetah,
    "mujoco": half_cheetah.half_cheetah_native,
}


class Parts(NamedTuple):
    """What the phases are made of. Nothing here is jitted."""

    env: jaxpets.Env
    model: jaxpets.Ensemble  # in the precision that trains
    random: jaxpets.Planner
    explorer: jaxpets.Planner  # phase 1
    actor: jaxpets.Planner  # phase 2; reward data are the weights of a task
    learner: jaxpets.Learner  # phase 1
    reward_data: jaxpets.RewardData  # of its reward
    explored_by: str  # what imagines in phase 1, as env.json has it
    performed_by: str  # and in phase 2
    refitter: jaxpets.typing.Fitter | None  # between the phases
    finetuner: jaxpets.Learner  # phase 2


def build(config: Config) -> Parts:
    """Returns the parts for a validated config."""
    env = ENGINES[config.engine]()
    size = ensemble_config(config.model)
    trained = _ensemble(size, jaxpets.Precision.TF32)
    planned = _ensemble(size, jaxpets.Precision(config.planner.precision))
    arm = make_arm(config, planned, env)
    explored = config.num_trials * config.trial_length
    finetuned = config.finetune_trials * config.task_length

    def planner(
        reward_fn: jaxpets.typing.RewardFn, search: PlannerConfig
    ) -> tuple[jaxpets.Planner, str]:
        rollout, kind = _rollout(size, search)
        unroll = kind.startswith(KERNEL) and jax.default_backend() == "gpu"
        search_fn = optimizer(search, env, unroll)
        return jaxpets.plan(rollout, reward_fn, search_fn), kind

    reward = half_cheetah.task_reward
    if config.pessimism:
        reward = jaxpets.rewards.pessimistic(reward, config.pessimism)
    random = jaxpets.random_planner(env.action_low, env.action_high)

    def learner(
        fit: TrainingConfig, data: jaxpets.RewardData, length: int, capacity: int
    ) -> jaxpets.Learner:
        fitter = _fitter(trained, fit)
        return jaxpets.learner(
            env, trained, fitter, data, trial_length=length, capacity=capacity
        )

    explorer, explored_by = arm.planner or random, "none"
    if arm.reward_fn is not None:
        explorer, explored_by = planner(arm.reward_fn, config.planner)
    actor, performed_by = planner(reward, config.task_planner)
    return Parts(
        env=env,
        model=trained,
        random=random,
        explorer=explorer,
        actor=actor,
        learner=learner(
            config.training, arm.reward_data, config.trial_length, explored
        ),
        reward_data=arm.reward_data,
        explored_by=explored_by,
        performed_by=performed_by,
        refitter=_fitter(trained, config.refit) if config.refit.num_epochs else None,
        finetuner=learner(
            config.tuning,
            jaxpets.RewardData(),
            config.task_length,
            explored + finetuned,
        ),
    )


def trial_keys(config: Config, phase: int, trial: int) -> Array:
    """Returns one key per seed `[S]` for one trial of one phase."""

    def one(seed: Array) -> Array:
        return jax.random.fold_in(jax.random.fold_in(seed, phase), trial)

    return jax.vmap(one)(jnp.stack([jax.random.key(s) for s in config.seeds]))


def ensemble_config(model: ModelConfig) -> jaxpets.EnsembleConfig:
    """Returns the library's config of an ensemble whose hidden layers are equal."""
    return jaxpets.EnsembleConfig(
        num_members=model.num_members,
        hidden_sizes=(model.hidden_size,) * model.num_layers,
        state_margin=model.state_margin,
    )


def _fitter(
    ensemble: jaxpets.Ensemble, training: TrainingConfig
) -> jaxpets.typing.Fitter:
    adam = optax.adam(training.learning_rate)
    return jaxpets.fitter(ensemble, adam, part(training, jaxpets.FitConfig))


def _ensemble(
    size: jaxpets.EnsembleConfig, precision: jaxpets.Precision
) -> jaxpets.Ensemble:
    return jaxpets.ensemble(
        dataclasses.replace(size, precision=precision),
        half_cheetah.model_space(),
        obs_size=half_cheetah.OBS_SIZE,
        action_size=half_cheetah.ACTION_SIZE,
    )


def _rollout(
    size: jaxpets.EnsembleConfig, search: PlannerConfig
) -> tuple[jaxpets.typing.RolloutFn, str]:
    """Returns the rollout of a search, and what decides about its last bits.

    That is the compiler of a kernel, or the scan, with a reason if it was not wanted.
    """
    precision = jaxpets.Precision(search.precision)
    model = _ensemble(size, precision)
    may_have_kernel = {"cpu": True, "gpu": precision is jaxpets.Precision.BF16}
    if search.fused and may_have_kernel.get(jax.default_backend(), False):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* runs as a scan")  # the phases say it
            rollout = jaxpets.fused_rollout(model, num_particles=search.num_particles)
        kernel = f"{KERNEL} of {rollout.compiler}"
        return rollout, kernel if rollout.uses_kernel else f"{SCAN} ({rollout.reason})"
    rollout = jaxpets.particle_rollout(
        model.sample, num_members=size.num_members, num_particles=search.num_particles
    )
    return rollout, SCAN


def optimizer(
    search: PlannerConfig, env: jaxpets.Env, unroll: bool = False
) -> jaxpets.optimizers.TrajectoryOptimizer:
    """Returns the search that a config describes; unroll is that of `cem`."""
    size = {
        "horizon": search.horizon,
        "action_low": env.action_low,
        "action_high": env.action_high,
        "num_samples": search.num_samples,
        "num_iterations": search.num_iterations,
    }
    if search.optimizer == "mppi":
        return jaxpets.optimizers.mppi(**size, temperature=search.temperature)
    size |= {"num_elites": search.num_elites, "momentum": search.momentum}
    if search.optimizer == "icem":
        return jaxpets.optimizers.icem(**size, noise_beta=search.noise_beta)
    return jaxpets.optimizers.cem(
        **size, legacy_variance=search.legacy_variance, unroll=unroll
    )
