"""What comes between exploration and zero-shot: a refit, and a critic of every task.

The reward of a task is first read here. What is learned is saved with the model that
performs, so that a run that was stopped goes on.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams

from . import acting, critic, exploration, robots
from .build import CRITIC, Parts, State, key_per, trial_keys
from .config import Config
from .model_file import Source
from .parallel import devices
from .parallel.devices import SEED, TASK
from .refit import refitted
from .storage.folder import RunFolder

# Which axes seeds and tasks have: of PlanParams, of data, and of all else.
_KNOWN = jaxpets.PlanParams(P(SEED), P(TASK))
# The size of the data is one number, for all seeds.
_DATA = jaxpets.datasets.AXES._replace(data=P(SEED), size=P(), cursor=P())
_EVERY = P(SEED, TASK)


def prepared(
    config: Config, source: Source, run: RunFolder, step: int, parts: Parts,
    tasks: Tasks,
) -> State:  # fmt: skip
    """Returns the model `[S]` to plan tasks with, from a stopped run or made anew.

    Its reward data are the networks `[S, K]` of a critic, where there is one.

    Args:
      config: of a zero-shot.
      source: the run that explored.
      run: the run that performs.
      step: trials behind the model; keys depend on it.
      parts: made with these numbers.
      tasks: K of the robot's.
    """
    form = template(config, parts, tasks)
    if found := run.restore(form):
        return found[1]
    if parts.refitter or parts.critic:
        learner = exploration.learned(config, parts)
        state = source.restore_trial(step, learner, part=True)
        if parts.refitter:
            state = refitted(config, parts, state, source, step, run)
        model = exploration.model_of(state)
        if parts.critic:
            networks = _learned(config, parts, tasks, state, step, run)
            model = model._replace(reward=networks)
    else:  # all but the model may be missing there
        model = source.restore_trial(step, form, part=True)
    run.save(step, model)
    return model


def template(config: Config, parts: Parts, tasks: Tasks) -> State:
    """Returns what `prepared` returns, as shapes."""
    explored = exploration.template(config, parts)
    model = exploration.model_of(explored)
    if parts.critic is None:
        return model
    begun = jax.eval_shape(
        _mapped(parts.critic.init, (_KNOWN, _EVERY, _DATA)),
        jaxpets.PlanParams(explored.params, tasks.params),
        _keys(config, parts, tasks, 0),
        explored.dataset,
    )
    return model._replace(reward=begun.params)


def _learned(
    config: Config, parts: Parts, tasks: Tasks, state: State, step: int, run: RunFolder
) -> ActorCriticParams:
    """Returns the networks `[S, K]` of every seed and task."""
    assert parts.critic is not None
    placement = devices.spread(len(config.seeds), len(tasks.names))

    def program(
        function: Any, takes: tuple[Any, ...], gives: Any, **options: Any
    ) -> Any:
        split = devices.split(placement, _mapped(function, takes), takes, gives)
        return jax.jit(split, **options)

    init = program(parts.critic.init, (_KNOWN, _EVERY, _DATA), _EVERY)
    learn = program(
        parts.critic.step,
        (_KNOWN, _EVERY, _EVERY, _DATA),
        (_EVERY, _EVERY),
        donate_argnums=2,
    )
    begin = time.monotonic()
    keys = devices.place(placement, _keys(config, parts, tasks, step), SEED, TASK)
    params = jaxpets.PlanParams(
        devices.place(placement, state.params, SEED),
        devices.place(placement, tasks.params, TASK),
    )
    dataset = devices.place(placement, state.dataset, SEED)
    keys, now = acting.split_keys(keys)
    learned = init(params, now, dataset)
    count, updates = critic.calls(config)
    skipped: Any = 0
    for _ in range(count):
        keys, now = acting.split_keys(keys)
        learned, metrics = learn(params, now, learned, dataset)
        jax.block_until_ready(learned)
        skipped += metrics.num_skipped
    value, skipped, networks = devices.collect(
        placement, (metrics.value, skipped, learned.params), SEED, TASK
    )
    earned = jnp.mean(value) * (1 - config.critic.discount)
    seconds = time.monotonic() - begin
    run.say(
        f"critic: {count * updates:,} gradient steps for each task; the actors expect "
        f"{earned:.3f} a step  {seconds:.1f} s"
    )
    if lost := int(jnp.sum(skipped)):
        run.say(
            f"warning: {lost:,} gradient steps of critics were not finite: left out"
        )
    return networks


def _mapped(function: Any, takes: tuple[Any, ...]) -> Any:
    """Maps what one seed's task takes over tasks, then over seeds."""
    for axis in (TASK, SEED):
        function = acting.over(function, takes, axis)
    return function


def _keys(config: Config, parts: Parts, tasks: Tasks, step: int) -> Array:
    """Returns the keys `[S, K]` of the critics."""
    keys = trial_keys(config, CRITIC, step)
    return key_per(robots.places(parts.robot, tasks), keys)
