"""Training of the ensemble: bootstraps, epochs and minibatches in one program."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxpets._src.batches import Batch, minibatch, rows_shown, shuffle
from jaxpets._src.checks import check_key, check_like, check_record
from jaxpets._src.ensemble import Ensemble, params_check
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.fit_records import FitConfig, FitMetrics, FitState, Fitter
from jaxpets._src.guards import choose, is_finite
from jaxpets._src.optimizer import Optimizer, check_optimizer
from jaxpets._src.types import Dataset

# Updates between two looks at how many there are: a GPU's host waits for each.
_UPDATES_AT_ONCE = 4


class Totals(NamedTuple):
    """Sums over the rows of an epoch's good updates, `[]`."""

    nll: Array
    mse: Array
    num_rows: Array


class Progress(NamedTuple):
    """What an epoch changes."""

    network: Any
    opt_state: Any
    num_skipped: Array  # [] int32
    totals: Totals  # of this epoch


class Epoch(NamedTuple):
    """What an epoch shows."""

    data: tuple[Array, Array]  # inputs [C, F + A], targets [C, D]
    rows: Array  # [E, C] int32, of which `size` count, in this epoch's order
    size: Array  # [] int32
    number: Array  # [] float32, of the epoch
    num_batches: Array  # [] int32


# `(progress, epoch) -> progress` after all of its updates.
EpochFn = Callable[[Progress, Epoch], Progress]


def fitter(ensemble: Ensemble, optimizer: Optimizer, config: FitConfig) -> Fitter:
    """Builds the trainer of PETS.

    One call refits the scaler on all data, draws a bootstrap per member (as many rows
    as there are, with replacement; section 3.2) unless `config` says otherwise, and
    runs `num_epochs` epochs over it, shuffled anew for each member and epoch. Networks
    and optimizer go on from where the last call left them. The number of updates
    follows the data, so a growing dataset needs no retrace; the last batch of an epoch
    is masked to what is left.

    To train several seeds at once, see `jaxpets.over_seeds`, or map `step` over
    `(0, 0, 0, jaxpets.datasets.AXES)`.

    An update whose loss or gradient is not finite is dropped and counted, and so are
    all of an epoch that ends with weights or an optimizer that are not finite, as a
    learning rate that is far too high leaves them. After every update the variance
    bounds are put in order, see `Ensemble.project`.

    Args:
      ensemble: what to train; see there for what is read of an ensemble of your own.
      optimizer: for example `optax.adam(1e-3)`.
      config: how often and in what portions the data are shown.

    Returns:
      A Fitter.

    Raises:
      TypeError, ValueError: if an argument is not what it should be.
    """
    check_arguments(ensemble, optimizer, config)

    def update(progress: Progress, batch: Batch, done: Array) -> Progress:
        network, opt_state, num_skipped, totals = progress
        grad_fn = jax.value_and_grad(ensemble.loss, has_aux=True)
        # The whole loss is not asked for: the value of its penalties, which only their
        # gradients need not, would cost a fifth of the step's programs on a GPU.
        (_, (nll, mse)), grads = grad_fn(network, *batch[:3])
        # Optimizers of optax do not trace under strict promotion, if a caller set it.
        with jax.numpy_dtype_promotion("standard"):
            updates, new_opt_state = optimizer.update(grads, opt_state, network)
            if config.final_rate < 1.0:
                rate = optax.cosine_decay_schedule(1.0, 1, config.final_rate)(done)
                updates = jax.tree.map(functools.partial(jnp.multiply, rate), updates)
        new_network = ensemble.project(optax.apply_updates(network, updates))

        has_rows = batch.num_rows > 0.0
        finite = _all_finite(ensemble.sentinels(grads), nll)
        good = has_rows & finite
        network, opt_state = choose(
            good, (new_network, new_opt_state), (network, opt_state)
        )
        mean = Totals(nll, mse, jnp.ones_like(nll))

        def add(total: Array, x: Array) -> Array:
            return total + jnp.where(good, batch.num_rows * x, 0.0)

        totals = jax.tree.map(add, totals, mean)
        num_skipped += (has_rows & jnp.logical_not(finite)).astype(jnp.int32)
        return Progress(network, opt_state, num_skipped, totals)

    def updates(progress: Progress, epoch: Epoch) -> Progress:
        data, rows, size, number, num_batches = epoch

        def one(i: Array, progress: Progress) -> Progress:
            batch = minibatch(data, rows, i, config.batch_size, size)
            done = number + i / jnp.maximum(num_batches, 1)
            return update(progress, batch, done / config.num_epochs)

        return _loop(num_batches, one, progress)

    return of_epochs(ensemble, optimizer, config, updates)


