"""The arms: what phase 1 seeks. The first four are those of Table 1."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import optax
from jax import Array

import jaxpets
from experiments.config import Config
from jaxpets import rewards
from jaxpets.envs import half_cheetah

# States that an imagined one is compared with, as many as in a batch of APT; the time
# of a plan grows with it.
_NUM_STATES = 512
_ONE_STEP: dict[str, Callable[..., jaxpets.typing.RewardFn]] = {
    "one-step": rewards.one_step_disagreement,
    "jensen-renyi": rewards.jensen_renyi,
    "opax": rewards.opax,
}


class Arm(NamedTuple):
    """An exploration reward and the data it needs, or a planner that has none."""

    reward_fn: jaxpets.typing.RewardFn | None  # None acts without a plan
    reward_data: jaxpets.RewardData = jaxpets.RewardData()
    planner: jaxpets.Planner | None = None  # without a reward: None acts at random


def make_arm(config: Config, model: jaxpets.Ensemble, env: jaxpets.Env) -> Arm:
    """Returns the arm that a config names.

    Args:
      config: reads `arm`, `num_bits` and `trial_length`.
      model: predicts for the arms of one step.
      env: has the actions of the arm that is noise.
    """
    if config.arm == "pink-noise":
        box = (env.action_low, env.action_high)
        length = max(config.trial_length, 2)
        noise = jaxpets.random_planner(*box, noise_beta=1.0, period=length)
        return Arm(None, planner=noise)
    return {
        "epistemic": _epistemic,
        "count": _count,
        "random": lambda config, model: Arm(None),
        "oracle": _oracle,
        "info-gain": _info_gain,
        "best": _best,
        "ensemble-std": lambda config, model: Arm(rewards.ensemble_std),
        "rnd": _rnd,
        "particle-entropy": _particle_entropy,
        "mixture": _mixture,
        **dict.fromkeys(_ONE_STEP, _one_step),
    }[config.arm](config, model)


def _epistemic(config: Config, model: jaxpets.Ensemble) -> Arm:
    """SU-PETS: the paper's reward over w_base = exp(max_logvar), current and shared."""
    del config, model
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32),
        refresh=lambda _, params, dataset: rewards.max_variance(params),
    )
    return Arm(rewards.epistemic, data)


def _count(config: Config, model: jaxpets.Ensemble) -> Arm:
    """#Exploration: one projection per seed, all states hashed anew after a trial."""
    del model
    size = half_cheetah.OBS_SIZE
    nothing = jaxpets.datasets.init(1, size, half_cheetah.ACTION_SIZE)

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


def _oracle(config: Config, model: jaxpets.Ensemble) -> Arm:
    """PETS-oracle: the forward task in phase 1."""
    del config, model
    data = jaxpets.RewardData(
        init=lambda key: half_cheetah.task("forward"),
        refresh=lambda weights, params, dataset: weights,
    )
    return Arm(half_cheetah.task_reward, data)


def _one_step(config: Config, model: jaxpets.Ensemble) -> Arm:
    """What is about one step, which needs the whole model as its data."""
    data = jaxpets.RewardData(
        init=model.init, refresh=lambda _, params, dataset: params
    )
    return Arm(_ONE_STEP[config.arm](model.predict), data)


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


def _mixture(config: Config, model: jaxpets.Ensemble) -> Arm:
    """The forward task and disagreement, in equal parts: PETS that explores."""
    task, novelty = _oracle(config, model), _epistemic(config, model)
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

    mixed = rewards.mixture(task.reward_fn, novelty.reward_fn)
    return Arm(mixed, jaxpets.RewardData(init, refresh))


def _best(config: Config, model: jaxpets.Ensemble) -> Arm:
    """The paper's reward over the variance of the data, in place of w_base.

    A pitch that turns without bound has a small w_base: seven tenths of what sets one
    plan of SU-PETS apart from another is disagreement about the pitch, and exploration
    tumbles. In units of what was seen all coordinates weigh alike.
    """
    del config, model
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32),
        refresh=lambda _, params, dataset: jaxpets.datasets.obs_variance(dataset),
    )
    return Arm(rewards.epistemic, data)
