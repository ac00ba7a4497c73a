"""What comes between exploration and zero-shot: a refit, and a critic of every task.

The reward of a task is first read here. What is learned is saved with the model that
performs, so that a run that was stopped goes on.
"""

import jax
from jax import Array
from jax.sharding import PartitionSpec as P

import jaxpets
from jaxpets.envs import Tasks
from jaxpets.policies import ActorCriticParams

from . import critic, exploration, kept_networks, robots
from .build import CRITIC, Parts, State, key_per, trial_keys
from .config import Config
from .model_file import Source
from .parallel import devices
from .parallel.devices import SEED, TASK
from .refit import refitted
from .storage.folder import RunFolder

_CRITICS = critic.Several(
    "a critic of each task",
    (SEED, TASK),
    jaxpets.PlanParams(P(SEED), P(TASK)),
    # The size of the data is one number, for all seeds.
    jaxpets.datasets.AXES._replace(data=P(SEED), size=P(), cursor=P()),
)


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
    if found := kept_networks.restored(run, form):
        return found
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
    takes = (_CRITICS.known, P(SEED, TASK), _CRITICS.data)
    begun = jax.eval_shape(
        critic.over(_CRITICS, parts.critic.init, takes),
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
    keys = devices.place(placement, _keys(config, parts, tasks, step), SEED, TASK)
    params = jaxpets.PlanParams(
        devices.place(placement, state.params, SEED),
        devices.place(placement, tasks.params, TASK),
    )
    dataset = devices.place(placement, state.dataset, SEED)
    return critic.learned(
        config.critic, parts.critic, _CRITICS, placement, params, keys, dataset, run
    )


def _keys(config: Config, parts: Parts, tasks: Tasks, step: int) -> Array:
    """Returns the keys `[S, K]` of the critics."""
    keys = trial_keys(config, CRITIC, step)
    return key_per(robots.places(parts.robot, tasks), keys)