def check_arguments(ensemble: Any, optimizer: Any, config: Any) -> None:
    """Raises unless the arguments of a fitter are what they should be."""
    check_record("ensemble", ensemble, Ensemble)
    check_record("config", config, FitConfig)
    check_optimizer(optimizer)


def of_epochs(
    ensemble: Ensemble, optimizer: Optimizer, config: FitConfig, updates: EpochFn
) -> Fitter:
    """Builds a fitter from what an epoch does."""
    check_params = params_check(ensemble.init)

    def init(params: EnsembleParams) -> FitState:
        check_params(params)
        return FitState(optimizer.init(params.network))

    def step(
        params: EnsembleParams, key: Array, state: FitState, dataset: Dataset
    ) -> tuple[EnsembleParams, FitState, FitMetrics]:
        check_params(params)
        check_key("key", key)
        check_record("state", state, FitState)
        check_like("state", state, jax.eval_shape(init, params))
        check_record("dataset", dataset, Dataset)
        # Of NumPy, its rows could not be picked by what is traced, outside jit.
        dataset = jax.tree.map(cast(Any, jnp.asarray), dataset)
        size = dataset.size
        scaler = ensemble.fit_scaler(dataset.data, size)
        data = ensemble.encode(scaler, dataset.data)
        rows_key, epochs_key = jax.random.split(key)
        shape = (ensemble.num_members, dataset.data.obs.shape[0])
        rows = rows_shown(rows_key, config.bootstrap, shape, size)
        num_batches = (size + config.batch_size - 1) // config.batch_size

        def epoch(
            progress: Progress, number_and_key: tuple[Array, Array]
        ) -> tuple[Progress, None]:
            number, key = number_and_key
            shown = Epoch(data, shuffle(key, rows, size), size, number, num_batches)
            progress = progress._replace(totals=_zeros())
            return _kept(progress, updates(progress, shown), num_batches), None

        start = Progress(
            params.network, state.opt_state, jnp.zeros((), jnp.int32), _zeros()
        )
        numbers = jnp.arange(config.num_epochs, dtype=jnp.float32)
        keys = jax.random.split(epochs_key, config.num_epochs)
        end, _ = jax.lax.scan(epoch, start, (numbers, keys))
        metrics = FitMetrics(
            nll=end.totals.nll / end.totals.num_rows,
            mse=end.totals.mse / end.totals.num_rows,
            num_updates=(num_batches * config.num_epochs).astype(jnp.int32),
            num_skipped=end.num_skipped,
        )
        return EnsembleParams(end.network, scaler), FitState(end.opt_state), metrics

    return Fitter(init, step)


def _loop(
    length: Array, body: Callable[[Array, Progress], Progress], progress: Progress
) -> Progress:
    """Runs `body` at least `length` times, in turns of a length that is known."""

    def turn(i: Array, progress: Progress) -> Progress:
        def one(j: Array, progress: Progress) -> Progress:
            return body(i * _UPDATES_AT_ONCE + j, progress)

        return cast(Progress, jax.lax.fori_loop(0, _UPDATES_AT_ONCE, one, progress))

    num_turns = (length + _UPDATES_AT_ONCE - 1) // _UPDATES_AT_ONCE
    return cast(Progress, jax.lax.fori_loop(0, num_turns, turn, progress))


def _kept(before: Progress, after: Progress, num_batches: Array) -> Progress:
    """Returns an epoch's end, or its start if that is where the last good weights are.

    To look at all weights after every update would cost a fifth of a step on a GPU.
    """
    refused = before._replace(num_skipped=before.num_skipped + num_batches)
    finite = is_finite((after.network, after.opt_state))
    return choose(finite, after, refused)


def _zeros() -> Totals:
    return Totals(*(jnp.zeros((), jnp.float32),) * 3)


def _all_finite(*trees: Any) -> Array:
    leaves = jax.tree.leaves(trees)
    return jnp.all(jnp.isfinite(jnp.concatenate([x.ravel() for x in leaves])))
