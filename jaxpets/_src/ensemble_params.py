"""What an ensemble has learned, and what is read off it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_record
from jaxpets._src.ensemble_config import EnsembleConfig

# A log-variance of next to nothing; as a variance and inverted it is a float32 still.
_NOTHING = -80.0


class NetworkParams(NamedTuple):
    """What gradients train in an ensemble of `jaxpets.ensemble`.

    Attributes:
      members: Flax parameters; every leaf starts with E.
      min_logvar: `[D]`, the lower bound of log-variances, shared by the members.
      max_logvar: `[D]`, the upper bound, shared by the members.
    """

    members: Any
    min_logvar: Array
    max_logvar: Array


class Scaler(NamedTuple):
    """What the data say about scale, shared by the members.

    Attributes:
      mean: `[F + A]`, of features and action.
      std: `[F + A]`.
      low: `[D]`, the smallest observation.
      high: `[D]`, the largest observation.
    """

    mean: Array
    std: Array
    low: Array
    high: Array


class EnsembleParams(NamedTuple):
    """A model: everything that predicting needs.

    Attributes:
      network: what gradients train: NetworkParams, or any pytree that the functions of
        an ensemble of your own understand.
      scaler: what `fit_scaler` found: Scaler, or any pytree of your own.
    """

    network: Any
    scaler: Any


def max_variance(params: EnsembleParams) -> Array:
    """Returns `exp(max_logvar)` `[D]` in units of obs squared: the paper's w_base.

    Raises:
      TypeError: unless params are those of an ensemble of `jaxpets.ensemble`.
    """
    check_record("params", params, EnsembleParams)
    check_record("params.network", params.network, NetworkParams)
    return jnp.exp(params.network.max_logvar)


def without_noise(params: EnsembleParams) -> EnsembleParams:
    """Returns the parameters of a model that imagines its members' means.

    Particles then differ by their members alone, `s_{h+1} = mean_{b(p)}(s_h, a_h)`: one
    for each member is enough, and a search ranks its candidates by what they do, and
    not also by what was drawn for them. The paper draws (section 3.2), which shows a
    task that noise matters to what may happen. For planning, not for training.

    Raises:
      TypeError: unless params are those of an ensemble of `jaxpets.ensemble`.
    """
    check_record("params", params, EnsembleParams)
    check_record("params.network", params.network, NetworkParams)
    nothing = jnp.full_like(params.network.max_logvar, _NOTHING)
    network = params.network._replace(min_logvar=nothing, max_logvar=nothing)
    return params._replace(network=network)


def imagined_range(config: EnsembleConfig, scaler: Scaler) -> tuple[Array, Array]:
    """Returns the least and greatest observation `[D]` that is imagined."""
    if config.state_margin is None:
        return jnp.full_like(scaler.low, -jnp.inf), jnp.full_like(scaler.high, jnp.inf)
    # Before any data the range is infinite; 0 times that would be NaN.
    width = scaler.high - scaler.low
    margin = config.state_margin * width if config.state_margin else 0.0
    return scaler.low - margin, scaler.high + margin
