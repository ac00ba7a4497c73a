"""The arms: what phase 1 seeks. The first four are those of Table 1."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from jaxpets import rewards
from jaxpets.envs import Robot, with_constants

from . import user_files
from .acting import Bind
from .config import Config

# States that an imagined one is compared with, as many as in a batch of APT; the time
# of a plan grows with it.
_NUM_STATES = 512
_ONE_STEP: dict[str, Callable[..., jaxpets.typing.RewardFn]] = {
    "one-step": rewards.one_step_disagreement,
    "jensen-renyi": rewards.jensen_renyi,
    "opax": rewards.opax,
}


class Arm(NamedTuple):
    """An exploration reward and the data it needs, or a planner that has none.

    `bind` gives the data the constants of a trial, where the reward reads them.
    """

    reward_fn: jaxpets.typing.RewardFn | None  # None acts without a plan
    reward_data: jaxpets.RewardData = jaxpets.RewardData()
    planner: jaxpets.Planner | None = None  # without a reward: None acts at random
    bind: Bind = lambda data, constants: data


def make_arm(
    config: Config,
    model: jaxpets.Ensemble,
    robot: Robot,
    check: Callable[["Arm"], "Arm"] = lambda arm: arm,
) -> Arm:
    """Returns the arm that a config names.

    Args:
      config: reads `arm`, `num_bits` and `trial_length`.
      model: predicts for the arms of one step.
      robot: has the actions of the arm that is noise, and the task of those that seek
        one.
      check: of an arm of the user's; raises what is wrong with it.

    Raises:
      UsageError: if the arm is of a file of the user's, and that is at fault.
    """
    if user_files.is_file(config.arm):

        def own(found: Any) -> Arm:
            return check(_own(found))

        return user_files.made("--arm", config.arm, "", own, model)
    if config.arm == "pink-noise":
        box = (robot.env.action_low, robot.env.action_high)
        length = max(config.trial_length, 2)
        noise = jaxpets.random_planner(*box, noise_beta=1.0, period=length)
        return Arm(None, planner=noise)
    if config.arm == "oracle":
        return _oracle(robot)
    if config.arm == "mixture":
        return _mixture(robot, _epistemic(config, model))
    return {
        "epistemic": _epistemic,
        "count": _count,
        "random": lambda config, model: Arm(None),
        "info-gain": _info_gain,
        "best": _best,
        "ensemble-std": lambda config, model: Arm(rewards.ensemble_std),
        "plan2explore": _plan2explore,
        "rnd": _rnd,
        "particle-entropy": _particle_entropy,
        **dict.fromkeys(_ONE_STEP, _one_step),
    }[config.arm](config, model)


def _epistemic(config: Config, model: jaxpets.Ensemble) -> Arm:
    """SU-PETS: the paper's reward over w_base = exp(max_logvar), current and shared."""
    del config
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((model.obs_size,), jnp.float32),
        refresh=lambda _, params, dataset: rewards.max_variance(params),
    )
    return Arm(rewards.epistemic, data)


def _count(config: Config, model: jaxpets.Ensemble) -> Arm:
    """#Exploration: one projection per seed, all states hashed anew after a trial."""
    size = model.obs_size
    nothing = jaxpets.datasets.init(1, size, model.action_size)

    def init(key: Array) -> rewards.PseudoCounts:
        projection = rewards.simhash(key, config.num_bits, size)
        return rewards.count_states(projection, nothing)

    data = jaxpets.RewardData(
        init=init,
        refresh=lambda counts, params, dataset: rewards.count_states(
            counts.projection, dataset
        ),
    )
    return Arm(rewards.pseudo_count, data)


def _own(found: Any) -> Arm:
    """What a function of the user's returns for a model."""
    is_pair = isinstance(found, tuple) and len(found) == 2
    if not (
        is_pair and callable(found[0]) and isinstance(found[1], jaxpets.RewardData)
    ):
        raise TypeError(f"it must return (RewardFn, RewardData), got {found!r}")
    return Arm(*found)


