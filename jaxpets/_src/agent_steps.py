"""What an agent computes: to act, to remember, to learn; pure, a program each."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Sharding, SingleDeviceSharding

from jaxpets._src import dataset as datasets
from jaxpets._src.checks import check_array
from jaxpets._src.ensemble import Ensemble
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.fit_records import FitMetrics, Fitter
from jaxpets._src.learner import LearnerState, RewardData, fitted, new_state
from jaxpets._src.types import Planner, PlanParams, Transition

# `(key, number, is_new, PlanParams, state, obs) -> (action, state)`.
ActFn = Callable[[Array, Any, Any, PlanParams, Any, Any], tuple[Array, Any]]
LearnFn = Callable[[Array, LearnerState], tuple[LearnerState, FitMetrics]]
# Of an action and of a planner's state; None leaves it to JAX.
Places = tuple[Sharding | None, Sharding | None]
_APART = ("gpu",)  # platforms whose memory is not the host's


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
    append: Callable[[LearnerState, Transition, Any], LearnerState]
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

    The arguments of what is returned: `key`; `number`, `[]`, of the step, which is
    folded into it; `is_new`, `[]` or `[N]`, whether a trial begins; PlanParams; the
    planner's state, `[N, ...]`; `obs`, `[D]` or `[N, D]`.
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
        key: Array, number: Any, is_new: Any, params: PlanParams, state: Any, obs: Any
    ) -> tuple[Array, Any]:
        key = jax.random.fold_in(key, number)
        if num_envs is None:
            return one(params, key, is_new, state, obs)
        keys = jax.random.split(key, num_envs)
        every = jax.vmap(one, (None, 0, 0, 0, 0))
        return every(params, keys, is_new, state, obs)

    return act


def places(params: EnsembleParams) -> Places:
    """Returns where an action and a planner's state go.

    The host waits for an action. A GPU that writes it to pinned memory of the host
    spares it the copy: see "A plan that is waited for" in benchmarks/README.md.

    Args:
      params: of the model; it is computed where they are. On a CPU there is nothing to
        gain. Where there are several devices a planner may use them all, and then its
        outputs have no one place: JAX decides.
    """
    devices = {x for leaf in jax.tree.leaves(params) for x in leaf.devices()}
    if len(devices) != 1 or jax.local_device_count() != 1:
        return None, None
    (device,) = devices
    kinds = {memory.kind for memory in device.addressable_memories()}
    if device.platform not in _APART or "pinned_host" not in kinds:
        return None, None
    here = SingleDeviceSharding(device)
    return here.with_memory_kind("pinned_host"), here


def first_state(planner: Planner, lead: tuple[int, ...], places: Places) -> Any:
    """Returns a planner's state with the leading axes of its worlds, in its place.

    A step returns it there; if it began elsewhere, the second step would compile anew.
    """

    def every(leaf: Any) -> Array:
        return jnp.broadcast_to(leaf, (*lead, *jnp.shape(leaf)))

    return jax.device_put(jax.tree.map(every, planner.init()), places[1])


def strongly_typed(tree: Any) -> Any:
    """Returns numbers as arrays of their own type: one of Python would compile anew.

    Raises:
      TypeError: for what is none, as a reward's function in place of its data.
    """

    def array(leaf: Any) -> Array:
        dtype = leaf.dtype if isinstance(leaf, Array) else np.asarray(leaf).dtype
        if dtype.kind in "OUS":
            raise TypeError(f"reward must be a pytree of numbers, got {leaf!r} in it.")
        return jnp.asarray(leaf, jax.dtypes.canonicalize_dtype(dtype))

    return jax.tree.map(array, tree)
