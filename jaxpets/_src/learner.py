"""One trial of model-based reinforcement learning as one pure function."""

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
from jax import Array

from jaxpets._src.checks import check_count, check_key
from jaxpets._src.dataset import append, init_dataset
from jaxpets._src.ensemble import Ensemble, EnsembleParams
from jaxpets._src.fit import FitMetrics, FitState, Fitter
from jaxpets._src.types import Dataset, Env, Planner, PlanOutput, PlanParams, Transition
from jaxpets._src.unroll import start, unroll


class RewardData(NamedTuple):
    """How the data of a reward come about; see `PlanParams.reward`.

    init: `(key) -> data` before anything was seen.
    refresh: `(data, EnsembleParams, Dataset) -> data`, once per trial.
    """

    init: Callable[[Array], Any]
    refresh: Callable[[Any, EnsembleParams, Dataset], Any]


class LearnerState(NamedTuple):
    """Everything that was learned; holds no key."""

    params: EnsembleParams
    fit: FitState
    dataset: Dataset
    reward: Any


class TrialOutput(NamedTuple):
    """What happened in one trial."""

    transitions: Transition  # [T, ...]
    plans: PlanOutput  # [T, ...]
    fit: FitMetrics


class Learner(NamedTuple):
    """The loop of PETS, one trial at a time.

    init: `(key) -> LearnerState`.
    learn: `(key, state, transitions [T, ...]) -> (state, FitMetrics)`: appends, fits,
      refreshes the reward data.
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
    reward_data: RewardData,
    *,
    trial_length: int,
    capacity: int,
) -> Learner:
    """Builds the two halves of a trial, acting and learning (sections 3.1 to 3.3).

    The planner is an argument of `step`, so the first trial may be a random one.

    Args:
      env: where to act.
      ensemble: the model.
      fitter: trains it.
      reward_data: keeps the data of the reward in step with the model.
      trial_length: T.
      capacity: C, transitions kept.

    Returns:
      A Learner; map it over seeds with `jax.vmap`.

    Raises:
      TypeError, ValueError: if a trial does not fit the capacity.
      AssertionError: from `learn`, when traced, if `refresh` changes a shape or dtype.
    """
    check_count("trial_length", trial_length)
    check_count("capacity", capacity, minimum=trial_length)
    obs_size = jax.eval_shape(env.reset, jax.random.key(0)).obs.shape[0]

    def init(key: Array) -> LearnerState:
        check_key("key", key)
        model_key, reward_key = jax.random.split(key)
        params = ensemble.init(model_key)
        dataset = init_dataset(capacity, obs_size, env.action_low.shape[0])
        reward = reward_data.refresh(reward_data.init(reward_key), params, dataset)
        return LearnerState(params, fitter.init(params), dataset, reward)

    def learn(
        key: Array, state: LearnerState, transitions: Transition
    ) -> tuple[LearnerState, FitMetrics]:
        dataset = append(state.dataset, transitions)
        params, fit, metrics = fitter.step(state.params, key, state.fit, dataset)
        reward = reward_data.refresh(state.reward, params, dataset)
        # Another shape would retrace every trial.
        chex.assert_trees_all_equal_shapes_and_dtypes(reward, state.reward)
        return LearnerState(params, fit, dataset, reward), metrics

    def step(
        planner: Planner, key: Array, state: LearnerState
    ) -> tuple[LearnerState, TrialOutput]:
        reset_key, act_key, fit_key = jax.random.split(key, 3)
        params = PlanParams(state.params, state.reward)
        begin = start(env, planner, reset_key)
        _, transitions, plans = unroll(
            env, planner, params, act_key, begin, length=trial_length
        )
        state, metrics = learn(fit_key, state, transitions)
        return state, TrialOutput(transitions, plans, metrics)

    return Learner(init, learn, step)
