"""The phases of the paper: explore, zero-shot, finetune.

Each is a loop over trials around a few jitted functions. Seeds, tasks and repeated
trials are the leading axes of every array.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from experiments import acting, loop, records
from experiments.acting import Tick, Trials
from experiments.build import (
    EXPLORE,
    FINETUNE,
    ZERO_SHOT,
    Parts,
    State,
    build,
    trial_keys,
)
from experiments.config import Config
from experiments.loop import Loop, Say
from experiments.parallel import devices, distributed
from experiments.parallel.devices import SEED, TASK, Spread
from experiments.progress import Progress
from experiments.refit import refit
from experiments.report import coverage
from experiments.storage import checkpoint, rundir
from jaxpets.envs import half_cheetah


def explore(config: Config, folder: Path, say: Say) -> None:
    """Phase 1: trials without a reward (section 3.3), from the last checkpoint on."""
    parts = build(config)
    spread = _spread(say, len(config.seeds))
    random = acting.explorers(parts.env, parts.random, 1, config.chunk_length, spread)
    planned = acting.explorers(
        parts.env, parts.explorer, config.planner.horizon, config.chunk_length, spread
    )

    def act(trial: int, state: State, keys: Array, tick: Tick) -> Trials:
        actors = random if trial <= config.random_trials else planned
        params = jaxpets.PlanParams(state.params, state.reward)
        return acting.run(
            actors, params, keys, config.trial_length // config.chunk_length, tick
        )

    def labels(trial: int) -> list[dict[str, Any]]:
        random = trial <= config.random_trials or config.arm == "random"
        planner = "random" if random else "plan"
        common = {"phase": "explore", "arm": config.arm, "planner": planner}
        steps = trial * config.trial_length
        return [
            {**common, "seed": seed, "trial": trial, "steps": steps}
            for seed in config.seeds
        ]

    learn = loop.learner(spread, parts.learner.learn, SEED)
    keys = lambda trial: trial_keys(config, EXPLORE, trial)  # noqa: E731
    init = jax.jit(jax.vmap(parts.learner.init, out_axes=jaxpets.SEED_AXES))(keys(0))
    own = Loop(
        "explore", config.trial_length, spread, (SEED,), keys, act, learn, labels
    )
    trials = loop.run(config, folder, own, init, 0, config.num_trials, say)
    data = data_of(explored_template(config, parts))
    last, anew = config.num_trials, trials is not None
    distributed.on_first(
        lambda: coverage.write(folder, config.seeds, data, last, anew=anew, warn=say)
    )


def zero_shot(config: Config, source: Path, folder: Path, step: int, say: Say) -> None:
    """Phase 2, first attempt: tasks planned with the explored model, nothing learned.

    The jump-start of Table 1. The model that performs is saved beside its log.
    """
    log = folder / "metrics.jsonl"
    if distributed.on_first(lambda: rundir.log_size(log)):  # written once, at the end
        say(f"already complete: {config.eval_trials} of {config.eval_trials} trials.")
        return
    parts = build(config)
    model = _performing(config, source, folder, step, parts, say)
    names, weights = _tasks(config)
    spread = _spread(say, len(config.seeds), len(names), config.eval_trials)
    actors = acting.performers(
        parts.env, parts.actor, config.task_planner.horizon, config.chunk_length,
        spread, shared_model=True,
    )  # fmt: skip
    keys = _fan(trial_keys(config, ZERO_SHOT, step), _task_ids(names))
    keys = _fan(keys, range(config.eval_trials))
    params = jaxpets.PlanParams(
        devices.place(spread, model.params, SEED), devices.place(spread, weights, TASK)
    )
    num_chunks = config.task_length // config.chunk_length
    progress = Progress(config.task_length, 0, "zero-shot")
    begin = time.monotonic()
    with progress.interruptible():
        trials = acting.run(actors, params, keys, num_chunks, progress.tick)
    trials = devices.collect(spread, trials, *devices.AXES)
    records.check_finite(trials, step)
    common = {"phase": "zero-shot", "arm": config.arm, "explored_trials": step}
    labels = [
        {**common, "seed": seed, "task": task, "trial": trial + 1}
        for seed in config.seeds
        for task in names
        for trial in range(config.eval_trials)
    ]
    rows = records.rows(labels, trials)
    paths = folder / "trajectories.npz"
    distributed.on_first(lambda: records.save_paths(paths, trials, config.seeds, names))
    distributed.on_first(lambda: rundir.append_rows(log, rows))
    say(_summary(rows, names, f"{time.monotonic() - begin:.0f} s"))


def finetune(config: Config, source: Path, folder: Path, step: int, say: Say) -> None:
    """Phase 2, goes on: the loop of PETS with a task's reward, one branch per task.

    Figure 4, right. Model, optimizer and data go on from where exploration ended.
    """
    parts = build(config)
    names, weights = _tasks(config)
    spread = _spread(say, len(config.seeds), len(names))
    weights = devices.place(spread, weights, TASK)
    actors = acting.performers(
        parts.env, parts.actor, config.task_planner.horizon, config.chunk_length,
        spread, shared_model=False,
    )  # fmt: skip

    def act(trial: int, state: State, keys: Array, tick: Tick) -> Trials:
        del trial
        params = jaxpets.PlanParams(state.params, weights)
        keys = keys[..., None]
        num_chunks = config.task_length // config.chunk_length
        trials = acting.run(actors, params, keys, num_chunks, tick)
        return jax.tree.map(lambda x: x.squeeze(2), trials)

    def labels(trial: int) -> list[dict[str, Any]]:
        common = {"phase": "finetune", "arm": config.arm, "explored_trials": step}
        return [
            {**common, "seed": seed, "task": task, "trial": trial}
            for seed in config.seeds
            for task in names
        ]

    learn = loop.learner(spread, parts.finetuner.learn, SEED, TASK)
    keys = lambda trial: _fan(trial_keys(config, FINETUNE, trial), _task_ids(names))  # noqa: E731
    explored = _explored(config, source, step, parts, say)
    begun = distributed.on_first(lambda: bool(checkpoint.steps(folder / "checkpoints")))
    if parts.refitter and not begun:
        explored = refit(config, parts.refitter, explored, step, say)
    capacity = explored.dataset.data.obs.shape[1]
    capacity += config.finetune_trials * config.task_length
    init = _branch(explored, len(names), capacity)
    axes = (SEED, TASK)
    own = Loop("finetune", config.task_length, spread, axes, keys, act, learn, labels)
    last = step + config.finetune_trials
    trials = loop.run(config, folder, own, init, step, last, say)
    if trials is not None:
        trials = jax.tree.map(lambda x: x[:, :, None], trials)
        paths = folder / "trajectories.npz"
        distributed.on_first(
            lambda: records.save_paths(paths, trials, config.seeds, names)
        )


def _performing(
    config: Config, source: Path, folder: Path, step: int, parts: Parts, say: Say
) -> State:
    """Returns the model `[S]` to perform with, from a run that was stopped or anew."""
    checkpoints = folder / "checkpoints"
    template = model_of(explored_template(config, parts))
    if found := loop.restore(checkpoints, template, say):
        return found[1]
    fitter = parts.refitter
    state = _explored(config, source, step, parts, say, only_model=fitter is None)
    if fitter:
        state = refit(config, fitter, state, step, say)
    model = model_of(state)
    distributed.on_first(
        lambda: checkpoint.save(checkpoints, step, model, {}, finite=model)
    )
    return model


def _spread(say: Say, *counts: int) -> Spread:
    """Spreads branches over hosts and devices, and says what stays idle."""
    spread = devices.spread(*counts)
    if line := devices.idle(spread):
        say(line)
    return spread


def _explored(
    config: Config, source: Path, step: int, parts: Parts, say: Say, *,
    only_model: bool = False,
) -> State:  # fmt: skip
    """Restores the learner `[S]` of an exploration run after trial `step`.

    With `only_model` all but the model may be missing there, and is here.
    """
    template = explored_template(config, parts)
    if only_model:
        template = model_of(template)
    found = loop.restore(source / "checkpoints", template, say, step, part=only_model)
    assert found is not None
    return found[1]


def explored_template(config: Config, parts: Parts) -> State:
    """Returns what exploration saves, `[S]`, as shapes."""
    init = jax.vmap(parts.learner.init, out_axes=jaxpets.SEED_AXES)
    return jax.eval_shape(init, trial_keys(config, EXPLORE, 0))


def model_of(state: State) -> State:
    """Returns what planning needs of a learner, with nothing in the other places."""
    return jax.tree.map(lambda _: None, state)._replace(params=state.params)


def data_of(state: State) -> State:
    """Returns the dataset of a learner, with nothing in the other places."""
    return jax.tree.map(lambda _: None, state)._replace(dataset=state.dataset)


def _branch(state: State, num_tasks: int, capacity: int) -> State:
    """Copies the learner `[S]` once per task, `[S, K]`, with room for more data."""
    axes = jaxpets.SEED_AXES.dataset
    grown = jax.vmap(lambda data: jaxpets.datasets.grow(data, capacity), (axes,), axes)
    state = state._replace(dataset=grown(state.dataset), reward=())

    def repeat(x: Array) -> Array:
        shared = x.ndim == 0
        return x if shared else jnp.repeat(x[:, None], num_tasks, axis=1)

    return jax.tree.map(repeat, state)


def _tasks(config: Config) -> tuple[Sequence[str], half_cheetah.TaskWeights]:
    """Returns the names of the tasks and their weights `[K]`."""
    every = config.task == "all"
    names = [*half_cheetah.TASK_NAMES] if every else [str(config.task)]
    ids = jnp.asarray(_task_ids(names))
    return names, jax.tree.map(lambda x: x[ids], half_cheetah.tasks())


def _task_ids(names: Sequence[str]) -> list[int]:
    return [half_cheetah.TASK_NAMES.index(name) for name in names]


def _fan(keys: Array, ids: Sequence[int]) -> Array:
    """Derives keys `[..., K]` from keys `[...]`; a task has the same key in any set."""
    data = jnp.asarray(list(ids), jnp.uint32)
    fan = jax.vmap(jax.random.fold_in, (None, 0))
    for _ in keys.shape:
        fan = jax.vmap(fan, (0, None))
    return fan(keys, data)


def _summary(rows: list[dict[str, Any]], names: Sequence[str], time: str) -> str:
    lines = [f"zero-shot returns ({time}):"]
    for name in names:
        own = [row["return"] for row in rows if row["task"] == name]
        each = " ".join(f"{value:.0f}" for value in own)
        lines.append(f"  {name:<11}{sum(own) / len(own):8.0f}   trials: {each}")
    return "\n".join(lines)
