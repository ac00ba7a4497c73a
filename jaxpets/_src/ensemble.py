"""The probabilistic ensemble of PETS: Gaussian networks that share variance bounds."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_count,
    check_counts,
    check_real,
    check_reals,
)
from jaxpets._src.moments import moments
from jaxpets._src.network import Network, Precision
from jaxpets._src.types import DynamicsFn, ModelSpace, Transition


@dataclasses.dataclass(frozen=True)
class EnsembleConfig:
    """The network and loss of PETS on HalfCheetah.

    Attributes:
      num_members: E.
      hidden_sizes: widths of the hidden layers.
      weight_decays: one per layer, the output layer last; each times `sum(w^2) / 2`.
      bound_decay: pull of the loss on the log-variance bounds.
      precision: of the matrix products. It changes no parameter, so an ensemble may be
        trained in one precision and planned with in another.
      state_margin: imagined states may leave the range of the data by this share of
        its width; None leaves them free. Not in PETS: without it a learned model can
        blow up while every number stays finite, and a planner that looks for
        disagreement finds that.
    """

    num_members: int = 5
    hidden_sizes: tuple[int, ...] = (200, 200, 200, 200)
    weight_decays: tuple[float, ...] = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4)
    bound_decay: float = 0.01
    precision: Precision = Precision.TF32
    state_margin: float | None = 0.5

    def __post_init__(self) -> None:
        check_count("num_members", self.num_members)
        check_counts("hidden_sizes", self.hidden_sizes)
        check_reals("weight_decays", self.weight_decays, 0.0)
        if len(self.weight_decays) != len(self.hidden_sizes) + 1:
            raise ValueError(
                "weight_decays must have one entry per layer "
                f"({len(self.hidden_sizes) + 1}), got {len(self.weight_decays)}."
            )
        check_real("bound_decay", self.bound_decay, 0.0)
        if not isinstance(self.precision, Precision):
            raise TypeError(f"precision must be a Precision, got {self.precision!r}.")
        if self.state_margin is not None:
            check_real("state_margin", self.state_margin, 0.0)


class NetworkParams(NamedTuple):
    """What gradients train."""

    members: Any  # flax parameters; every leaf starts with E
    min_logvar: Array  # [D], shared by the members
    max_logvar: Array  # [D], shared by the members


class Scaler(NamedTuple):
    """What the data say about scale, shared by the members."""

    mean: Array  # [F + A] of features and action
    std: Array  # [F + A]
    low: Array  # [D] smallest observation
    high: Array  # [D] largest observation


class EnsembleParams(NamedTuple):
    """A model: everything that predicting needs."""

    network: NetworkParams
    scaler: Scaler


class Ensemble(NamedTuple):
    """Pure functions of one ensemble, and what it was built from.

    init: `(key) -> EnsembleParams`.
    predict: `(params, obs [E, B, D], action [B, A]) -> (mean, variance)`, both
      `[E, B, D]`, of the next observation.
    sample: a DynamicsFn; draws from `predict` and bounds the result.
    fit_scaler: `(data: Transition [C, ...], size []) -> Scaler` over the first rows.
    encode: `(scaler, data: Transition) -> (inputs [..., F+A], targets [..., D])`.
    loss: `(network, inputs [E, B, F+A], targets [E, B, D], weight [B]) -> (loss, (nll,
      mse))`; `weight` sums to one, `nll` is the loss without its penalties.
    project: `(network) -> network` with variance bounds in order.
    num_members: E.
    obs_size: D.
    action_size: A.
    config, space: as `jaxpets.ensemble` got them; None in an ensemble of your own.
    """

    init: Callable[[Array], EnsembleParams]
    predict: Callable[[EnsembleParams, Array, Array], tuple[Array, Array]]
    sample: DynamicsFn
    fit_scaler: Callable[[Transition, Array], Scaler]
    encode: Callable[[Scaler, Transition], tuple[Array, Array]]
    loss: Callable[
        [NetworkParams, Array, Array, Array], tuple[Array, tuple[Array, Array]]
    ]
    project: Callable[[NetworkParams], NetworkParams]
    num_members: int
    obs_size: int
    action_size: int
    config: EnsembleConfig | None = None
    space: ModelSpace | None = None


# The bounds may not cross: past that point nothing holds max_logvar, which is the
# denominator of the exploration reward, and Adam would lower it for ever.
_MIN_BOUND_GAP = 0.1


def delta_space() -> ModelSpace:
    """Returns the plain space: features are the observation, targets its change.

    >>> space = delta_space()
    >>> obs, next_obs = jnp.zeros(3), jnp.ones(3)
    >>> space.next_obs(obs, space.target(obs, next_obs)).tolist()
    [1.0, 1.0, 1.0]
    """
    return ModelSpace(
        features=lambda obs: obs,
        target=lambda obs, next_obs: next_obs - obs,
        next_obs=lambda obs, target: obs + target,
        bound=jnp.clip,
    )


def max_variance(params: EnsembleParams) -> Array:
    """Returns `exp(max_logvar)` `[D]` in units of obs squared: the paper's w_base."""
    return jnp.exp(params.network.max_logvar)


