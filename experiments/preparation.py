"""What comes between exploration and zero-shot: a refit, and a critic of every task.

The reward of a task is first read here. What is learned is saved with the model that
performs, so that a run that was stopped goes on.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams

from . import acting, critic, exploration, robots
from .build import CRITIC, Parts, State, key_per, trial_keys
from .config import Config
from .parallel import devices
from .parallel.devices import SEED, TASK
from .refit import refit
from .storage.folder import RunFolder

_AXES = jaxpets.SEED_AXES.dataset


def prepared(
    config: Config, source: RunFolder, run: RunFolder, step: int, parts: Parts,
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
        state = source.restore_trial(step, exploration.as_saved(config, parts))
        if parts.refitter:
            state = refit(config, parts, state, step, run)
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
    init = parts.critic.init

    def one(params: Any, task: Any, dataset: Any) -> ActorCriticParams:
        known = jaxpets.PlanParams(params, task)
        return init(known, jax.random.key(0), dataset).params

    of_tasks = jax.vmap(one, (None, 0, None))
    of_seeds = jax.vmap(of_tasks, (0, None, _AXES))
    networks = jax.eval_shape(of_seeds, explored.params, tasks.params, explored.dataset)
    return model._replace(reward=networks)


def _learned(
    config: Config, parts: Parts, tasks: Tasks, state: State, step: int, run: RunFolder
) -> ActorCriticParams:
    """Returns the networks `[S, K]` of every seed and task."""
    assert parts.critic is not None
    placement = devices.spread(len(config.seeds), len(tasks.names))
    every, of_seed = P(SEED, TASK), P(SEED)
    known = jaxpets.PlanParams(of_seed, P(TASK))
    # The size of the data is one number, for all seeds.
    data = _AXES._replace(data=of_seed, size=P(), cursor=P())

    def mapped(function: Any, takes: tuple[Any, ...], gives: Any) -> Any:
        for axis in (TASK, SEED):
            function = acting.over(function, takes, axis)
        return devices.split(placement, function, takes, gives)

    init = mapped(parts.critic.init, (known, every, data), every)
    step_takes = (known, every, every, data)
    learn = mapped(parts.critic.step, step_takes, (every, every))
    init, learn = jax.jit(init), jax.jit(learn, donate_argnums=2)

    begin = time.monotonic()
    keys = trial_keys(config, CRITIC, step)
    keys = key_per(robots.places(parts.robot, tasks), keys)
    keys = devices.place(placement, keys, SEED, TASK)
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
