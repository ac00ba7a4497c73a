"""The arms of Table 1: what phase 1 seeks."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from experiments.config import Config
from jaxpets._src.moments import moments
from jaxpets.envs import half_cheetah


class Arm(NamedTuple):
    """An exploration reward and the data it needs."""

    reward_fn: jaxpets.RewardFn | None  # None acts at random
    reward_data: jaxpets.RewardData


# A reward without data of its own.
NO_DATA = jaxpets.RewardData(lambda key: (), lambda data, params, dataset: data)


def make_arm(config: Config, model: jaxpets.Ensemble) -> Arm:
    """Returns the arm that a config names.

    Args:
      config: reads `arm` and `num_bits`.
      model: predicts for the one-step arm.
    """
    return {
        "epistemic": _epistemic,
        "count": _count,
        "random": lambda config, model: Arm(None, NO_DATA),
        "oracle": _oracle,
        "one-step": _one_step,
        "info-gain": _info_gain,
        "scaled": _scaled,
        "scaled-log": _scaled_log,
        "focus": lambda c, m: _directed(_focus, _gauss),
        "focus-one": lambda c, m: _directed(_focus, _one_hot),
        "goals": lambda c, m: _directed(_goals, _gauss),
        "goals-ig": lambda c, m: _directed(_goals_ig, _gauss),
        "ig-focus": lambda c, m: _directed(_ig_focus, _dirichlet),
    }[config.arm](config, model)


def _epistemic(config: Config, model: jaxpets.Ensemble) -> Arm:
    """SU-PETS: the paper's reward over w_base = exp(max_logvar), current and shared."""
    del config, model
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32),
        refresh=lambda _, params, dataset: jaxpets.max_variance(params),
    )
    return Arm(jaxpets.rewards.epistemic, data)


def _count(config: Config, model: jaxpets.Ensemble) -> Arm:
    """#Exploration: one projection per seed, all states hashed anew after a trial."""
    del model
    size = half_cheetah.OBS_SIZE
    nothing = jaxpets.init_dataset(1, size, half_cheetah.ACTION_SIZE)

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
    """Information gain over the same w_base as SU-PETS."""
    return _epistemic(config, model)._replace(
        reward_fn=jaxpets.rewards.information_gain
    )


def _scaled(config: Config, model: jaxpets.Ensemble) -> Arm:
    """The paper's reward over the variance of the data."""
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32),
        refresh=lambda _, params, dataset: (
            moments(dataset.data.obs, dataset.size)[1] ** 2
        ),
    )
    return Arm(jaxpets.rewards.epistemic, data)


def _scaled_log(config: Config, model: jaxpets.Ensemble) -> Arm:
    data = jaxpets.RewardData(
        init=lambda key: jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32),
        refresh=lambda _, params, dataset: (
            0.01 * moments(dataset.data.obs, dataset.size)[1] ** 2
        ),
    )
    return Arm(jaxpets.rewards.information_gain, data)


def _gauss(key: Array) -> Array:
    w = jax.random.normal(key, (half_cheetah.OBS_SIZE,))
    return w / jnp.linalg.norm(w)


def _one_hot(key: Array) -> Array:
    k = jax.random.randint(key, (), 0, half_cheetah.OBS_SIZE)
    return jax.nn.one_hot(k, half_cheetah.OBS_SIZE, dtype=jnp.float32)


def _dirichlet(key: Array) -> Array:
    u = jax.random.exponential(key, (half_cheetah.OBS_SIZE,)) ** 3
    return u / u.mean()


def _directed(reward_fn: Any, draw: Any) -> Arm:
    """A direction per trial, in units of the spread of the data."""
    ones = jnp.ones((half_cheetah.OBS_SIZE,), jnp.float32)

    def refresh(data: Any, params: Any, dataset: jaxpets.Dataset) -> Any:
        raw = data[0]
        key = jax.random.fold_in(jax.random.wrap_key_data(raw), dataset.size)
        std = moments(dataset.data.obs, dataset.size)[1]
        return raw, draw(key), std, jaxpets.max_variance(params)

    data = jaxpets.RewardData(
        init=lambda key: (jax.random.key_data(key), ones, ones, ones),
        refresh=refresh,
    )
    return Arm(reward_fn, data)


def _focus(data: Any, obs: Array, action: Array, next_obs: Array) -> Array:
    _, w, std, _ = data
    return jnp.std(jnp.mean(next_obs, axis=1) @ (w / std))


def _goals(data: Any, obs: Array, action: Array, next_obs: Array) -> Array:
    _, w, std, _ = data
    return next_obs @ (w / std)


def _goals_ig(data: Any, obs: Array, action: Array, next_obs: Array) -> Array:
    gain = jaxpets.rewards.information_gain(data[3], obs, action, next_obs)
    return 5 * gain + jnp.mean(_goals(data, obs, action, next_obs))


def _ig_focus(data: Any, obs: Array, action: Array, next_obs: Array) -> Array:
    _, w, _, base = data
    v = jnp.var(jnp.mean(next_obs, axis=1), axis=0)
    return jnp.mean(w * jnp.log1p(v / base)) / 2
