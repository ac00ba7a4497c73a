"""Phase 2 in a network: what the planner would do on any task, without a plan.

The planner performs every task; what it sees is data to imagine from. Then, round by
round, it is asked in imagined trials, the policy learns what it said, and acts once per
task, from where the next round imagines. At last the policy performs as the planner
did. What was learned is saved before that, so that a run that was stopped goes on.
"""

import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams, Distiller, Guided

from . import acting, cost, exploration, records, robots
from .acting import Actors, Scorer, Trials
from .build import DISTILL, Parts, State, build, key_per, trial_keys
from .config import Config
from .parallel import devices
from .parallel.devices import AXES, SEED, TASK, Placement
from .phases import placed, say_rollout
from .policy import export, make_distiller
from .progress import Progress, Watch
from .refit import refit
from .storage import rundir
from .storage.folder import RunFolder

_KNOWN = jaxpets.PlanParams(P(SEED), P())  # tasks are shared
_SEEDS = P(SEED)


class _Run(NamedTuple):
    """What is the same in all of a run."""

    config: Config
    step: int  # trials behind the model
    parts: Parts
    tasks: Tasks
    distiller: Distiller
    placement: Placement
    planner: Actors
    policy: Actors
    scorer: Scorer
    progress: Progress
    folder: RunFolder

    def keys(self, turn: int, *more: Sequence[int]) -> Array:
        """Returns the keys of a turn, `[S]` and an axis for each of `more`."""
        keys = trial_keys(self.config, DISTILL, self.step)
        keys = key_per([turn], keys)[..., 0]
        for ids in more:
            keys = key_per(ids, keys)
        return keys


def distill(
    config: Config, source: RunFolder, run: RunFolder, step: int, watch: Watch
) -> None:
    """Distills the planner, and performs tasks with it and with the policy."""
    robot = robots.of(config)
    tasks = robots.chosen(config, robot)
    count = config.eval_trials
    num_rows = 2 * len(config.seeds) * len(tasks.names) * count
    if run.performed(num_rows):
        run.say(f"already complete: {count} of {count} trials.")
        return
    parts = build(config)
    say_rollout(run, parts.performed_by)
    turns = 1 + config.distill.num_rounds
    progress = Progress(turns * config.task_length, 0, "distill", watch)
    placement, horizon = placed(run, len(config.seeds)), config.task_planner.horizon
    distiller = make_distiller(config, parts, tasks)

    def actors(planner: jaxpets.Planner, data: Any) -> Actors:
        return acting.evaluators(
            robot, planner, horizon, config.chunk_length, placement,
            jaxpets.PlanParams(_SEEDS, data),
        )  # fmt: skip

    now = _Run(
        config, step, parts, tasks, distiller, placement,
        planner=actors(parts.actor, P(TASK)),
        policy=actors(distiller.policy, Guided(P(TASK), cast(Any, _SEEDS))),
        scorer=acting.scorer(robot), progress=progress, folder=run,
    )  # fmt: skip
    begin = time.monotonic()
    with progress.interruptible():
        found = run.restore(_template(now))
        state = found[1] if found else _explored(now, source)
        planned = _perform(now, state, 0, count)
        if not found:
            learned = _learned(now, state, planned)
            state = exploration.model_of(state)._replace(reward=learned)
            run.save(step, state)
        acted = _perform(now, state, turns, count)
    export(run, config, parts, state.reward)
    rows = [*_rows(now, "plan", planned), *_rows(now, "policy", acted, count)]
    paths = records.trajectories(now.scorer, acted, config.seeds, tasks.names)
    run.save_trajectories(paths)
    run.log(rows)
    run.say(_summary(rows, tasks.names, time.monotonic() - begin))


def _template(now: _Run) -> State:
    """Returns the model with the networks of its policy, `[S]`, as shapes."""
    explored = exploration.template(now.config, now.parts)
    params = jaxpets.PlanParams(explored.params, now.tasks.params)
    dataset = jax.eval_shape(functools.partial(_empty, now, 1))
    begun = jax.eval_shape(
        acting.over(now.distiller.init, (_KNOWN, _SEEDS, _SEEDS), SEED),
        params, now.keys(0), dataset,
    )  # fmt: skip
    return exploration.model_of(explored)._replace(reward=begun.params)


def _explored(now: _Run, source: RunFolder) -> State:
    """Returns the model, after a refit if one is asked for, and the data behind it."""
    config, parts = now.config, now.parts
    saved = exploration.as_saved(config, parts)

    def form(leaves: Mapping[str, Any]) -> State:
        whole = saved(leaves)
        return whole if "dataset/data/obs" in leaves else exploration.model_of(whole)

    state = source.restore_trial(now.step, form, part=True)
    if parts.refitter:
        state = refit(config, parts, state, now.step, now.folder)
    return state


