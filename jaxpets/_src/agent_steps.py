"""What an agent computes: to act, to remember, to learn; pure, a program each."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src import dataset as datasets
from jaxpets._src.checks import check_array
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.fit_records import FitMetrics, Fitter
from jaxpets._src.learner import LearnerState, RewardData, fitted, new_state
from jaxpets._src.types import Planner, PlanParams, Transition

AppendFn = Callable[[LearnerState, Transition, Any], LearnerState]
LearnFn = Callable[[Array, LearnerState], tuple[LearnerState, FitMetrics]]


class Given(NamedTuple):
    """What the world gives a step: numbers of the host.

    Attributes:
      number: `[]` int32, of the step.
      is_new: `[]` or `[N]`, whether a trial begins.
      obs: `[D]` or `[N, D]`.
    """

    number: Any
    is_new: Any
    obs: Any


# `(PlanParams, key, state, Given) -> (action, state)`.
ActFn = Callable[[PlanParams, Array, Any, Given], tuple[Array, Any]]


class AgentSteps(NamedTuple):
    """Pure functions of one agent.

    Attributes:
      action_size: A.
      init: `(key, EnsembleParams or None) -> LearnerState`.
      append: `(LearnerState, transitions [T, ...], count []) -> LearnerState`: with the
        first `count` rows more.
      learn: `(key, LearnerState) -> (LearnerState, FitMetrics)`.
    """

    action_size: int
    init: Callable[[Array, EnsembleParams | None], LearnerState]
    append: AppendFn
    learn: LearnFn


def agent_steps(
    model: Ensemble, fitter: Fitter, reward_data: RewardData, capacity: int
) -> AgentSteps:
    """Builds what an agent computes apart from acting; see `agent`."""

    def append(state: LearnerState, rows: Transition, count: Array) -> LearnerState:
        return state._replace(dataset=datasets.append(state.dataset, rows, count))

    init = functools.partial(new_state, model, fitter, reward_data, capacity)
    learn = functools.partial(fitted, fitter, reward_data)
    return AgentSteps(model.action_size, init, append, learn)


def act_fn(planner: Planner, action_size: int, num_envs: int | None) -> ActFn:
    """Returns one step of a planner in one world, or in N of them.

    The planner's state is `[N, ...]` then, and the action `[N, A]`. The number of the
    step is folded into its key.
    """

    def one(
        params: PlanParams, key: Array, is_new: Array, state: Any, obs: Array
    ) -> tuple[Array, Any]:
        state = jax.tree.map(
            functools.partial(jnp.where, is_new), planner.init(), state
        )
        output, state = planner.step(params, key, state, obs)
        check_array("the planner's action", output.action, [action_size])
        return output.action, state

    def act(
        params: PlanParams, key: Array, state: Any, given: Given
    ) -> tuple[Array, Any]:
        key = jax.random.fold_in(key, given.number)
        if num_envs is None:
            return one(params, key, given.is_new, state, given.obs)
        keys = jax.random.split(key, num_envs)
        every = jax.vmap(one, (None, 0, 0, 0, 0))
        return every(params, keys, given.is_new, state, given.obs)

    return act


def strongly_typed(tree: Any) -> Any:
    """Returns numbers, copied, as arrays of their own type, and floats as float32.

    With a type of Python's they would compile anew, and with 64 bits give those to a
    reward.

    Raises:
      TypeError: for what is none, as a reward's function in place of its data.
    """

    def array(leaf: Any) -> Array:
        dtype = leaf.dtype if isinstance(leaf, Array) else np.asarray(leaf).dtype
        if not any(jnp.issubdtype(dtype, kind) for kind in (np.number, np.bool_)):
            raise TypeError(f"reward must be a pytree of numbers, got {leaf!r} in it.")
        is_float = jnp.issubdtype(dtype, np.floating)
        wanted = jnp.float32 if is_float else jax.dtypes.canonicalize_dtype(dtype)
        return jnp.array(leaf, wanted)

    return jax.tree.map(array, tree)