def _oracle(robot: Robot) -> Arm:
    """PETS-oracle: the first task in phase 1, on HalfCheetah forward."""
    data = jaxpets.RewardData(
        init=lambda key: jax.tree.map(lambda x: x[0], robot.tasks.params),
        refresh=lambda task, params, dataset: task,
    )
    return Arm(robot.tasks.reward_fn, data, bind=with_constants)


def _one_step(config: Config, model: jaxpets.Ensemble) -> Arm:
    """What is about one step, which needs the whole model as its data."""
    data = jaxpets.RewardData(
        init=model.init, refresh=lambda _, params, dataset: params
    )
    return Arm(_ONE_STEP[config.arm](model.predict), data)


def _plan2explore(config: Config, model: jaxpets.Ensemble) -> Arm:
    """What is about one step, in the units of `best`."""
    unit = _best(config, model).reward_data

    def init(key: Array) -> rewards.Plan2ExploreData:
        return rewards.Plan2ExploreData(model.init(key), unit.init(key))

    def refresh(
        data: rewards.Plan2ExploreData,
        params: jaxpets.EnsembleParams,
        dataset: jaxpets.typing.Dataset,
    ) -> rewards.Plan2ExploreData:
        baseline = unit.refresh(data.baseline_variance, params, dataset)
        return rewards.Plan2ExploreData(params, baseline)

    return Arm(rewards.plan2explore(model.predict), jaxpets.RewardData(init, refresh))


def _info_gain(config: Config, model: jaxpets.Ensemble) -> Arm:
    """Information gain over the w_base of SU-PETS."""
    return _epistemic(config, model)._replace(reward_fn=rewards.information_gain)


def _rnd(config: Config, model: jaxpets.Ensemble) -> Arm:
    """Random network distillation, trained on all states after a trial."""
    del config
    rnd = rewards.random_network_distillation(optax.adam(1e-3), obs_size=model.obs_size)
    return Arm(rnd.reward, jaxpets.RewardData(rnd.init, rnd.refresh))


def _particle_entropy(config: Config, model: jaxpets.Ensemble) -> Arm:
    """The distance to the nearest states, of those visited so far."""
    del config, model
    data = jaxpets.RewardData(
        refresh=lambda _, params, dataset: rewards.visited_states(dataset, _NUM_STATES)
    )
    return Arm(rewards.particle_entropy(), data)


def _mixture(robot: Robot, novelty: Arm) -> Arm:
    """The first task and disagreement, in equal parts: PETS that explores."""
    task = _oracle(robot)
    assert task.reward_fn and novelty.reward_fn

    def init(key: Array) -> rewards.MixtureData:
        return rewards.MixtureData(
            task.reward_data.init(key), novelty.reward_data.init(key), jnp.ones(())
        )

    def refresh(
        data: rewards.MixtureData,
        params: jaxpets.EnsembleParams,
        dataset: jaxpets.typing.Dataset,
    ) -> rewards.MixtureData:
        novel = novelty.reward_data.refresh(data.intrinsic, params, dataset)
        return data._replace(intrinsic=novel)

    def bind(data: rewards.MixtureData, constants: Any) -> rewards.MixtureData:
        return data._replace(extrinsic=with_constants(data.extrinsic, constants))

    mixed = rewards.mixture(task.reward_fn, novelty.reward_fn)
    return Arm(mixed, jaxpets.RewardData(init, refresh), bind=bind)


def _best(config: Config, model: jaxpets.Ensemble) -> Arm:
    """The paper's reward over the variance of the data, in place of w_base.

    A pitch that turns without bound has a small w_base: seven tenths of what sets one
    plan of SU-PETS apart from another is disagreement about the pitch, and exploration
    tumbles. In units of what was seen all coordinates weigh alike.
    """
    del config
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((model.obs_size,), jnp.float32),
        refresh=lambda _, params, dataset: jaxpets.datasets.obs_variance(dataset),
    )
    return Arm(rewards.epistemic, data)
