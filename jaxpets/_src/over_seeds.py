"""Many seeds of one learner, side by side in one program."""

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src import dataset as datasets
from jaxpets._src.checks import check_count, check_keys, check_record
from jaxpets._src.fit_records import FitMetrics
from jaxpets._src.learner import Learner, LearnerState, TrialOutput
from jaxpets._src.types import Dataset, Planner, Transition

_MAPPED: Any = 0
# The axes of a learner over seeds. All have seen equally much, so the size of their
# datasets is one number; see `datasets.AXES` for what that is worth.
SEED_AXES = LearnerState(_MAPPED, _MAPPED, datasets.AXES, _MAPPED)


def over_seeds(learner: Learner, num_seeds: int) -> Learner:
    """Maps a learner over a new leading axis of seeds.

    It is `jax.vmap` with the axes SEED_AXES: every leaf of the state has the axis but
    for the size and the cursor of the dataset, which all seeds share. A plain vmap is
    the same learner and takes a third longer to train. An axis of one seed is left out
    of the programs: XLA does not simplify gathers over it.

    Args:
      learner: of one seed; may itself be mapped over seeds.
      num_seeds: S.

    Returns:
      A Learner whose `init`, `learn` and `step` take keys `[S]`, states over SEED_AXES
      and transitions `[S, T, ...]`, and return the same. The planner of `step` is that
      of one seed.

    Raises:
      TypeError, ValueError: unless num_seeds is a positive Python integer; from the
        functions, unless there are as many keys, states and transitions.
    """
    check_record("learner", learner, Learner)
    num_seeds = check_count("num_seeds", num_seeds)

    def init(keys: Array) -> LearnerState:
        check_keys("keys", keys, num_seeds)
        return jax.vmap(learner.init, out_axes=SEED_AXES)(keys)

    def call(
        one: Callable[..., tuple[LearnerState, Any]],
        keys: Array,
        state: LearnerState,
        *rest: Transition,
    ) -> tuple[LearnerState, Any]:
        check_keys("keys", keys, num_seeds)
        _check_state(state, num_seeds)
        _check_seeds("transitions", rest[0] if rest else (), num_seeds)
        if num_seeds == 1:
            state, output = one(keys[0], _only(state), *_only(rest))
            return _as_one_of_many(state), _many(output)
        mapped = jax.vmap(one, (0, SEED_AXES, *(0 for _ in rest)), (SEED_AXES, 0))
        return mapped(keys, state, *rest)

    def learn(
        keys: Array, state: LearnerState, transitions: Transition
    ) -> tuple[LearnerState, FitMetrics]:
        return call(learner.learn, keys, state, transitions)

    def step(
        planner: Planner, keys: Array, state: LearnerState
    ) -> tuple[LearnerState, TrialOutput]:
        return call(functools.partial(learner.step, planner), keys, state)

    return Learner(init, learn, step)


def _check_state(state: Any, num_seeds: int) -> None:
    """Raises unless all but what the seeds share is of so many."""
    check_record("state", state, LearnerState)
    check_record("state.dataset", state.dataset, Dataset)
    for name in ("size", "cursor"):
        if shape := jnp.shape(getattr(state.dataset, name)):
            raise ValueError(
                f"state.dataset.{name} must be [], which the seeds share (SEED_AXES), "
                f"got the shape {shape}."
            )
    own = state.dataset._replace(size=None, cursor=None)
    _check_seeds("state", state._replace(dataset=own), num_seeds)


def _check_seeds(name: str, tree: Any, num_seeds: int) -> None:
    """Raises unless every leaf begins with an axis of so many seeds.

    The programs of one seed would take the first of several, without a word.
    """
    leaves = cast(list[Any], jax.tree_util.tree_leaves_with_path(tree))
    for path, leaf in leaves:
        shape = jnp.shape(leaf)
        if shape[:1] != (num_seeds,):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must have a first axis of "
                f"{num_seeds} seeds, got the shape {shape}."
            )


def _only(tree: Any) -> Any:
    """Drops the axis of the seeds; what they share has none."""

    def only(x: Array) -> Array:
        return x[0] if x.ndim else x

    return jax.tree.map(only, tree)


def _many(tree: Any) -> Any:

    def many(x: Any) -> Array:
        return jnp.asarray(x)[None]  # it may be a number of Python

    return jax.tree.map(many, tree)


def _as_one_of_many(state: LearnerState) -> LearnerState:
    """Adds the axis of the seeds to all but what they share."""
    shared = {name: getattr(state.dataset, name) for name in ("size", "cursor")}
    state = _many(state)
    return state._replace(dataset=state.dataset._replace(**shared))
