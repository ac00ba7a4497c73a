"""The phases of the paper: explore, zero-shot, finetune.

Each is a loop over trials around a few jitted functions. Seeds, tasks and repeated
trials are the leading axes of every array.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from experiments import acting, checkpoint, records, rundir
from experiments.acting import Tick, Trials
from experiments.build import (
    EXPLORE,
    FINETUNE,
    LEARNER_AXES,
    ZERO_SHOT,
    Learn,
    Parts,
    State,
    build,
    over_seeds,
    trial_keys,
)
from experiments.config import Config
from experiments.progress import Progress
from jaxpets.envs import half_cheetah

Say = Callable[[str], None]


class Loop(NamedTuple):
    """What explore and finetune do not share."""

    what: str
    trial_length: int
    keys: Callable[[int], Array]  # trial -> keys of the branches
    act: Callable[[int, State, Array, Tick], Trials]
    learn: Learn
    labels: Callable[[int], list[dict[str, Any]]]  # of the branches


def explore(config: Config, folder: Path, say: Say) -> None:
    """Phase 1: trials without a reward (section 3.3), from the last checkpoint on."""
    parts = build(config)
    random = acting.explorers(parts.env, parts.random, 1, config.chunk_length)
    planned = acting.explorers(
        parts.env, parts.explorer, config.planner.horizon, config.chunk_length
    )

    def act(trial: int, state: State, keys: Array, tick: Tick) -> Trials:
        actors = random if trial <= config.random_trials else planned
        params = jaxpets.PlanParams(state.params, state.reward)
        return acting.run(
            actors, params, keys, config.trial_length // config.chunk_length, tick
        )

    def labels(trial: int) -> list[dict[str, Any]]:
        planner = "random" if trial <= config.random_trials else "plan"
        common = {"phase": "explore", "arm": config.arm, "planner": planner}
        steps = trial * config.trial_length
        return [
            {**common, "seed": seed, "trial": trial, "steps": steps}
            for seed in config.seeds
        ]

    learn = jax.jit(
        over_seeds(parts.learner.learn, len(config.seeds)), donate_argnums=1
    )
    keys = lambda trial: trial_keys(config, EXPLORE, trial)  # noqa: E731
    init = jax.jit(jax.vmap(parts.learner.init, out_axes=LEARNER_AXES))(keys(0))
    loop = Loop("explore", config.trial_length, keys, act, learn, labels)
    _run(config, folder, loop, init, 0, config.num_trials, say)


def zero_shot(config: Config, source: Path, folder: Path, step: int, say: Say) -> None:
    """Phase 2, first attempt: tasks planned with the explored model, nothing learned.

    The jump-start of Table 1.
    """
    log = folder / "metrics.jsonl"
    if rundir.log_size(log):  # written once, at the end
        say(f"already complete: {config.eval_trials} of {config.eval_trials} trials.")
        return
    parts = build(config)
    state = _explored(config, source, step, parts, say)
    names, weights = _tasks(config)
    actors = acting.performers(
        parts.env, parts.actor, config.task_planner.horizon, config.chunk_length,
        shared_model=True,
    )  # fmt: skip
    keys = _fan(trial_keys(config, ZERO_SHOT, step), _task_ids(names))
    keys = _fan(keys, range(config.eval_trials))
    params = jaxpets.PlanParams(state.params, weights)
    num_chunks = config.task_length // config.chunk_length
    progress = Progress(config.task_length, 0, "zero-shot")
    begin = time.monotonic()
    with progress.interruptible():
        trials = acting.run(actors, params, keys, num_chunks, progress.tick)
    records.check_finite(trials, step)
    common = {"phase": "zero-shot", "arm": config.arm, "explored_trials": step}
    labels = [
        {**common, "seed": seed, "task": task, "trial": trial + 1}
        for seed in config.seeds
        for task in names
        for trial in range(config.eval_trials)
    ]
    rows = records.rows(labels, trials)
    records.save_paths(folder / "trajectories.npz", trials, config.seeds, names)
    rundir.append_rows(log, rows)
    say(_summary(rows, names, f"{time.monotonic() - begin:.0f} s"))


def finetune(config: Config, source: Path, folder: Path, step: int, say: Say) -> None:
    """Phase 2, goes on: the loop of PETS with a task's reward, one branch per task.

    Figure 4, right. Model, optimizer and data go on from where exploration ended.
    """
    parts = build(config)
    names, weights = _tasks(config)
    actors = acting.performers(
        parts.env, parts.actor, config.task_planner.horizon, config.chunk_length,
        shared_model=False,
    )  # fmt: skip

    def act(trial: int, state: State, keys: Array, tick: Tick) -> Trials:
        del trial
        params = jaxpets.PlanParams(state.params, weights)
        keys = keys[..., None]
        num_chunks = config.task_length // config.chunk_length
        trials = acting.run(actors, params, keys, num_chunks, tick)
        return jax.tree.map(lambda x: x[:, :, 0], trials)

    def labels(trial: int) -> list[dict[str, Any]]:
        common = {"phase": "finetune", "arm": config.arm, "explored_trials": step}
        return [
            {**common, "seed": seed, "task": task, "trial": trial}
            for seed in config.seeds
            for task in names
        ]

    learn = over_seeds(parts.finetuner.learn, len(names))
    learn = over_seeds(learn, len(config.seeds))
    learn = jax.jit(learn, donate_argnums=1)
    keys = lambda trial: _fan(trial_keys(config, FINETUNE, trial), _task_ids(names))  # noqa: E731
    explored = _explored(config, source, step, parts, say)
    capacity = explored.dataset.data.obs.shape[1]
    capacity += config.finetune_trials * config.task_length
    init = _branch(explored, len(names), capacity)
    loop = Loop("finetune", config.task_length, keys, act, learn, labels)
    last = step + config.finetune_trials
    trials = _run(config, folder, loop, init, step, last, say)
    if trials is not None:
        trials = jax.tree.map(lambda x: x[:, :, None], trials)
        records.save_paths(folder / "trajectories.npz", trials, config.seeds, names)


def _run(
    config: Config, folder: Path, loop: Loop, init: State, first: int, last: int,
    say: Say,
) -> Trials | None:  # fmt: skip
    """Runs trials `first + 1` to `last`, or what is left of them; saves after each."""
    checkpoints, log = folder / "checkpoints", folder / "metrics.jsonl"
    found = checkpoint.restore(checkpoints, init, warn=_warning(say))
    done, state, meta = found or (first, init, {"log": 0})
    rundir.cut_log(log, meta["log"])
    if done >= last:
        say(f"already complete: {last - first} of {last - first} trials.")
        return None
    steps = loop.trial_length
    progress = Progress((last - first) * steps, (done - first) * steps, loop.what)
    trials = None
    with progress.interruptible():
        for trial in range(done + 1, last + 1):
            begin = time.monotonic()
            act_keys, fit_keys = acting.split_keys(loop.keys(trial))
            trials = loop.act(trial, state, act_keys, progress.tick)
            records.check_finite(trials, trial)
            acted = time.monotonic()
            state, fit = loop.learn(fit_keys, state, trials.transitions)
            jax.block_until_ready(state)
            seconds = {"act": acted - begin, "fit": time.monotonic() - acted}
            rows = records.rows(loop.labels(trial), trials, fit, state.params)
            rundir.append_rows(log, [{**row, "seconds": seconds} for row in rows])
            checkpoint.save(
                checkpoints, trial, state, {"log": rundir.log_size(log)},
                milestones=config.milestones, finite=(state.params, state.fit),
            )  # fmt: skip
            text = f"{loop.what} {trial}/{last}  {records.describe(rows)}"
            progress.line(f"{text}  {sum(seconds.values()):.1f} s")
    return trials


def _explored(config: Config, source: Path, step: int, parts: Parts, say: Say) -> State:
    """Restores the learner `[S]` of an exploration run after trial `step`."""
    keys = trial_keys(config, EXPLORE, 0)
    init = jax.vmap(parts.learner.init, out_axes=LEARNER_AXES)
    template = jax.eval_shape(init, keys)
    found = checkpoint.restore(
        source / "checkpoints", template, step=step, warn=_warning(say)
    )
    assert found is not None
    return found[1]


def _warning(say: Say) -> Say:
    return lambda line: say(f"warning: {line}")


def _branch(state: State, num_tasks: int, capacity: int) -> State:
    """Copies the learner `[S]` once per task, `[S, K]`, with room for more data."""
    axes = LEARNER_AXES.dataset
    grown = jax.vmap(lambda data: jaxpets.grow(data, capacity), (axes,), axes)
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
