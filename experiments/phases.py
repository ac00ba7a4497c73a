"""The phases of the paper: explore, zero-shot, finetune.

Each is a loop over trials around a few jitted functions. Seeds, tasks and repeated
trials are the leading axes of every array.
"""

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import Guided

from . import acting, cost, exploration, loop, policy, records, robots
from .acting import Actors, Scorer, Tick, Trials
from .build import (
    EXPLORE,
    FINETUNE,
    ZERO_SHOT,
    Learn,
    State,
    build,
    key_per,
    trial_keys,
)
from .config import UNPLANNED, Config
from .engines import say_engines
from .model_file import Source
from .parallel import devices
from .parallel.devices import SEED, TASK, Placement
from .preparation import prepared
from .progress import Progress, Watch
from .refit import refit
from .report import coverage
from .storage import rundir
from .storage.folder import RunFolder


@dataclasses.dataclass(frozen=True)
class _Exploration:
    """Trials of one branch per seed."""

    config: Config
    scorer: Scorer
    placement: Placement
    random: Actors  # at first
    planned: Actors
    learn: Learn

    name: ClassVar[str] = "explore"
    axes: ClassVar[tuple[str, ...]] = (SEED,)

    @property
    def trial_length(self) -> int:
        return self.config.trial_length

    def keys(self, trial: int) -> Array:
        return trial_keys(self.config, EXPLORE, trial)

    def act(self, trial: int, state: State, keys: Array, tick: Tick) -> Trials:
        actors = self.random if trial <= self.config.random_trials else self.planned
        params = jaxpets.PlanParams(state.params, state.reward)
        num_chunks = self.trial_length // self.config.chunk_length
        return acting.run(actors, params, keys, num_chunks, tick)

    def labels(self, trial: int) -> list[dict[str, Any]]:
        config = self.config
        at_first = trial <= config.random_trials
        planner = "random" if at_first else UNPLANNED.get(config.arm, "plan")
        arm = rundir.label(config.arm)
        common = {"phase": "explore", "arm": arm, "planner": planner}
        steps = trial * config.trial_length
        return [
            {**common, "seed": seed, "trial": trial, "steps": steps}
            for seed in config.seeds
        ]


@dataclasses.dataclass(frozen=True)
class _Finetuning:
    """Trials of one branch per seed and task."""

    config: Config
    scorer: Scorer
    placement: Placement
    actors: Actors
    learn: Learn
    tasks: Tasks  # K of the robot's, their params where the branches are
    task_ids: Sequence[int]  # [K]
    explored: int  # trials behind the model

    name: ClassVar[str] = "finetune"
    axes: ClassVar[tuple[str, ...]] = (SEED, TASK)

    @property
    def trial_length(self) -> int:
        return self.config.task_length

    def keys(self, trial: int) -> Array:
        return key_per(self.task_ids, trial_keys(self.config, FINETUNE, trial))

    def act(self, trial: int, state: State, keys: Array, tick: Tick) -> Trials:
        del trial
        params = jaxpets.PlanParams(state.params, self.tasks.params)
        num_chunks = self.trial_length // self.config.chunk_length
        trials = acting.run(self.actors, params, keys[..., None], num_chunks, tick)
        return jax.tree.map(lambda x: x.squeeze(2), trials)

    def labels(self, trial: int) -> list[dict[str, Any]]:
        arm, explored = rundir.label(self.config.arm), self.explored
        common = {"phase": "finetune", "arm": arm, "explored_trials": explored}
        return [
            {**common, "seed": seed, "task": task, "trial": trial}
            for seed in self.config.seeds
            for task in self.tasks.names
        ]


def explore(config: Config, run: RunFolder, watch: Watch) -> None:
    """Phase 1: trials without a reward (section 3.3), from the last checkpoint on."""
    parts = build(config)
    say_engines(run, parts.explored_by, fitter=parts.fitter)
    placement = placed(run, len(config.seeds))
    length, horizon = config.chunk_length, config.planner.horizon
    robot = parts.robot
    phase = _Exploration(
        config=config,
        scorer=acting.scorer(robot),
        placement=placement,
        random=acting.explorers(robot.env, parts.random, 1, length, placement),
        planned=acting.explorers(
            robot.env, parts.explorer, horizon, length, placement, parts.bind
        ),
        learn=loop.over_branches(placement, parts.learner, SEED),
    )
    last, saved = config.num_trials, exploration.as_saved(config, parts)
    if found := run.resume(saved):
        done, state = found
        capacity = last * config.trial_length
        state = exploration.with_room(state, capacity, parts.reward_data)
    else:
        init = jax.vmap(parts.learner.init, out_axes=jaxpets.SEED_AXES)
        done, state = 0, jax.jit(init)(phase.keys(0))
    went_on = loop.run(run, phase, state, 0, done, last, watch)

    def data(leaves: Mapping[str, Any]) -> State:
        return exploration.data_of(saved(leaves))

    coverage.write(run, robot.axes, config.seeds, data, max(done, last), anew=went_on)


