"""What exploration saves: its form, and the room for transitions that it has."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

import jaxpets

from . import robots, user_files
from .build import EXPLORE, Parts, State, build, trial_keys
from .config import Config
from .entries import from_json, to_json
from .errors import UsageError
from .presets import PRESETS
from .storage import identity, rundir
from .storage.folder import RunFolder
from .validate import require


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
      UsageError: if the robot is of a file that it does not name, or another one.
      CheckpointError: if the file has become that of another robot.
    """
    own = user_files.named("--env", env, config.env, run / rundir.CONFIG)
    valid = f"{config.env}, the robot of {run}"
    require(env in (None, own), "--env", env, valid)
    config = dataclasses.replace(config, env=own, arm="random", tasks=None)
    if user_files.is_file(own):  # which may have been edited since
        identity.check_robot(run, to_json(config), robots.entries(config))
    return config


class Explored(NamedTuple):
    """The model of one seed of a run, as it was last saved."""

    config: Config
    parts: Parts
    seed: int
    trial: int
    params: jaxpets.EnsembleParams


def explored(run: Path, *, seed: int | None, env: str | None) -> Explored:
    """Returns the model of a run.

    Args:
      run: its folder.
      seed: which of the run's; None for the first.
      env: the robot, which must be said if it is of a file.

    Raises:
      RunError: if the run has no checkpoint or not that seed, or its robot is of a
        file that nobody named.
    """
    folder = RunFolder(run)
    config = config_of(folder)
    seed = config.seeds[0] if seed is None else seed
    if seed not in config.seeds:
        valid = ", ".join(map(str, config.seeds))
        raise UsageError(f"--seed {seed} is not valid; it must be one of {valid}.")
    parts = build(without_files(config, env, run))
    found = folder.restore(model_of(template(config, parts)), part=True)
    if found is None:
        raise UsageError(f"{run} has no checkpoint.")
    trial, state = found
    i = config.seeds.index(seed)
    params = jax.tree.map(lambda x: x[i], state.params)
    return Explored(config, parts, seed, trial, params)


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


def learned(config: Config, parts: Parts) -> Callable[[Mapping[str, Any]], State]:
    """Returns what `as_saved` does, without the reward data: a part of a checkpoint.

    They are what exploration sought, which may be one of tasks that are not those of
    phase 2.
    """
    saved = as_saved(config, parts)
    return lambda leaves: saved(leaves)._replace(reward=())


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


def data_template(leaves: Mapping[str, Any]) -> Any:
    """Returns the form of the dataset `[S]` of a checkpoint, of what its leaves are.

    With it the data are read without building what learns.
    """

    def leaf(name: str) -> Any:
        found = leaves[f"dataset/{name}"]
        return jax.ShapeDtypeStruct(tuple(found["shape"]), found["dtype"])

    fields = jaxpets.Transition._fields
    rows = jaxpets.Transition(*(leaf(f"data/{name}") for name in fields))
    dataset = jaxpets.typing.Dataset(rows, leaf("size"), leaf("cursor"))
    nothing: Any = None
    return jaxpets.typing.LearnerState(nothing, nothing, dataset, nothing)
