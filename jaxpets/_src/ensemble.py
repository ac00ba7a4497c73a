"""The probabilistic ensemble of PETS: Gaussian networks that share variance bounds."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.check_space import check_space_size
from jaxpets._src.checks import (
    check_array,
    check_count,
    check_key,
    check_like,
    check_record,
)
from jaxpets._src.ensemble_config import EnsembleConfig, layer_decays
from jaxpets._src.ensemble_params import (
    EnsembleParams,
    NetworkParams,
    Scaler,
    imagined_range,
)
from jaxpets._src.filled import filled
from jaxpets._src.moments import moments
from jaxpets._src.network import Network
from jaxpets._src.types import DynamicsFn, ModelSpace, Transition


class Ensemble(NamedTuple):
    """Pure functions of one ensemble, its sizes, and what it was built from.

    An ensemble of your own is one of these with your functions. `jaxpets.fitter` reads
    nothing of its parameters but the two fields of EnsembleParams, and
    `jaxpets.particle_rollout` calls `sample` alone.

    Attributes:
      init: `(key) -> EnsembleParams`.
      predict: `(params, obs [E, B, D], action [B, A] or [E, B, A]) -> (mean,
        variance)`, both `[E, B, D]`, of the next observation.
      sample: a DynamicsFn; draws from `predict` and bounds the result.
      fit_scaler: `(data: Transition [C, ...], size []) -> scaler` over the first rows,
        with the structure and shapes of the one of `init`.
      encode: `(scaler, data: Transition) -> (inputs [..., F+A], targets [..., D])`.
      loss: `(network, inputs [E, B, F+A], targets [E, B, D], weight [B]) -> (loss,
        (nll, mse))`, all `[]`; `weight` sums to one, `nll` is the loss without its
        penalties.
      project: `(network) -> network` after every update, with variance bounds in order.
      num_members: E.
      obs_size: D.
      action_size: A.
      sentinels: `(gradients of the network) -> pytree`: the parts that cannot be finite
        unless all are, so that training need not look at every weight; all by default.
      config: as `jaxpets.ensemble` got it; None in an ensemble of your own.
      space: as `jaxpets.ensemble` got it; None in an ensemble of your own.
    """

    init: Callable[[Array], EnsembleParams]
    predict: Callable[[EnsembleParams, Array, Array], tuple[Array, Array]]
    sample: DynamicsFn
    fit_scaler: Callable[[Transition, Array], Any]
    encode: Callable[[Any, Transition], tuple[Array, Array]]
    loss: Callable[[Any, Array, Array, Array], tuple[Array, tuple[Array, Array]]]
    project: Callable[[Any], Any]
    num_members: int
    obs_size: int
    action_size: int
    sentinels: Callable[[Any], Any] = lambda grads: grads
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
    return _DELTA


def _same(obs: Array) -> Array:
    return obs


def _change(obs: Array, next_obs: Array) -> Array:
    return next_obs - obs


def _changed(obs: Array, target: Array) -> Array:
    return obs + target


# One and the same, so that a file can tell it from a space of somebody's own.
_DELTA = ModelSpace(_same, _change, _changed, bound=jnp.clip)


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
      TypeError, ValueError: when sizes do not fit one another or the space; from the
        functions at trace time.
    """
    check_record("config", config, EnsembleConfig)
    check_space_size(space, obs_size)
    action_size = check_count("action_size", action_size)
    feature_size = space.features(jnp.zeros((obs_size,), jnp.float32)).shape[-1]
    input_size = feature_size + action_size
    decays = layer_decays(config)
    network = Network(
        config.hidden_sizes, 2 * obs_size, config.precision, config.activation
    )
    init_member = cast(Callable[[Array, Array], Any], network.init)
    apply_members = jax.vmap(cast(Callable[[Any, Array], Array], network.apply))

    def init(key: Array) -> EnsembleParams:
        check_key("key", key)
        keys = jax.random.split(key, config.num_members)
        example = jnp.zeros((1, input_size), jnp.float32)
        members = jax.vmap(init_member, (0, None))(keys, example)
        zeros = jnp.zeros((obs_size,), jnp.float32)
        inputs = jnp.zeros((input_size,), jnp.float32)
        scaler = Scaler(inputs, inputs + 1.0, zeros - jnp.inf, zeros + jnp.inf)
        return EnsembleParams(NetworkParams(members, zeros - 10.0, zeros + 0.5), scaler)

    check_params = params_check(init)

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
        check_params(params)
        check_array("obs", obs, [config.num_members, "B", obs_size])
        members = obs.shape[:1] if getattr(action, "ndim", 0) == 3 else ()
        check_array("action", action, [*members, obs.shape[1], action_size])
        actions = jnp.broadcast_to(action, (*obs.shape[:-1], action_size))
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
        check_key("key", key)
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
        return Scaler(mean, std, *_observed_range(data, size))

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
            for i, rate in enumerate(decays)
        )
        gap = jnp.sum(network.max_logvar) - jnp.sum(network.min_logvar)
        nll = jnp.sum(rows * weight)
        mse = jnp.sum(jnp.mean(square, axis=(0, 2)) * weight)
        return nll + decay + config.bound_decay * gap, (nll, mse)

    return Ensemble(
        init,
        predict,
        sample,
        fit_scaler,
        encode,
        loss,
        project=_order_bounds,
        num_members=config.num_members,
        obs_size=obs_size,
        action_size=action_size,
        sentinels=_sentinels,
        config=config,
        space=space,
    )


def params_check(
    init: Callable[[Array], EnsembleParams],
) -> Callable[[EnsembleParams], None]:
    """Returns a check that parameters have the structure and shapes of `init`'s."""

    @functools.cache
    def template() -> EnsembleParams:
        # Nothing is left in the program of whoever is being traced.
        key = jax.eval_shape(lambda: jax.random.key(0))
        return jax.eval_shape(init, key)

    def check_params(params: EnsembleParams) -> None:
        check_record("params", params, EnsembleParams)
        check_like("params", params, template())

    return check_params


def _observed_range(data: Transition, size: Array) -> tuple[Array, Array]:
    """Returns the least and greatest observation `[D]` in the first `size` rows."""
    obs = jnp.stack([data.obs, data.next_obs])
    used = filled(obs.shape[1], size)[:, None] & jnp.isfinite(obs)
    low = jnp.min(jnp.where(used, obs, jnp.inf), axis=(0, 1))
    high = jnp.max(jnp.where(used, obs, -jnp.inf), axis=(0, 1))
    # Without data there is no range to keep to.
    low = jnp.where(size > 0, low, -jnp.inf)
    return low, jnp.where(size > 0, high, jnp.inf)


def _order_bounds(network: NetworkParams) -> NetworkParams:
    floor = network.min_logvar + _MIN_BOUND_GAP
    return network._replace(max_logvar=jnp.maximum(network.max_logvar, floor))


def _sentinels(grads: NetworkParams) -> tuple[Array, Array]:
    # Backpropagation ends in the first layer's bias and in a variance bound: what is
    # not finite on the way is not finite there. To look at every weight would cost a
    # fifth of a step on a GPU.
    return grads.members["params"]["layer_0"]["bias"], grads.max_logvar