def zero_shot(
    config: Config, source: Source, run: RunFolder, step: int, watch: Watch,
    begins: policy.Policy | None = None,
) -> None:  # fmt: skip
    """Phase 2, at first: tasks planned with the explored model, nothing learned.

    The jump-start of Table 1. The model that acts is saved beside its log. Plans begin
    with what a policy would do, if there is one.
    """
    robot = robots.of(config)
    tasks = robots.chosen(config, robot)
    names, count = tasks.names, config.eval_trials
    if run.performed(len(config.seeds) * len(names) * count):
        run.say(f"already complete: {count} of {count} trials.")
        return
    parts = build(config)
    say_engines(run, parts.performed_by, refitter=parts.refitter)
    model = prepared(config, source, run, step, parts, tasks)
    placement = placed(run, len(config.seeds), len(names), config.eval_trials)
    task_params = devices.place(placement, tasks.params, TASK)
    horizon, axes = float(config.task_planner.horizon), P(TASK)
    if parts.critic:
        networks = devices.place(placement, model.reward, SEED, TASK)
        task_params = Guided(task_params, networks)
        horizon = 1 / (1 - config.critic.discount)
        axes = Guided(axes, cast(Any, P(SEED, TASK)))
    if begins:
        task_params = Guided(task_params, devices.place(placement, begins.networks))
        axes = Guided(axes, cast(Any, P()))
    actor = policy.begun(parts, begins) if begins else parts.actor
    actors = acting.evaluators(
        robot, actor, horizon, config.chunk_length, placement,
        jaxpets.PlanParams(P(SEED), axes),
    )  # fmt: skip
    keys = trial_keys(config, ZERO_SHOT, step)
    keys = key_per(robots.places(robot, tasks), keys)
    keys = key_per(range(config.eval_trials), keys)
    params = jaxpets.PlanParams(
        devices.place(placement, model.params, SEED), task_params
    )
    num_chunks = config.task_length // config.chunk_length
    progress = Progress(config.task_length, 0, "zero-shot", watch, run.update)
    progress.compiling(cost.compiling("plan"))
    begin = time.monotonic()
    with progress.interruptible():
        trials = acting.run(actors, params, keys, num_chunks, progress.tick)
    trials = devices.collect(placement, trials, *devices.AXES)
    arm = rundir.label(config.arm)
    common = {"phase": "zero-shot", "arm": arm, "explored_trials": step}
    labels = [
        {**common, "seed": seed, "task": task, "trial": trial + 1}
        for seed in config.seeds
        for task in names
        for trial in range(config.eval_trials)
    ]
    scorer = acting.scorer(robot)
    rows = records.rows(scorer, labels, trials)
    paths = records.trajectories(scorer, trials, config.seeds, names)
    run.save_trajectories(paths)
    run.log(rows)
    run.say(records.summary(rows, names, time.monotonic() - begin))


def finetune(
    config: Config, source: Source, run: RunFolder, step: int, watch: Watch
) -> None:
    """Phase 2, goes on: the loop of PETS with a task's reward, one branch per task.

    Figure 4, right. Model, optimizer and data go on from where exploration ended.
    """
    parts = build(config)
    both = {"fitter": parts.tuner, "refitter": parts.refitter}
    say_engines(run, parts.performed_by, **both)
    robot = parts.robot
    tasks = robots.chosen(config, robot)
    placement = placed(run, len(config.seeds), len(tasks.names))
    phase = _Finetuning(
        config=config,
        scorer=acting.scorer(robot),
        placement=placement,
        actors=acting.evaluators(
            robot, parts.actor, config.task_planner.horizon, config.chunk_length,
            placement, jaxpets.PlanParams(P(SEED, TASK), P(TASK)),
        ),
        learn=loop.over_branches(placement, parts.finetuner, SEED, TASK),
        tasks=tasks._replace(params=devices.place(placement, tasks.params, TASK)),
        task_ids=robots.places(robot, tasks),
        explored=step,
    )  # fmt: skip
    learner = exploration.learned(config, parts)
    state = source.restore_trial(step, learner, part=True)
    if parts.refitter and not run.steps():
        state = refit(config, parts, state, step, run)
    capacity = state.dataset.data.obs.shape[1]
    capacity += config.finetune_trials * config.task_length
    init = exploration.branched(state, len(tasks.names), capacity)
    data = exploration.data_of(jax.eval_shape(lambda: init))
    last = step + config.finetune_trials
    done, state = run.resume(init, step) or (step, init)
    went_on = loop.run(run, phase, state, step, done, last, watch)
    if went_on or not run.has_trajectories():
        if not went_on:
            run.say(f"{run.trajectories} is not whole: made again.")
        # The last checkpoint holds the trial, so that no stop can lose it.
        dataset = run.restore_trial(last, data, part=True).dataset
        rows = slice(int(dataset.size) - config.task_length, int(dataset.size))
        seen = jax.tree.map(lambda x: x[:, :, None, rows], dataset.data)
        seen = records.until_diverged(seen, run.lost_steps(last))
        keys, _ = acting.split_keys(phase.keys(last))
        constants = acting.constants(robot, tasks.params, keys[..., None])
        shown = Trials(seen, jnp.zeros(()), constants)
        paths = records.trajectories(phase.scorer, shown, config.seeds, tasks.names)
        run.save_trajectories(paths)


def placed(run: RunFolder, *counts: int) -> Placement:
    """Spreads branches over hosts and devices, and says what stays idle."""
    placement = devices.spread(*counts)
    if line := devices.idle(placement):
        run.say(line)
    return placement