def imagined_range(config: EnsembleConfig, scaler: Scaler) -> tuple[Array, Array]:
    """Returns the least and greatest observation `[D]` that is imagined."""
    if config.state_margin is None:
        return jnp.full_like(scaler.low, -jnp.inf), jnp.full_like(scaler.high, jnp.inf)
    # Before any data the range is infinite; 0 times that would be NaN.
    width = scaler.high - scaler.low
    margin = config.state_margin * width if config.state_margin else 0.0
    return scaler.low - margin, scaler.high + margin


def ensemble(
    config: EnsembleConfig, space: ModelSpace, *, obs_size: int, action_size: int
) -> Ensemble:
    """Builds the ensemble of section 3.2: E Gaussian networks trained side by side.

    A member reads standardised features and action and returns a mean and a raw
    log-variance, bounded softly by learned vectors that all members share:
    `lv = max - softplus(max - raw)`, then `lv = min + softplus(lv - min)`. So the
    variance is `exp(lv) = exp(min) + exp(max) * sigmoid(raw - max)`.

    The loss is that of PETS: the sum over members of the mean over rows and
    dimensions of `(mean - y)^2 exp(-lv) + lv`, and two penalties: weight decay, and
    `bound_decay * (sum(max_logvar) - sum(min_logvar))`.

    Args:
      config: sizes and coefficients.
      space: coordinates.
      obs_size: D.
      action_size: A.

    Returns:
      An Ensemble.

    Raises:
      TypeError, ValueError: when sizes do not fit; from the functions at trace time.
    """
    check_count("obs_size", obs_size)
    check_count("action_size", action_size)
    feature_size = space.features(jnp.zeros((obs_size,), jnp.float32)).shape[-1]
    input_size = feature_size + action_size
    network = Network(config.hidden_sizes, 2 * obs_size, config.precision)
    apply_members: Callable[[Any, Array], Array] = jax.vmap(network.apply)  # pyright: ignore

    def init(key: Array) -> EnsembleParams:
        keys = jax.random.split(key, config.num_members)
        example = jnp.zeros((1, input_size), jnp.float32)
        members = jax.vmap(network.init, (0, None))(keys, example)
        zeros = jnp.zeros((obs_size,), jnp.float32)
        inputs = jnp.zeros((input_size,), jnp.float32)
        scaler = Scaler(inputs, inputs + 1.0, zeros - jnp.inf, zeros + jnp.inf)
        return EnsembleParams(NetworkParams(members, zeros - 10.0, zeros + 0.5), scaler)

    def forward(network: NetworkParams, inputs: Array) -> tuple[Array, Array]:
        outputs = apply_members(network.members, inputs)
        mean, raw = jnp.split(outputs, 2, axis=-1)
        return mean, raw

    def encode_inputs(scaler: Scaler, obs: Array, action: Array) -> Array:
        inputs = jnp.concatenate([space.features(obs), action], axis=-1)
        return (inputs - scaler.mean) / scaler.std

    def encode(scaler: Scaler, data: Transition) -> tuple[Array, Array]:
        inputs = encode_inputs(scaler, data.obs, data.action)
        return inputs, space.target(data.obs, data.next_obs)

    def distribution(
        params: EnsembleParams, obs: Array, action: Array
    ) -> tuple[Array, Array]:
        check_array("obs", obs, [config.num_members, "B", obs_size])
        check_array("action", action, [obs.shape[1], action_size])
        actions = jnp.broadcast_to(action, (config.num_members, *action.shape))
        inputs = encode_inputs(params.scaler, obs, actions)
        mean, raw = forward(params.network, inputs)
        low, high = params.network.min_logvar, params.network.max_logvar
        # Not by way of lv: its two logarithms take a CPU as long as a third of a layer.
        return mean, jnp.exp(low) + jnp.exp(high) * jax.nn.sigmoid(raw - high)

    def predict(
        params: EnsembleParams, obs: Array, action: Array
    ) -> tuple[Array, Array]:
        mean, variance = distribution(params, obs, action)
        return space.next_obs(obs, mean), variance

    def sample(params: EnsembleParams, key: Array, obs: Array, action: Array) -> Array:
        mean, variance = distribution(params, obs, action)
        noise = jax.random.normal(key, mean.shape, jnp.float32)
        next_obs = space.next_obs(obs, mean + jnp.sqrt(variance) * noise)
        if config.state_margin is None:
            return next_obs
        return space.bound(next_obs, *imagined_range(config, params.scaler))

    def fit_scaler(data: Transition, size: Array) -> Scaler:
        check_array("data.obs", data.obs, ["C", obs_size])
        check_array("data.action", data.action, ["C", action_size])
        inputs = jnp.concatenate([space.features(data.obs), data.action], axis=-1)
        mean, std = moments(inputs, size)
        obs = jnp.stack([data.obs, data.next_obs])
        used = (jnp.arange(inputs.shape[0]) < size)[:, None] & jnp.isfinite(obs)
        low = jnp.min(jnp.where(used, obs, jnp.inf), axis=(0, 1))
        high = jnp.max(jnp.where(used, obs, -jnp.inf), axis=(0, 1))
        # Without data there is no range to keep to.
        low = jnp.where(size > 0, low, -jnp.inf)
        return Scaler(mean, std, low, jnp.where(size > 0, high, jnp.inf))

    def loss(
        network: NetworkParams, inputs: Array, targets: Array, weight: Array
    ) -> tuple[Array, tuple[Array, Array]]:
        mean, raw = forward(network, inputs)
        low, high = network.min_logvar, network.max_logvar
        logvar = high - jax.nn.softplus(high - raw)
        logvar = low + jax.nn.softplus(logvar - low)
        square = (mean - targets) ** 2
        rows = jnp.mean(square * jnp.exp(-logvar) + logvar, axis=-1)
        decay = sum(
            rate * jnp.sum(network.members["params"][f"layer_{i}"]["kernel"] ** 2) / 2
            for i, rate in enumerate(config.weight_decays)
        )
        gap = jnp.sum(network.max_logvar) - jnp.sum(network.min_logvar)
        nll = jnp.sum(rows * weight)
        mse = jnp.sum(jnp.mean(square, axis=(0, 2)) * weight)
        return nll + decay + config.bound_decay * gap, (nll, mse)

    def project(network: NetworkParams) -> NetworkParams:
        floor = network.min_logvar + _MIN_BOUND_GAP
        return network._replace(max_logvar=jnp.maximum(network.max_logvar, floor))

    return Ensemble(
        init,
        predict,
        sample,
        fit_scaler,
        encode,
        loss,
        project,
        num_members=config.num_members,
        obs_size=obs_size,
        action_size=action_size,
        config=config,
        space=space,
    )
