"""From a config to the parts of the library: environment, model, planners, learner."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from jaxpets.envs import Robot
from jaxpets.models import by_means
from jaxpets.policies import ActorCritic, prior

from . import robots
from .acting import Bind
from .arms import Arm, make_arm
from .config import (
    Config,
    ModelConfig,
    PlannerConfig,
    TrainingConfig,
    part,
)
from .critic import TerminalFn, make_critic

State = jaxpets.typing.LearnerState
KERNEL, SCAN, NOTHING = "kernel", "scan", "none"
Learn = Callable[[Array, State, Any], tuple[State, Any]]

# Every phase draws from its own stream of keys.
EXPLORE, ZERO_SHOT, FINETUNE, REFIT, CRITIC, DISTILL = range(6)


class Parts(NamedTuple):
    """What the phases are made of. Nothing here is jitted."""

    robot: Robot
    model: jaxpets.Ensemble  # in the precision that trains
    random: jaxpets.Planner
    explorer: jaxpets.Planner  # phase 1
    actor: jaxpets.Planner  # phase 2; reward data are a task's params, or Guided
    # The same with a policy, whose actions a search begins with; data are Guided.
    with_policy: Callable[[jaxpets.Planner, jaxpets.typing.RewardFn], jaxpets.Planner]
    critic: ActorCritic | None  # what guides zero-shot
    learner: jaxpets.typing.Learner  # phase 1
    reward_data: jaxpets.RewardData  # of its reward
    bind: Bind  # what gives them the constants of a trial
    explored_by: str  # what imagines in phase 1, as env.json has it
    performed_by: str  # and in phase 2
    fitter: jaxpets.typing.Fitter  # phase 1
    refitter: jaxpets.typing.Fitter | None  # between the phases
    tuner: jaxpets.typing.Fitter  # phase 2
    finetuner: jaxpets.typing.Learner  # phase 2


def build(config: Config) -> Parts:
    """Returns the parts for a validated config."""
    robot = robots.of(config)
    env = robot.env
    size = ensemble_config(config.model)
    trained = _ensemble(robot, size, jaxpets.Precision.TF32)
    arm = make_arm(config, _planned(config, robot), robot)
    terminal_fn = imagined_end(env)
    explored = config.num_trials * config.trial_length
    finetuned = config.finetune_trials * config.task_length

    def planner(
        reward_fn: jaxpets.typing.RewardFn, search: PlannerConfig, **behind: Any
    ) -> tuple[jaxpets.Planner, str]:
        rollout, kind = rollout_of(robot, size, search)
        unroll = kind.startswith(KERNEL) and jax.default_backend() == "gpu"
        search_fn = optimizer(search, env, unroll)
        planner = jaxpets.plan(
            rollout, reward_fn, search_fn, terminal_fn=terminal_fn, **behind
        )
        return by_means(planner) if search.means else planner, kind

    reward = robot.tasks.reward_fn
    if config.pessimism:
        reward = jaxpets.rewards.pessimistic(reward, config.pessimism)
    guided = config.phase == "zero-shot" and config.critic.num_updates
    critic = None
    if guided:
        precision = jaxpets.Precision(config.task_planner.precision)
        model = _ensemble(robot, size, precision)
        critic = make_critic(config.critic, robot, model, terminal_fn)

    def with_policy(
        policy: jaxpets.Planner, reward_fn: jaxpets.typing.RewardFn
    ) -> jaxpets.Planner:
        if config.pessimism:
            reward_fn = jaxpets.rewards.pessimistic(reward_fn, config.pessimism)
        search, count = config.task_planner, size.num_members
        begins = prior(
            policy, trained.sample, horizon=search.horizon, num_members=count
        )
        return planner(reward_fn, search, propose_fn=begins)[0]

    random = jaxpets.random_planner(env.action_low, env.action_high)

    def learner(
        fitter: jaxpets.typing.Fitter,
        data: jaxpets.RewardData,
        length: int,
        capacity: int,
    ) -> jaxpets.typing.Learner:
        return jaxpets.learner(
            env, trained, fitter, data, trial_length=length, capacity=capacity
        )

    fitter, tuner = _fitter(trained, config.training), _fitter(trained, config.tuning)
    explorer, explored_by = arm.planner or random, NOTHING
    if arm.reward_fn is not None:
        explorer, explored_by = planner(arm.reward_fn, config.planner)
    if critic is None:
        actor, performed_by = planner(reward, config.task_planner)
    elif config.critic.acts:
        actor, performed_by = critic.policy, NOTHING
    else:
        actor, performed_by = planner(
            critic.reward_fn,
            config.task_planner,
            value_fn=critic.value_fn,
            discount=config.critic.discount,
        )
    return Parts(
        robot=robot,
        model=trained,
        random=random,
        explorer=explorer,
        actor=actor,
        with_policy=with_policy,
        critic=critic,
        learner=learner(fitter, arm.reward_data, config.trial_length, explored),
        reward_data=arm.reward_data,
        bind=arm.bind,
        explored_by=explored_by,
        performed_by=performed_by,
        fitter=fitter,
        refitter=_fitter(trained, config.refit) if config.refit.num_epochs else None,
        tuner=tuner,
        finetuner=learner(
            tuner, jaxpets.RewardData(), config.task_length, explored + finetuned
        ),
    )


def check_arm(config: Config) -> None:
    """Refuses an objective of the user's that no planner can seek.

    Raises:
      UsageError: with the line of the user's file that is at fault.
    """
    robot = robots.of(config)
    model = _planned(config, robot)
    count = config.model.num_members
    rollout = jaxpets.particle_rollout(
        model.sample, num_members=count, num_particles=count
    )

    def check(arm: Arm) -> Arm:
        assert arm.reward_fn is not None
        planner = jaxpets.plan(
            rollout, arm.reward_fn, optimizer(config.planner, robot.env)
        )

        def plan(key: Array) -> Any:
            params, data = model.init(key), arm.reward_data.init(key)
            nothing = jaxpets.datasets.init(1, model.obs_size, model.action_size)
            data = arm.reward_data.refresh(data, params, nothing)
            known = jaxpets.PlanParams(params, data)
            return planner.step(known, key, planner.init(), nothing.data.obs[0])

        jax.eval_shape(plan, jax.random.key(0))
        return arm

    make_arm(config, model, robot, check)


def trial_keys(config: Config, phase: int, trial: int) -> Array:
    """Returns one key per seed `[S]` for one trial of one phase."""

    def one(seed: Array) -> Array:
        return jax.random.fold_in(jax.random.fold_in(seed, phase), trial)

    return jax.vmap(one)(jnp.stack([jax.random.key(s) for s in config.seeds]))


def key_per(ids: Sequence[int], keys: Array) -> Array:
    """Derives keys `[..., K]` from keys `[...]`; a task has the same key in any set."""
    data = jnp.asarray(list(ids), jnp.uint32)
    fold = jax.vmap(jax.random.fold_in, (None, 0))
    for _ in keys.shape:
        fold = jax.vmap(fold, (0, None))
    return fold(keys, data)


def ensemble_config(model: ModelConfig) -> jaxpets.EnsembleConfig:
    """Returns the library's config of an ensemble whose hidden layers are equal."""
    return jaxpets.EnsembleConfig(
        num_members=model.num_members,
        hidden_sizes=(model.hidden_size,) * model.num_layers,
        state_margin=model.state_margin,
        activation=model.activation,
    )


