"""Data `[S]` of trials that a later phase sees, with room for them.

Seeds have sizes of their own here: where physics diverges, a trial is shorter.
"""

import jax
import jax.numpy as jnp

import jaxpets

from . import exploration
from .build import Parts, State


def room(
    parts: Parts, state: State, num_seeds: int, more: int
) -> jaxpets.typing.Dataset:
    """Returns the data that there are, with room for as many more.

    Args:
      parts: of the run.
      state: a learner `[S]`, or a model alone, without data.
      num_seeds: S.
      more: transitions of each seed.
    """
    if not jax.tree.leaves(state.dataset):
        return empty(parts, num_seeds, more)
    capacity = state.dataset.data.obs.shape[1] + more
    dataset = exploration.with_room(state, capacity).dataset
    size, cursor = (jnp.repeat(x, num_seeds) for x in (dataset.size, dataset.cursor))
    return dataset._replace(size=size, cursor=cursor)


def empty(parts: Parts, num_seeds: int, capacity: int) -> jaxpets.typing.Dataset:
    """Returns data `[S]` without a row."""
    sizes = (parts.model.obs_size, parts.model.action_size)
    dataset = jaxpets.datasets.init(capacity, *sizes)
    return jax.tree.map(lambda x: jnp.repeat(x[None], num_seeds, axis=0), dataset)


def append(
    dataset: jaxpets.typing.Dataset, new: jaxpets.Transition
) -> jaxpets.typing.Dataset:
    """Returns the data of a seed with trials `[K, R, T, *]`, one after the other."""

    def one(
        dataset: jaxpets.typing.Dataset, trial: jaxpets.Transition
    ) -> tuple[jaxpets.typing.Dataset, None]:
        kept = jaxpets.datasets.num_stable(trial)
        return jaxpets.datasets.append(dataset, trial, kept), None

    trials = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), new)
    return jax.lax.scan(one, dataset, trials)[0]
