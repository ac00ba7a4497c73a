"""Phase 2 in a network: one policy of all tasks, which acts without a plan.

The planner performs every task; what it sees is data to imagine from. The policy first
learns from imagination alone. Then, in rounds if there are any, the planner is asked in
imagined trials, where its search begins with what the policy would do; the policy
learns what it said, and acts once per task, from where the next round imagines. At last
the policy performs as the planner did, and so does the planner that begins with it.
What was learned is saved before that, so that a run that was stopped goes on.
"""

import functools
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams, Distiller, Guided

from . import (
    acting,
    cost,
    exploration,
    imagined_policy,
    kept_networks,
    records,
    robots,
    seen,
)
from .acting import Actors, Scorer, Trials
from .build import DISTILL, Parts, State, build, key_per, trial_keys
from .config import Config
from .engines import say_engines
from .model_file import Source
from .parallel import devices
from .parallel.devices import AXES, SEED, TASK, Placement
from .phases import placed
from .policy import export, make_distiller, policy_file
from .progress import Progress, Watch
from .refit import refitted
from .storage import rundir
from .storage.folder import RunFolder

_KNOWN = jaxpets.PlanParams(P(SEED), P())  # tasks are shared
_SEEDS = P(SEED)
# What the log calls who acts: the planner, the policy, and the planner whose search
# begins with what the policy would do.
_PLANNER, _POLICY, _BOTH = WHO = ("plan", "policy", "both")


class _Run(NamedTuple):
    """What is the same in all of a run."""

    config: Config
    step: int  # trials behind the model
    parts: Parts
    tasks: Tasks
    distiller: Distiller
    placement: Placement
    actors: Mapping[str, Actors]  # by what the log calls them
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
    config: Config, source: Source, run: RunFolder, step: int, watch: Watch
) -> None:
    """Distills the planner, and performs tasks with it and with the policy."""
    robot = robots.of(config)
    tasks = robots.chosen(config, robot)
    count = config.eval_trials
    num_rows = 3 * len(config.seeds) * len(tasks.names) * count
    if run.performed(num_rows, *map(policy_file, config.seeds)):
        run.say(f"already complete: {count} of {count} trials.")
        return
    parts = build(config)
    say_engines(run, parts.performed_by, refitter=parts.refitter)
    turns = max(config.distill.num_rounds, 1)
    learned_before = bool(run.steps())
    length = (3 if learned_before else turns + 2) * config.task_length
    progress = Progress(length, 0, "distill", watch, run.update)
    placement, horizon = placed(run, len(config.seeds)), config.task_planner.horizon
    distiller = make_distiller(config, parts, tasks)

    guided = Guided(P(TASK), cast(Any, _SEEDS))

    def actors(planner: jaxpets.Planner, data: Any) -> Actors:
        return acting.evaluators(
            robot, planner, horizon, config.chunk_length, placement,
            jaxpets.PlanParams(_SEEDS, data),
        )  # fmt: skip

    now = _Run(
        config, step, parts, tasks, distiller, placement,
        actors={
            _PLANNER: actors(parts.actor, P(TASK)),
            _POLICY: actors(distiller.policy, guided),
            _BOTH: actors(distiller.planner, guided),
        },
        scorer=acting.scorer(robot), progress=progress, folder=run,
    )  # fmt: skip
    begin = time.monotonic()
    with progress.interruptible():
        found = kept_networks.restored(run, _template(now))
        state = found or _explored(now, source)
        planned = _perform(now, _PLANNER, state, 0, count)
        progress.line(_returns(now, "the planner", _rows(now, _PLANNER, planned)))
        if not found:
            learned = _learned(now, state, planned)
            state = exploration.model_of(state)._replace(reward=learned)
            run.save(step, state)
        acted = {
            _PLANNER: planned,
            _POLICY: _perform(now, _POLICY, state, turns, count),
            _BOTH: _perform(now, _BOTH, state, turns + 1, count),
        }
    export(run, config, parts, tasks, state.reward, source, step)
    rows = [
        row
        for i, who in enumerate(WHO)
        for row in _rows(now, who, acted[who], i * count)
    ]
    paths = records.trajectories(now.scorer, acted[_POLICY], config.seeds, tasks.names)
    run.save_trajectories(paths)
    run.log(rows)
    run.say(_summary(rows, tasks.names, time.monotonic() - begin))


def _template(now: _Run) -> State:
    """Returns the model with the networks of its policy, `[S]`, as shapes."""
    explored = exploration.template(now.config, now.parts)
    params = jaxpets.PlanParams(explored.params, now.tasks.params)
    seeds = len(now.config.seeds)
    dataset = jax.eval_shape(functools.partial(seen.empty, now.parts, seeds, 1))
    begun = jax.eval_shape(
        acting.over(now.distiller.init, (_KNOWN, _SEEDS, _SEEDS), SEED),
        params, now.keys(0), dataset,
    )  # fmt: skip
    return exploration.model_of(explored)._replace(reward=begun.params)


def _explored(now: _Run, source: Source) -> State:
    """Returns the model, after a refit if one is asked for, and the data behind it."""
    config, parts = now.config, now.parts
    saved = exploration.learned(config, parts)

    def form(leaves: Mapping[str, Any]) -> State:
        whole = saved(leaves)
        return whole if "dataset/data/obs" in leaves else exploration.model_of(whole)

    state = source.restore_trial(now.step, form, part=True)
    if parts.refitter:
        state = refitted(config, parts, state, source, now.step, now.folder)
    return state


