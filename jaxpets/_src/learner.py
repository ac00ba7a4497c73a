"""One trial of model-based reinforcement learning as one pure function."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src import dataset as datasets
from jaxpets._src.action_box import action_box
from jaxpets._src.checks import (
    check_count,
    check_functions,
    check_key,
    check_like,
    check_record,
)
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.fit_records import FitMetrics, FitState, Fitter
from jaxpets._src.types import (
    Dataset,
    Env,
    Planner,
    PlanOutput,
    PlanParams,
    Transition,
)
from jaxpets._src.unroll import reset, start_trial, unroll


class RewardData(NamedTuple):
    """How the data of a reward come about; see `PlanParams.reward`.

    By default a reward has no data: `()`.

    Attributes:
      init: `(key) -> data` before anything was seen.
      refresh: `(data, EnsembleParams, Dataset) -> data`, once per trial.
    """

    init: Callable[[Array], Any] = lambda key: ()
    refresh: Callable[[Any, EnsembleParams, Dataset], Any] = (
        lambda data, params, dataset: data
    )


_NO_DATA = RewardData()


class LearnerState(NamedTuple):
    """Everything that was learned; holds no key.

    Attributes:
      params: the model.
      fit: the state of its optimizer.
      dataset: what was seen.
      reward: the data of the exploration reward.
    """

    params: EnsembleParams
    fit: FitState
    dataset: Dataset
    reward: Any


class TrialOutput(NamedTuple):
    """What happened in one trial.

    Attributes:
      transitions: `[T, ...]`.
      plans: PlanOutput `[T, ...]`.
      fit: how training went after it.
    """

    transitions: Transition
    plans: PlanOutput
    fit: FitMetrics


class Learner(NamedTuple):
    """The loop of PETS, one trial at a time.

    Attributes:
      init: `(key) -> LearnerState`.
      learn: `(key, state, transitions [T, ...]) -> (state, FitMetrics)`: appends, fits,
        refreshes the reward data. From where physics diverged on, nothing is learned.
      step: `(planner, key, state) -> (state, TrialOutput)`: resets the environment,
        unrolls the planner and learns from what happened.
    """

    init: Callable[[Array], LearnerState]
    learn: Callable[[Array, LearnerState, Transition], tuple[LearnerState, FitMetrics]]
    step: Callable[[Planner, Array, LearnerState], tuple[LearnerState, TrialOutput]]


def learner(
    env: Env,
    ensemble: Ensemble,
    fitter: Fitter,
    reward_data: RewardData = _NO_DATA,
    *,
    trial_length: int,
    capacity: int,
) -> Learner:
    """Builds the two halves of a trial, acting and learning (sections 3.1 to 3.3).

    The planner is an argument of `step`, so the first trial may be a random one. A
    jitted trial is `jax.jit(learner.step, static_argnums=0)`, and many seeds are
    `jaxpets.over_seeds(learner, num_seeds)`.

    Where physics diverges, a trial has ended: of its T steps the first
    `jaxpets.datasets.num_stable(output.transitions)` are learned from. In the data,
    whose size all seeds share, rows that are there take the places of the others.

    Args:
      env: where to act.
      ensemble: the model.
      fitter: trains it.
      reward_data: keeps the data of the reward in step with the model.
      trial_length: T.
      capacity: C, transitions kept.

    Returns:
      A Learner.

    Raises:
      TypeError, ValueError: if an argument is not what it should be, a trial does not
        fit the capacity, or the model does not fit the environment in its sizes or in
        the names of its entries; from `learn`, when traced, if `refresh` changes a
        shape or dtype.
    """
    check_record("env", env, Env)
    check_record("ensemble", ensemble, Ensemble)
    check_record("fitter", fitter, Fitter)
    check_functions("reward_data", reward_data, RewardData)
    trial_length = check_count("trial_length", trial_length)
    capacity = check_count("capacity", capacity, minimum=trial_length)
    box = action_box(env.action_low, env.action_high)
    start = jax.eval_shape(functools.partial(reset, env), jax.random.key(0))
    sizes = (start.obs.shape[0], box.low.shape[0])
    if sizes != (ensemble.obs_size, ensemble.action_size):
        raise ValueError(
            f"ensemble must have the sizes of env, obs_size {sizes[0]} and action_size "
            f"{sizes[1]}, got {ensemble.obs_size} and {ensemble.action_size}."
        )
    _check_entries(env, ensemble)

    def init(key: Array) -> LearnerState:
        check_key("key", key)
        return new_state(ensemble, fitter, reward_data, capacity, key)

    def learn(
        key: Array, state: LearnerState, transitions: Transition
    ) -> tuple[LearnerState, FitMetrics]:
        check_key("key", key)
        check_record("state", state, LearnerState)
        dataset = datasets.append_stable(state.dataset, transitions)
        return fitted(fitter, reward_data, key, state._replace(dataset=dataset))

    def step(
        planner: Planner, key: Array, state: LearnerState
    ) -> tuple[LearnerState, TrialOutput]:
        check_key("key", key)
        check_record("state", state, LearnerState)
        reset_key, act_key, fit_key = jax.random.split(key, 3)
        params = PlanParams(state.params, state.reward)
        trial = start_trial(env, planner, reset_key)
        _, transitions, plans = unroll(
            env, planner, params, act_key, trial, length=trial_length
        )
        state, metrics = learn(fit_key, state, transitions)
        return state, TrialOutput(transitions, plans, metrics)

    return Learner(init, learn, step)


def _check_entries(env: Env, ensemble: Ensemble) -> None:
    """Raises if both name the entries of an observation, but not alike.

    Of what kind they are is not compared: a model may see them otherwise.
    """
    rows = () if ensemble.space is None else ensemble.space.coordinates
    # Where one of them has no names there is nothing to compare.
    for i, (wanted, row) in enumerate(zip(env.coordinates, rows, strict=False)):
        if row.name != wanted.name:
            raise ValueError(
                "ensemble must be of the entries of env.coordinates, but entry "
                f"{i} is {wanted.name!r} there and {row.name!r} in its space."
            )


def new_state(
    ensemble: Ensemble,
    fitter: Fitter,
    reward_data: RewardData,
    capacity: int,
    key: Array,
    params: EnsembleParams | None = None,
) -> LearnerState:
    """Returns a learner without data; params are what its model has learned before."""
    model_key, reward_key = jax.random.split(key)
    params = ensemble.init(model_key) if params is None else params
    dataset = datasets.init(capacity, ensemble.obs_size, ensemble.action_size)
    reward = reward_data.refresh(reward_data.init(reward_key), params, dataset)
    return LearnerState(params, fitter.init(params), dataset, _own(reward))


def fitted(
    fitter: Fitter, reward_data: RewardData, key: Array, state: LearnerState
) -> tuple[LearnerState, FitMetrics]:
    """Returns a learner after a fit to its data, with the reward in step."""
    params, fit, metrics = fitter.step(state.params, key, state.fit, state.dataset)
    reward = reward_data.refresh(state.reward, params, state.dataset)
    # Another shape would retrace every plan.
    check_like("reward_data.refresh's result", reward, state.reward)
    return LearnerState(params, fit, state.dataset, _own(reward)), metrics


def _own(reward: Any) -> Any:
    """Returns a copy, as the data of a reward may be the parameters themselves.

    So all of a state has memory of its own, and may be donated.
    """
    return jax.tree.map(jnp.copy, reward)
