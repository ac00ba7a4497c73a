"""What exploration saves: its form, and the room for transitions that it has."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxpets

from . import user_files
from .build import EXPLORE, Parts, State, build, trial_keys
from .config import Config
from .entries import from_json
from .presets import PRESETS
from .storage import rundir
from .storage.folder import RunFolder


def config_of(run: RunFolder) -> Config:
    """Returns the config that a run was started with.

    Raises:
      CheckpointError: if there is none, or one that no run can have.
    """
    return from_json(run.config(), PRESETS["smoke"], str(run.path / rundir.CONFIG))


def without_files(config: Config, env: str | None, run: Path) -> Config:
    """Returns what a model is to be read with: no file that only a run speaks of.

    What a run sought has no part in what its model predicts.

    Args:
      config: of the run, which may come from a stranger.
      env: the robot that the command line names.
      run: its folder.

    Raises:
      UsageError: if the robot is of a file that it does not name.
    """
    user_files.check_named("--env", env, config.env, run / rundir.CONFIG)
    return dataclasses.replace(config, arm="random", tasks=None)


def template(config: Config, parts: Parts) -> State:
    """Returns what exploration saves, `[S]`, as shapes."""
    init = jax.vmap(parts.learner.init, out_axes=jaxpets.SEED_AXES)
    return jax.eval_shape(init, trial_keys(config, EXPLORE, 0))


def as_saved(config: Config, parts: Parts) -> Callable[[Mapping[str, Any]], State]:
    """Returns what makes `template` of the leaves of a checkpoint, with its room.

    That is less where the run was given more trials later, more where it was given
    fewer.
    """

    def saved(leaves: Mapping[str, Any]) -> State:
        rows = leaves.get("dataset/data/obs")  # a model may be there without its data
        count = rows["shape"][1] // config.trial_length if rows else config.num_trials
        if count == config.num_trials:
            return template(config, parts)
        found = dataclasses.replace(config, num_trials=count)
        return template(found, build(found))

    return saved


def with_room(
    state: State, capacity: int, reward_data: jaxpets.RewardData | None = None
) -> State:
    """Returns a learner `[S]` with room for as many transitions, or for more.

    Args:
      state: a learner.
      capacity: of each seed.
      reward_data: made anew, since it may have a row per transition; None keeps it.
    """
    if state.dataset.data.obs.shape[1] >= capacity:
        return state

    def grown(state: State) -> State:
        dataset = jaxpets.datasets.grow(state.dataset, capacity)
        state = state._replace(dataset=dataset)
        if reward_data is None:
            return state
        reward = reward_data.refresh(state.reward, state.params, dataset)
        return state._replace(reward=reward)

    axes = jaxpets.SEED_AXES
    return jax.vmap(grown, (axes,), axes)(state)


def branched(state: State, num_tasks: int, capacity: int) -> State:
    """Copies the learner `[S]` once per task, `[S, K]`, with room for more data."""
    state = with_room(state, capacity)._replace(reward=())

    def repeat(x: jax.Array) -> jax.Array:
        shared = x.ndim == 0
        return x if shared else jnp.repeat(x[:, None], num_tasks, axis=1)

    return jax.tree.map(repeat, state)


def model_of(state: State) -> State:
    """Returns what planning needs of a learner, with nothing in the other places."""
    return jax.tree.map(lambda _: None, state)._replace(params=state.params)


def data_of(state: State) -> State:
    """Returns the dataset of a learner, with nothing in the other places."""
    return jax.tree.map(lambda _: None, state)._replace(dataset=state.dataset)
