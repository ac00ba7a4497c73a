"""From a config to the parts of the library: environment, model, planners, learner."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from experiments.arms import NO_DATA, make_arm
from experiments.config import Config
from jaxpets.envs import half_cheetah

# Every phase draws from its own stream of keys.
EXPLORE, ZERO_SHOT, FINETUNE = 0, 1, 2


# A learner over seeds: everything has the axis but the size of the dataset, which is
# the same for all. Shared, it is the trip count of one plain loop over batches.
LEARNER_AXES = jaxpets.LearnerState(
    params=0, fit=0, dataset=jaxpets.Dataset(data=0, size=None, cursor=None), reward=0
)  # type: ignore[arg-type]


class Parts(NamedTuple):
    """What the phases are made of. Nothing here is jitted."""

    env: jaxpets.Env
    random: jaxpets.Planner
    explorer: jaxpets.Planner  # phase 1
    actor: jaxpets.Planner  # phase 2; reward data are the weights of a task
    learner: jaxpets.Learner  # phase 1
    finetuner: jaxpets.Learner  # phase 2


def build(config: Config) -> Parts:
    """Returns the parts for a validated config."""
    env = half_cheetah.half_cheetah()
    numbers = config.model
    size = jaxpets.EnsembleConfig(
        num_members=numbers.num_members,
        hidden_sizes=(numbers.hidden_size,) * numbers.num_layers,
        weight_decays=_weight_decays(numbers.num_layers),
        state_margin=numbers.state_margin,
    )
    trained = _ensemble(size)
    precision = jaxpets.Precision(config.planner.precision)
    planned = _ensemble(dataclasses.replace(size, precision=precision))
    fitter = jaxpets.fit(
        trained,
        optax.adam(config.training.learning_rate),
        jaxpets.FitConfig(config.training.num_epochs, config.training.batch_size),
    )
    rollout = jaxpets.particle_rollout(
        planned.sample,
        num_members=numbers.num_members,
        num_particles=config.planner.num_particles,
    )
    search = _optimizer(config, env)
    arm = make_arm(config, planned)
    random = jaxpets.random_planner(env.action_low, env.action_high)
    explored = config.num_trials * config.trial_length

    def learner(data: jaxpets.RewardData, capacity: int) -> jaxpets.Learner:
        return jaxpets.learner(
            env,
            trained,
            fitter,
            data,
            trial_length=config.trial_length,
            capacity=capacity,
        )

    return Parts(
        env=env,
        random=random,
        explorer=random
        if arm.reward_fn is None
        else jaxpets.plan(rollout, arm.reward_fn, search),
        actor=jaxpets.plan(rollout, half_cheetah.task_reward, search),
        learner=learner(arm.reward_data, explored),
        finetuner=learner(
            NO_DATA, explored + config.finetune_trials * config.trial_length
        ),
    )


def over_seeds(learn: Callable[..., Any]) -> Callable[..., Any]:
    """Maps `Learner.learn` over one more leading axis of everything."""
    return jax.vmap(learn, (0, LEARNER_AXES, 0), (LEARNER_AXES, 0))


def trial_keys(config: Config, phase: int, trial: int) -> Array:
    """Returns one key per seed `[S]` for one trial of one phase."""

    def one(seed: Array) -> Array:
        return jax.random.fold_in(jax.random.fold_in(seed, phase), trial)

    return jax.vmap(one)(jnp.stack([jax.random.key(s) for s in config.seeds]))


def _ensemble(size: jaxpets.EnsembleConfig) -> jaxpets.Ensemble:
    return jaxpets.ensemble(
        size,
        half_cheetah.model_space(),
        obs_size=half_cheetah.OBS_SIZE,
        action_size=half_cheetah.ACTION_SIZE,
    )


def _weight_decays(num_layers: int) -> tuple[float, ...]:
    """Spreads the decays of PETS, given for four hidden layers, over any number."""
    first, second, *middle, last = jaxpets.EnsembleConfig().weight_decays
    inner = (second, *(middle[0],) * num_layers)[: num_layers - 1]
    return (first, *inner, last)


def _optimizer(config: Config, env: jaxpets.Env) -> jaxpets.TrajectoryOptimizer:
    numbers = config.planner
    shared = {
        "horizon": numbers.horizon,
        "action_low": env.action_low,
        "action_high": env.action_high,
        "num_samples": numbers.num_samples,
        "num_iterations": numbers.num_iterations,
    }
    if numbers.optimizer == "mppi":
        return jaxpets.mppi(**shared, temperature=numbers.temperature)
    shared |= {"num_elites": numbers.num_elites, "momentum": numbers.momentum}
    if numbers.optimizer == "icem":
        return jaxpets.icem(**shared, noise_beta=numbers.noise_beta)
    return jaxpets.cem(**shared, legacy_variance=numbers.legacy_variance)