def _learned(now: _Run, state: State, planned: Trials) -> ActorCriticParams:
    """Returns the networks `[S]` of the policies."""
    settings = now.config.distill
    place = functools.partial(devices.place, now.placement)
    seeds, *trials, length, _ = planned.transitions.obs.shape
    more = max(settings.num_rounds - 1, 0) * len(now.tasks.names)
    count = int(np.prod(trials)) + more
    dataset = place(seen.room(now.parts, state, seeds, count * length), SEED)
    params = jaxpets.PlanParams(place(state.params, SEED), now.tasks.params)
    append = _program(now, seen.append, (_SEEDS, _SEEDS), _SEEDS)
    dataset = append(dataset, place(planned.transitions, SEED))
    # With the keys of places that no task has: those of tasks are for trials.
    apart = [len(now.parts.robot.tasks.names)]
    own = None
    if settings.critic.num_updates:
        keys = place(now.keys(0, [apart[0] + 1])[..., 0], SEED)
        own = imagined_policy.learned(
            now.config, now.parts, now.tasks, now.placement, params, keys, dataset,
            now.folder,
        )  # fmt: skip
        if not settings.num_rounds:
            return own
    begin = time.monotonic()
    init = _program(now, now.distiller.init, (_KNOWN, _SEEDS, _SEEDS), _SEEDS)
    learn = _program(
        now, now.distiller.step, (_KNOWN, _SEEDS, _SEEDS, _SEEDS), (_SEEDS, _SEEDS),
        donate_argnums=2,
    )  # fmt: skip
    learned = init(params, place(now.keys(0, apart)[..., 0], SEED), dataset)
    if own is not None:  # without its critics: the planner's values are others
        own = place(own, SEED)
        own = learned.params._replace(actor=own.actor, mean=own.mean, std=own.std)
        learned = learned._replace(params=own)
    for turn in range(1, settings.num_rounds + 1):
        keys = now.keys(turn, apart)[..., 0]
        learned, metrics = learn(params, place(keys, SEED), learned, dataset)
        metrics = devices.collect(now.placement, jax.block_until_ready(metrics), SEED)
        error, skipped = np.mean(metrics.error), np.sum(metrics.num_skipped)
        text = f"distill {turn}/{settings.num_rounds}  off the planner by {error:.3f}"
        if skipped:
            text = f"{text}  {skipped:,} gradient steps were not finite: left out"
        if turn < settings.num_rounds:
            networks = devices.collect(now.placement, learned.params, SEED)
            state = state._replace(reward=networks)
            acted = _perform(now, _POLICY, state, turn, 1)
            dataset = append(dataset, place(acted.transitions, SEED))
            text = _returns(now, text, _rows(now, _POLICY, acted))
        now.progress.line(f"{text}  {time.monotonic() - begin:.1f} s")
    seconds = time.monotonic() - begin
    plans = settings.num_rounds * settings.horizon * settings.num_trials
    now.folder.say(f"distilled {plans:,} plans of each seed  {seconds:.1f} s")
    return devices.collect(now.placement, learned.params, SEED)


def _perform(now: _Run, who: str, state: State, turn: int, count: int) -> Trials:
    """Returns trials `[S, K, count]` of who acts, with the keys of a turn."""
    config, place = now.config, functools.partial(devices.place, now.placement)
    data = now.tasks.params
    if who != _PLANNER:
        data = Guided(data, place(state.reward, SEED))
    keys = now.keys(turn, robots.places(now.parts.robot, now.tasks), range(count))
    params = jaxpets.PlanParams(place(state.params, SEED), data)
    num_chunks = config.task_length // config.chunk_length
    now.progress.compiling(cost.compiling("physics" if who == _POLICY else "plan"))
    trials = acting.run(now.actors[who], params, keys, num_chunks, now.progress.tick)
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


def _returns(now: _Run, text: str, rows: list[dict[str, Any]]) -> str:
    """Returns the text with the mean return of every task behind it."""
    means = _means(rows, now.tasks.names)
    return "  ".join([text, *(f"{name} {means[name]:.0f}" for name in means)])


def _means(rows: list[dict[str, Any]], names: Sequence[str]) -> dict[str, float]:
    return {
        name: float(np.mean([x["return"] for x in rows if x["task"] == name]))
        for name in names
    }


def _summary(rows: list[dict[str, Any]], names: Sequence[str], seconds: float) -> str:
    """Returns the lines that end the phase: of every task, what share is kept."""
    means = [_means([x for x in rows if x["planner"] == who], names) for who in WHO]
    lines = [f"distilled returns ({seconds:.0f} s):"]
    for name in names:
        planner, *others = (found[name] for found in means)
        shown = [f"{WHO[0]} {planner:6.0f}"]
        for who, mean in zip(WHO[1:], others, strict=True):
            share = f" ({mean / planner:.0%})" if mean >= 0 < planner else ""
            shown.append(f"{who} {mean:6.0f}{share}")
        lines.append(f"  {name:11} {'  '.join(shown)}")
    also = [*records.diverged(rows), *records.not_finite(rows, names)]
    lines += [f"  {line}" for line in also]
    return "\n".join(lines)
