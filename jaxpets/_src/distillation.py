"""Novelty as the error of a network that imitates a random one on visited states."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_count, check_key, check_record
from jaxpets._src.guards import choose, guarded_step
from jaxpets._src.moments import counted, moments
from jaxpets._src.optimizer import Optimizer, check_optimizer
from jaxpets._src.types import Dataset, RewardFn

Layers = tuple[tuple[Array, Array], ...]  # kernels and biases

# Whitened observations are cut off here, as in section 2.4 of Burda et al.
_CLIP = 5.0


class DistillationState(NamedTuple):
    """The data of the reward.

    Attributes:
      target: the random network.
      predictor: what imitates it.
      opt_state: of the predictor's training.
      mean: `[D]`, of the states visited.
      std: `[D]`, of the states visited.
      scale: `[]`, the mean error over the states visited.
    """

    target: Layers
    predictor: Layers
    opt_state: Any
    mean: Array
    std: Array
    scale: Array


class Distillation(NamedTuple):
    """A reward and how its data come about: `RewardData(init, refresh)`.

    Attributes:
      init: `(key) -> DistillationState`, untrained.
      refresh: `(state, EnsembleParams, Dataset) -> state`: trains on the states
        reached; the model is not read.
      reward: a RewardFn whose params are DistillationState.
    """

    init: Callable[[Array], DistillationState]
    refresh: Callable[[DistillationState, Any, Dataset], DistillationState]
    reward: RewardFn


def random_network_distillation(
    optimizer: Optimizer,
    *,
    obs_size: int,
    hidden_size: int = 64,
    num_features: int = 32,
    num_epochs: int = 5,
    batch_size: int = 256,
) -> Distillation:
    """Builds random network distillation (Burda et al., 2018) on imagined states.

    `r = |g(z) - f(z)|^2 / m`, with f a fixed random network, g a deeper one trained to
    equal it on visited states, z the next observation, whitened by the data and
    clipped to [-5, 5] (section 2.4). Where g was never trained it errs. Departures:
    the reward is that of states a model imagines, not of those just seen; m, the mean
    of the error over visited states, stands for the deviation of intrinsic returns, so
    1 is a state as well known as most; and g is trained once per trial on all data,
    going on from before. A batch is every so many-th row, of all trials alike, so that
    training needs no key.

    Args:
      optimizer: of optax, such as `optax.adam(1e-3)`.
      obs_size: D.
      hidden_size: width of two hidden layers of f, and of four of g.
      num_features: outputs of both.
      num_epochs: passes over the data per trial.
      batch_size: rows per gradient step.

    Returns:
      A Distillation. Its reward returns `[E, P]`, the leading shape of next_obs, and
      NaN where next_obs is not finite. Its functions raise TypeError or ValueError for
      data of another kind or shape.

    Raises:
      TypeError, ValueError: for an optimizer or a size that is none.
    """
    check_optimizer(optimizer)
    obs_size = check_count("obs_size", obs_size)
    hidden_size = check_count("hidden_size", hidden_size)
    num_features = check_count("num_features", num_features)
    num_epochs = check_count("num_epochs", num_epochs)
    batch_size = check_count("batch_size", batch_size)

    def init(key: Array) -> DistillationState:
        check_key("key", key)
        target_key, key = jax.random.split(key)
        hidden = (hidden_size, hidden_size)
        target = _layers(target_key, [obs_size, *hidden, num_features])
        predictor = _layers(key, [obs_size, *hidden, *hidden, num_features])
        zeros = jnp.zeros((obs_size,), jnp.float32)
        return DistillationState(
            target, predictor, optimizer.init(cast(Any, predictor)),
            mean=zeros, std=zeros + 1.0, scale=jnp.ones((), jnp.float32),
        )  # fmt: skip

    def refresh(
        state: DistillationState, params: Any, dataset: Dataset
    ) -> DistillationState:
        del params
        check_record("state", state, DistillationState)
        check_record("dataset", dataset, Dataset)
        rows = dataset.data.next_obs
        check_array("dataset.data.next_obs", rows, ["C", obs_size])
        used = counted(rows, dataset.size)
        mean, std = moments(rows, dataset.size)
        before, state = state, state._replace(mean=mean, std=std)
        inputs = jnp.where(used[:, None], _whiten(state, rows), 0.0)
        weight = used.astype(jnp.float32)
        num_batches = (dataset.size + batch_size - 1) // batch_size

        def update(i: Array, fit: tuple[Layers, Any]) -> tuple[Layers, Any]:
            predictor, opt_state = fit
            number = jnp.arange(batch_size, dtype=jnp.int32)
            batch = i % num_batches + num_batches * number
            shown = jnp.take(inputs, batch, axis=0, mode="clip")
            counts = jnp.take(weight, batch, mode="fill", fill_value=0.0)
            grad_fn = cast(Callable[..., Any], jax.grad(_loss))
            grads = grad_fn(predictor, state.target, shown, counts)
            predictor, opt_state, _ = guarded_step(
                optimizer.update, grads, predictor, opt_state
            )
            return predictor, opt_state

        start = (state.predictor, state.opt_state)
        predictor, opt_state = cast(
            tuple[Layers, Any],
            jax.lax.fori_loop(0, num_epochs * num_batches, update, start),
        )
        scale = _loss(predictor, state.target, inputs, weight)
        trained = state._replace(
            predictor=predictor,
            opt_state=opt_state,
            scale=jnp.where(scale > 0.0, scale, 1.0),
        )
        # Weights may be finite, and so large that what they predict is not.
        return choose(jnp.isfinite(scale), trained, before)

    def reward(
        params: DistillationState, obs: Array, action: Array, next_obs: Array
    ) -> Array:
        del obs, action
        check_record("params", params, DistillationState)
        check_array("next_obs", next_obs, ["...", obs_size])
        error = _error(params.predictor, params.target, _whiten(params, next_obs))
        # Clipped, a state that blew up would look like one that is merely new.
        finite = jnp.all(jnp.isfinite(next_obs), axis=-1)
        return jnp.where(finite, error / params.scale, jnp.nan)

    return Distillation(init, refresh, reward)


def _whiten(state: DistillationState, obs: Array) -> Array:
    return jnp.clip((obs - state.mean) / state.std, -_CLIP, _CLIP)


def _layers(key: Array, sizes: Sequence[int]) -> Layers:
    """Draws the layers of a network of rectifiers (He et al., 2015)."""
    keys = jax.random.split(key, len(sizes) - 1)
    return tuple(
        (
            jax.random.normal(key, (rows, columns), jnp.float32) * (2 / rows) ** 0.5,
            jnp.zeros((columns,), jnp.float32),
        )
        for key, rows, columns in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )


def _apply(layers: Layers, x: Array) -> Array:
    *hidden, (kernel, bias) = layers
    for weights, offset in hidden:
        x = jax.nn.relu(x @ weights + offset)
    return x @ kernel + bias


def _error(predictor: Layers, target: Layers, inputs: Array) -> Array:
    """Returns the squared distance of the two outputs, `[...]`."""
    return jnp.sum((_apply(predictor, inputs) - _apply(target, inputs)) ** 2, -1)


def _loss(predictor: Layers, target: Layers, inputs: Array, weight: Array) -> Array:
    total = jnp.sum(weight * _error(predictor, target, inputs))
    return total / jnp.maximum(jnp.sum(weight), 1.0)
