"""The arms of Table 1: what phase 1 seeks."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

import jaxpets
from experiments.config import Config
from jaxpets.envs import half_cheetah


class Arm(NamedTuple):
    """An exploration reward and the data it needs."""

    reward_fn: jaxpets.typing.RewardFn | None  # None acts at random
    reward_data: jaxpets.RewardData


def make_arm(config: Config, model: jaxpets.Ensemble) -> Arm:
    """Returns the arm that a config names.

    Args:
      config: reads `arm` and `num_bits`.
      model: predicts for the one-step arm.
    """
    return {
        "epistemic": _epistemic,
        "count": _count,
        "random": lambda config, model: Arm(None, jaxpets.RewardData()),
        "oracle": _oracle,
        "one-step": _one_step,
        "info-gain": _info_gain,
        "best": _best,
    }[config.arm](config, model)


def _epistemic(config: Config, model: jaxpets.Ensemble) -> Arm:
    """SU-PETS: the paper's reward over w_base = exp(max_logvar), current and shared."""
    del config, model
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32),
        refresh=lambda _, params, dataset: jaxpets.rewards.max_variance(params),
    )
    return Arm(jaxpets.rewards.epistemic, data)


def _count(config: Config, model: jaxpets.Ensemble) -> Arm:
    """#Exploration: one projection per seed, all states hashed anew after a trial."""
    del model
    size = half_cheetah.OBS_SIZE
    nothing = jaxpets.datasets.init(1, size, half_cheetah.ACTION_SIZE)

    def init(key: Array) -> jaxpets.rewards.PseudoCounts:
        projection = jaxpets.rewards.simhash(key, config.num_bits, size)
        return jaxpets.rewards.count_states(projection, nothing)

    data = jaxpets.RewardData(
        init=init,
        refresh=lambda counts, params, dataset: jaxpets.rewards.count_states(
            counts.projection, dataset
        ),
    )
    return Arm(jaxpets.rewards.pseudo_count, data)


def _oracle(config: Config, model: jaxpets.Ensemble) -> Arm:
    """PETS-oracle: the forward task in phase 1."""
    del config, model
    data = jaxpets.RewardData(
        init=lambda key: half_cheetah.task("forward"),
        refresh=lambda weights, params, dataset: weights,
    )
    return Arm(half_cheetah.task_reward, data)


def _one_step(config: Config, model: jaxpets.Ensemble) -> Arm:
    """Disagreement about one step, which needs the whole model as its data."""
    del config
    data = jaxpets.RewardData(
        init=model.init, refresh=lambda _, params, dataset: params
    )
    return Arm(jaxpets.rewards.one_step_disagreement(model.predict), data)


def _info_gain(config: Config, model: jaxpets.Ensemble) -> Arm:
    """Information gain over the w_base of SU-PETS."""
    return _epistemic(config, model)._replace(
        reward_fn=jaxpets.rewards.information_gain
    )


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
    return Arm(jaxpets.rewards.epistemic, data)
