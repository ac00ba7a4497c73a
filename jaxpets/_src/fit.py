"""Training of the ensemble: bootstraps, epochs and minibatches in one program."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxpets._src.checks import check_count, check_flag, check_key, check_real
from jaxpets._src.ensemble import Ensemble, EnsembleParams, NetworkParams
from jaxpets._src.types import Dataset

# Updates between two looks at how many there are: a GPU's host waits for each.
_UPDATES_AT_ONCE = 4


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """How often and in what portions the data are shown; the defaults are PETS's.

    Attributes:
      num_epochs: passes over the data per call.
      batch_size: rows per member and gradient step.
      final_rate: the step size at the end of a call as a share of the optimizer's; it
        falls along a cosine and starts anew with every call (SGDR, Loshchilov and
        Hutter, 2017). 1 is PETS's constant rate, whose last steps leave noise in the
        weights that looks like disagreement.
      bootstrap: whether a member sees its own draw of rows, which leaves out a third
        of them, or every row, and differs by its first weights and order alone (deep
        ensembles, Lakshminarayanan et al., 2017).
    """

    num_epochs: int = 5
    batch_size: int = 32
    final_rate: float = 1.0
    bootstrap: bool = True

    def __post_init__(self) -> None:
        check_count("num_epochs", self.num_epochs)
        check_count("batch_size", self.batch_size)
        check_real("final_rate", self.final_rate, 0.0, 1.0)
        check_flag("bootstrap", self.bootstrap)


class FitState(NamedTuple):
    """What the optimizer keeps between calls: the warm start of training."""

    opt_state: Any


class FitMetrics(NamedTuple):
    """How the last call went.

    Losses leave out dropped updates, and are NaN if all of an epoch were dropped.
    """

    loss: Array  # [] mean over the last epoch, without the penalties of `Ensemble.loss`
    mse: Array  # [] mean squared error of the mean, over members and dimensions
    num_updates: Array  # [] int32
    num_skipped: Array  # [] int32, updates dropped because the loss was not finite


class Fitter(NamedTuple):
    """Training as a pure function.

    init: `(EnsembleParams) -> FitState`.
    step: `(params, key, state, dataset) -> (params, state, FitMetrics)`.
    """

    init: Callable[[EnsembleParams], FitState]
    step: Callable[
        [EnsembleParams, Array, FitState, Dataset],
        tuple[EnsembleParams, FitState, FitMetrics],
    ]


def fit(
    ensemble: Ensemble, optimizer: optax.GradientTransformation, config: FitConfig
) -> Fitter:
    """Builds the trainer of PETS.

    One call refits the scaler on all data, draws a bootstrap per member (as many rows
    as there are, with replacement; section 3.2) unless `config` says otherwise, and
    runs `num_epochs` epochs over it, shuffled anew for each member and epoch. Networks
    and optimizer go on from where the last call left them. The number of updates
    follows the data, so a growing dataset needs no retrace; the last batch of an epoch
    is masked to what is left.

    To train several seeds at once, map `step` over `(0, 0, 0, jaxpets.DATASET_AXES)`.

    An update whose loss is not finite is dropped and counted. After every update the
    variance bounds are put in order, see `Ensemble.project`.

    Args:
      ensemble: what to train.
      optimizer: for example `optax.adam(1e-3)`.
      config: how often and in what portions the data are shown.

    Returns:
      A Fitter.
    """
    batch_size = config.batch_size

    def init(params: EnsembleParams) -> FitState:
        return FitState(optimizer.init(params.network))

    def update(
        network: NetworkParams, opt_state: Any, inputs: Array, targets: Array,
        weight: Array, has_rows: Array, done: Array,
    ) -> tuple[NetworkParams, Any, Array, Array]:  # fmt: skip
        grad_fn = jax.value_and_grad(ensemble.loss, has_aux=True)
        # The whole loss is not asked for: the value of its penalties, which only their
        # gradients need not, would cost a fifth of the step's programs on a GPU.
        (_, (loss, mse)), grads = grad_fn(network, inputs, targets, weight)
        # Optimizers of optax do not trace under strict promotion, if a caller set it.
        with jax.numpy_dtype_promotion("standard"):
            updates, new_state = optimizer.update(grads, opt_state, network)
            if config.final_rate < 1.0:
                rate = _annealed(config.final_rate, done)
                updates = jax.tree.map(lambda x: rate * x, updates)
        stepped = cast(NetworkParams, optax.apply_updates(network, updates))
        new = ensemble.project(stepped)
        # Backpropagation ends in the first leaf, the bias of the first layer, and in
        # the last, a variance bound: what is not finite on the way is not finite there.
        # Looking at every leaf would cost a fifth of the step on a GPU.
        leaves = jax.tree.leaves(grads)
        ends = jnp.concatenate([leaves[0].ravel(), leaves[-1].ravel(), loss[None]])
        finite = jnp.all(jnp.isfinite(ends))
        kept = finite & has_rows
        network, opt_state = jax.tree.map(
            lambda a, b: jnp.where(kept, a, b), (new, new_state), (network, opt_state)
        )
        return network, opt_state, jnp.where(finite, loss, jnp.nan), mse

    def step(
        params: EnsembleParams, key: Array, state: FitState, dataset: Dataset
    ) -> tuple[EnsembleParams, FitState, FitMetrics]:
        check_key("key", key)
        size = dataset.size
        scaler = ensemble.fit_scaler(dataset.data, size)
        inputs, targets = ensemble.encode(scaler, dataset.data)
        num_members = jax.tree.leaves(params.network.members)[0].shape[0]
        shape = (num_members, inputs.shape[0])
        shown_key, epochs_key = jax.random.split(key)
        shown = _shown(shown_key, config, shape, size)
        num_batches = (size + batch_size - 1) // batch_size

        def epoch(carry: tuple, inputs_: tuple) -> tuple[tuple, None]:
            network, opt_state, skipped, _ = carry
            number, key = inputs_
            order = jax.random.uniform(key, shape, jnp.float32)
            order = jnp.where(jnp.arange(shape[1]) < size, order, jnp.inf)
            rows = jnp.take_along_axis(shown, jnp.argsort(order, axis=1), axis=1)

            def batch(i: Array, carry: tuple) -> tuple:
                network, opt_state, skipped, totals = carry
                position = i * batch_size + jnp.arange(batch_size, dtype=jnp.int32)
                # Past the data lies what need not be finite, which no weight masks.
                within = jnp.minimum(position, size - 1)
                picked = jnp.take(rows, within, axis=1, mode="clip")
                used = (position < size).astype(jnp.float32)
                count = jnp.float32(jnp.clip(size - i * batch_size, 0, batch_size))
                has_rows = count > 0.0
                network, opt_state, loss, mse = update(
                    network, opt_state, inputs[picked], targets[picked],
                    used / jnp.maximum(count, 1.0), has_rows,
                    (number + i / jnp.maximum(num_batches, 1)) / config.num_epochs,
                )  # fmt: skip
                good = has_rows & jnp.isfinite(loss)
                totals = jax.tree.map(
                    lambda t, x: t + jnp.where(good, count * x, 0.0),
                    totals, (loss, mse, jnp.ones_like(loss)),
                )  # fmt: skip
                skipped += (has_rows & jnp.logical_not(good)).astype(jnp.int32)
                return network, opt_state, skipped, totals

            def batches(i: Array, carry: tuple) -> tuple:
                def one(j: Array, carry: tuple) -> tuple:
                    return batch(i * _UPDATES_AT_ONCE + j, carry)

                # Its length is known. The last ones may find no rows left.
                return jax.lax.fori_loop(0, _UPDATES_AT_ONCE, one, carry)

            carry = (network, opt_state, skipped, (jnp.zeros((), jnp.float32),) * 3)
            num_turns = (num_batches + _UPDATES_AT_ONCE - 1) // _UPDATES_AT_ONCE
            return jax.lax.fori_loop(0, num_turns, batches, carry), None

        totals = (jnp.zeros((), jnp.float32),) * 3
        carry = (params.network, state.opt_state, jnp.zeros((), jnp.int32), totals)
        keys = jax.random.split(epochs_key, config.num_epochs)
        epochs = (jnp.arange(config.num_epochs, dtype=jnp.float32), keys)
        (network, opt_state, skipped, totals), _ = jax.lax.scan(epoch, carry, epochs)
        loss, mse = (jnp.where(size > 0, x / totals[2], 0.0) for x in totals[:2])
        num_updates = (num_batches * config.num_epochs).astype(jnp.int32)
        metrics = FitMetrics(loss, mse, num_updates, skipped)
        return EnsembleParams(network, scaler), FitState(opt_state), metrics

    return Fitter(init, step)


def _shown(key: Array, config: FitConfig, shape: tuple[int, int], size: Array) -> Array:
    """Returns which rows each member is shown, `[E, C]`, of which `size` count."""
    if config.bootstrap:
        return jax.random.randint(key, shape, 0, jnp.maximum(size, 1))
    return jnp.broadcast_to(jnp.arange(shape[1], dtype=jnp.int32), shape)


def _annealed(final: float, done: Array) -> Array:
    """Returns a factor: 1, falling along a cosine to `final` as `done` goes to 1."""
    return final + (1 - final) * (1 + jnp.cos(jnp.pi * done)) / 2