def _fitter(
    ensemble: jaxpets.Ensemble, training: TrainingConfig
) -> jaxpets.typing.Fitter:
    build = jaxpets.fused_fitter if training.fused else jaxpets.fitter
    adam = optax.adam(training.learning_rate)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* trains as fitter")  # the phases say it
        return build(ensemble, adam, part(training, jaxpets.FitConfig))


def _ensemble(
    robot: Robot, size: jaxpets.EnsembleConfig, precision: jaxpets.Precision
) -> jaxpets.Ensemble:
    obs_size, action_size = robots.sizes(robot)
    return jaxpets.ensemble(
        dataclasses.replace(size, precision=precision),
        robot.space,
        obs_size=obs_size,
        action_size=action_size,
    )


def _planned(config: Config, robot: Robot) -> jaxpets.Ensemble:
    """Returns the model in the precision that plans in phase 1."""
    precision = jaxpets.Precision(config.planner.precision)
    return _ensemble(robot, ensemble_config(config.model), precision)


def rollout_of(
    robot: Robot, size: jaxpets.EnsembleConfig, search: PlannerConfig
) -> tuple[jaxpets.typing.RolloutFn, str]:
    """Returns the rollout of a search, and what decides about its last bits.

    That is the compiler of a kernel, or the scan, with a reason if it was not wanted.
    """
    precision = jaxpets.Precision(search.precision)
    model = _ensemble(robot, size, precision)
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


def imagined_end(env: jaxpets.Env) -> TerminalFn:
    """Returns what ends an imagined trial where a real one ends, if one ever does."""
    ends = env.terminal_fn
    return None if ends is None else lambda params, obs: ends(obs)


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