def _learned(now: _Run, state: State, planned: Trials) -> ActorCriticParams:
    """Returns the networks `[S]` of the policies."""
    settings, count = now.config.distill, len(now.tasks.names)
    begin = time.monotonic()
    place = functools.partial(devices.place, now.placement)
    dataset = place(_room(now, state, planned), SEED)
    params = jaxpets.PlanParams(place(state.params, SEED), now.tasks.params)
    append = _program(now, _append, (_SEEDS, _SEEDS), _SEEDS)
    init = _program(now, now.distiller.init, (_KNOWN, _SEEDS, _SEEDS), _SEEDS)
    learn = _program(
        now, now.distiller.step, (_KNOWN, _SEEDS, _SEEDS, _SEEDS), (_SEEDS, _SEEDS),
        donate_argnums=2,
    )  # fmt: skip
    dataset = append(dataset, place(planned.transitions, SEED))
    learned = init(params, place(now.keys(0), SEED), dataset)
    for turn in range(1, settings.num_rounds + 1):
        keys, _ = acting.split_keys(now.keys(turn))
        learned, metrics = learn(params, place(keys, SEED), learned, dataset)
        metrics = devices.collect(now.placement, jax.block_until_ready(metrics), SEED)
        error, skipped = (
            float(np.mean(x)) for x in (metrics.error, metrics.num_skipped)
        )
        text = f"distill {turn}/{settings.num_rounds}  off the planner by {error:.3f}"
        if skipped:
            text = f"{text}  {skipped:.0f} gradient steps were not finite: left out"
        if turn < settings.num_rounds:
            networks = devices.collect(now.placement, learned.params, SEED)
            acted = _perform(now, state._replace(reward=networks), turn, 1)
            dataset = append(dataset, place(acted.transitions, SEED))
            scored = [row["return"] for row in _rows(now, "policy", acted)]
            means = np.mean(np.reshape(scored, (-1, count)), axis=0)
            named = zip(now.tasks.names, means, strict=True)
            text = "  ".join([text, *(f"{name} {x:.0f}" for name, x in named)])
        now.progress.line(f"{text}  {time.monotonic() - begin:.1f} s")
    seconds = time.monotonic() - begin
    plans = settings.num_rounds * settings.horizon * settings.num_trials
    now.folder.say(f"distilled {plans:,} plans of each seed  {seconds:.1f} s")
    return devices.collect(now.placement, learned.params, SEED)


def _room(now: _Run, state: State, planned: Trials) -> jaxpets.typing.Dataset:
    """Returns the data `[S]` that there are, with room for what will be seen.

    Seeds have sizes of their own here: where physics diverges, a trial is shorter.
    """
    seeds, *trials, length, _ = planned.transitions.obs.shape
    rounds, count = now.config.distill.num_rounds, len(now.tasks.names)
    more = length * (int(np.prod(trials)) + (rounds - 1) * count)
    if not jax.tree.leaves(state.dataset):
        return _empty(now, more)
    capacity = state.dataset.data.obs.shape[1] + more
    dataset = exploration.with_room(state, capacity).dataset
    size, cursor = (jnp.repeat(x, seeds) for x in (dataset.size, dataset.cursor))
    return dataset._replace(size=size, cursor=cursor)


def _empty(now: _Run, capacity: int) -> jaxpets.typing.Dataset:
    """Returns data `[S]` without a row."""
    sizes = (now.parts.model.obs_size, now.parts.model.action_size)
    dataset, seeds = jaxpets.datasets.init(capacity, *sizes), len(now.config.seeds)
    return jax.tree.map(lambda x: jnp.repeat(x[None], seeds, axis=0), dataset)


def _append(
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


def _perform(now: _Run, state: State, turn: int, count: int) -> Trials:
    """Returns trials `[S, K, count]`: of the planner at turn 0, then of the policy."""
    config, place = now.config, functools.partial(devices.place, now.placement)
    actors, data = now.planner, now.tasks.params
    if turn:
        actors, data = now.policy, Guided(data, place(state.reward, SEED))
    keys = now.keys(turn, robots.places(now.parts.robot, now.tasks), range(count))
    params = jaxpets.PlanParams(place(state.params, SEED), data)
    num_chunks = config.task_length // config.chunk_length
    now.progress.compiling(cost.compiling("physics" if turn else "plan"))
    trials = acting.run(actors, params, keys, num_chunks, now.progress.tick)
    return devices.collect(now.placement, trials, *AXES)


def _program(
    now: _Run, function: Any, takes: tuple[Any, ...], gives: Any, **options: Any
) -> Any:
    """Returns a function of one seed, over seeds, jitted."""
    over_seeds = acting.over(function, takes, SEED)
    return jax.jit(devices.split(now.placement, over_seeds, takes, gives), **options)


def _rows(now: _Run, who: str, trials: Trials, first: int = 0) -> list[dict[str, Any]]:
    """Returns the rows of trials `[S, K, R]`, which are numbered after the first."""
    config = now.config
    common = {"phase": "distill", "arm": rundir.label(config.arm), "planner": who}
    labels = [
        {**common, "explored_trials": now.step, "seed": seed, "task": task, "trial": i}
        for seed in config.seeds
        for task in now.tasks.names
        for i in range(first + 1, first + 1 + trials.values.shape[2])
    ]
    return records.rows(now.scorer, labels, trials)


def _summary(rows: list[dict[str, Any]], names: tuple[str, ...], seconds: float) -> str:
    """Returns the lines that end the phase: of every task, what share is kept."""
    lines = [f"distilled returns ({seconds:.0f} s):"]
    for name in names:
        of_task = [row for row in rows if row["task"] == name]
        planner, policy = (
            float(np.mean([x["return"] for x in of_task if x["planner"] == who]))
            for who in ("plan", "policy")
        )
        share = f"{policy / planner:.0%}" if planner > 0 else "-"
        lines.append(
            f"  {name:12} policy {policy:8.0f}  planner {planner:8.0f}  {share}"
        )
    return "\n".join(lines)
