"""A dataset of fixed capacity, so that it grows without a retrace."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_array, check_count, check_record
from jaxpets._src.filled import filled
from jaxpets._src.moments import moments
from jaxpets._src.types import Dataset, Transition

_MAPPED: Any = 0
_SHARED: Any = None
# The axes of a dataset mapped over seeds which all have the same size. Shared, the size
# is the trip count of one plain loop over batches; mapped, every step of that loop
# would select between old and new parameters: a third more time on a GPU.
AXES = Dataset(data=_MAPPED, size=_SHARED, cursor=_SHARED)
# What MuJoCo holds for diverged, its mjMAXVAL. Squares of less fit into float32.
MAX_SIZE = 1e10


def init(capacity: int, obs_size: int, action_size: int) -> Dataset:
    """Returns an empty dataset for C = `capacity` transitions.

    Args:
      capacity: C.
      obs_size: D.
      action_size: A.

    Raises:
      TypeError, ValueError: unless all are positive Python integers.
    """
    capacity = check_count("capacity", capacity)
    obs_size = check_count("obs_size", obs_size)
    action_size = check_count("action_size", action_size)
    # Every array is a buffer of its own, so that a caller may donate them all.
    obs, action, next_obs = (
        jnp.zeros((capacity, size), jnp.float32)
        for size in (obs_size, action_size, obs_size)
    )
    size, cursor = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
    return Dataset(Transition(obs, action, next_obs), size, cursor)


def append(
    dataset: Dataset, transitions: Transition, count: Array | None = None
) -> Dataset:
    """Returns the dataset with T more rows, the oldest replaced once it is full.

    Args:
      dataset: what there is.
      transitions: `[T, D]`, `[T, A]`, `[T, D]`, T at most the capacity.
      count: `[]` int32, how many of the rows are meant, the first ones; None for all.
        So that trials of any length are appended by one program. More than T are T.

    Raises:
      TypeError, ValueError: if a record, a width, a length or a dtype does not fit.
    """
    _check_rows(dataset, transitions)
    length, capacity = len(transitions.obs), len(dataset.data.obs)
    rows = (dataset.cursor + jnp.arange(length, dtype=jnp.int32)) % capacity
    added: int | Array = length
    if count is not None:
        is_whole = jnp.issubdtype(jnp.result_type(count), jnp.integer)
        if jnp.shape(count) or not is_whole:
            raise TypeError(f"count must be int32[], got {count!r}.")
        added = jnp.clip(count, 0, length).astype(jnp.int32)
        # Beyond the last row nothing is written.
        rows = jnp.where(filled(length, added), rows, capacity)
    data = Transition(
        *(
            jnp.asarray(old).at[rows].set(new)
            for old, new in zip(dataset.data, transitions, strict=True)
        )
    )
    size = jnp.minimum(dataset.size + added, capacity)
    return Dataset(data, size, (dataset.cursor + added) % capacity)


def num_stable(transitions: Transition) -> Array:
    """Returns how many of T rows came before physics diverged, `[...]` int32.

    It has diverged from the first row on that has a number which is not finite, or
    beyond 1e10, which MuJoCo holds for the same. The rows that blew up to there, each
    with a largest number of more than twice the one before, belong to it: one of them
    would set the scale of all that is learned.

    Args:
      transitions: `[..., T, *]`.

    >>> import jax.numpy as jnp
    >>> path = jnp.float32([[1.0], [3.0], [2.0], [4.0], [90.0], [7e5], [jnp.nan]])
    >>> num_stable(Transition(path[:-1], path[:-1], path[1:])).tolist()
    3
    """
    check_record("transitions", transitions, Transition)
    # Number by number: XLA's maximum of many rows on a CPU passes over what is NaN.
    good = (jnp.all(jnp.abs(x) <= MAX_SIZE, axis=-1) for x in transitions)
    is_good = functools.reduce(jnp.logical_and, good)
    obs, next_obs = (
        jnp.max(jnp.abs(x), axis=-1) for x in (transitions.obs, transitions.next_obs)
    )
    step = jnp.arange(is_good.shape[-1], dtype=jnp.int32)
    is_before = jax.lax.cummin(is_good.astype(jnp.int32), axis=is_good.ndim - 1) > 0
    # At the start of a trial, from rest, everything grows.
    is_stable = (next_obs <= 2.0 * obs) | (step == 0)
    # Of no rows at all, none.
    last = jnp.where(is_before & is_stable, step, -1).max(axis=-1, initial=-1)
    return jnp.where(jnp.all(is_good, axis=-1), len(step), last + 1)


def append_stable(dataset: Dataset, transitions: Transition) -> Dataset:
    """Returns the dataset with T more rows, none of them from where physics diverged.

    The rows of `num_stable` are appended. Seeds share the size of their data, which
    grows by T for all of them: the places that are left are taken by rows that are
    there, once more, spread evenly over the data; by zeros where nothing is there yet.

    Args:
      dataset: what there is.
      transitions: `[T, D]`, `[T, A]`, `[T, D]`, T at most the capacity.

    Raises:
      TypeError, ValueError: as from `append`.
    """
    _check_rows(dataset, transitions)
    length, capacity = len(transitions.obs), len(dataset.data.obs)
    kept = num_stable(transitions)
    known = append(dataset, transitions, kept)
    step = jnp.arange(length, dtype=jnp.int32)
    num_lost = jnp.maximum(length - kept, 1)
    each, rest = jnp.divmod(known.size, num_lost)
    lost = jnp.maximum(step - kept, 0)
    again = lost * each + _share(lost, rest, num_lost)
    # Beyond the last row nothing is written.
    places = (dataset.cursor + step) % capacity
    places = jnp.where(step < kept, capacity, places)
    data = Transition(*(rows.at[places].set(rows[again]) for rows in known.data))
    size = jnp.minimum(dataset.size + length, capacity)
    return Dataset(data, size, (dataset.cursor + length) % capacity)


def _share(count: Array, part: Array, whole: Array) -> Array:
    """Returns `count * part // whole`, for count and part below a whole of up to 2^25.

    The product itself does not fit into int32 from 46,341 squared on, so it is divided
    digit by digit, in base 32, and what remains is carried on.
    """
    share, rest = jnp.zeros_like(count), jnp.zeros_like(count)
    for shift in (20, 15, 10, 5, 0):
        digit = (count >> shift) & 31
        more, rest = jnp.divmod(32 * rest + digit * part, whole)
        share = 32 * share + more
    return share


def _check_dataset(dataset: Dataset) -> None:
    """Raises unless this is one dataset: those of several seeds are to be mapped."""
    check_record("dataset", dataset, Dataset)
    check_array("dataset.data.obs", dataset.data.obs, ["C", "D"])


def _check_rows(dataset: Dataset, transitions: Transition) -> None:
    """Raises unless rows of one length are what the dataset holds, and fit into it."""
    _check_dataset(dataset)
    check_record("transitions", transitions, Transition)
    capacity, obs_size = dataset.data.obs.shape
    check_array("transitions.obs", transitions.obs, ["T", obs_size])
    length = transitions.obs.shape[0]
    if length > capacity:
        raise ValueError(
            f"transitions must fit the capacity of {capacity}, got {length} rows."
        )
    check_array("transitions.obs", transitions.obs, [length, obs_size])
    check_array("transitions.next_obs", transitions.next_obs, [length, obs_size])
    action_size = dataset.data.action.shape[1]
    check_array("transitions.action", transitions.action, [length, action_size])


def grow(dataset: Dataset, capacity: int) -> Dataset:
    """Returns the dataset with room for `capacity` rows, the oldest row first.

    Args:
      dataset: what there is.
      capacity: at least the present one.

    Raises:
      TypeError, ValueError: if dataset is none, or one of several seeds, or capacity is
        no integer, or smaller than it was.
    """
    _check_dataset(dataset)
    old = dataset.data.obs.shape[0]
    capacity = check_count("capacity", capacity, minimum=old)

    def widen(rows: Array) -> Array:
        rows = jnp.roll(
            rows, jnp.where(dataset.size == old, -dataset.cursor, 0), axis=0
        )
        return jnp.pad(rows, ((0, capacity - old), (0, 0)))

    data = Transition(*(widen(rows) for rows in dataset.data))
    return Dataset(data, dataset.size, dataset.size % capacity)


def obs_variance(dataset: Dataset) -> Array:
    """Returns the variance of the observations seen, `[D]` in units of obs squared.

    1 where there is none, as before any data. As the baseline variance of an
    exploration reward it counts disagreement in units of what was seen. Those of
    several seeds are mapped, over AXES.

    Raises:
      TypeError, ValueError: if dataset is none, or one of several seeds.
    """
    _check_dataset(dataset)
    _, std = moments(dataset.data.obs, dataset.size)
    return std**2
