"""The one transform: a rollout, a reward and an optimizer become a planner."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_count,
    check_key,
    check_record,
)
from jaxpets._src.chunks import chunked
from jaxpets._src.elites import WORST_VALUE
from jaxpets._src.returns import candidate_returns
from jaxpets._src.types import (
    ModelRolloutFn,
    Planner,
    PlanOutput,
    PlanParams,
    RewardFn,
    RolloutFn,
    TrajectoryOptimizer,
)


def plan(
    rollout_fn: RolloutFn,
    reward_fn: RewardFn,
    optimizer: TrajectoryOptimizer,
    *,
    chunk_size: int | None = None,
    terminal_fn: Callable[[Any, Array], Array] | None = None,
    discount: float | Array = 1.0,
    risk_fn: Callable[[Array], Array] | None = None,
    value_fn: Callable[[Any, Array], Array] | None = None,
    propose_fn: Callable[[PlanParams, Array, Any], Array] | None = None,
) -> Planner:
    """Builds a model-predictive controller.

    At every step it searches for `argmax_a mean_particles sum_h r(s_h, a_h, s_h+1)`
    (section 3.1 of the paper, over the particles of section 3.2), executes the first
    action and keeps the rest as the warm start. A candidate whose return is not
    finite is given the worst value, so that imagined divergence never wins.

    Nothing is jitted, and a plan that is not takes a thousand times as long: call
    `jax.jit(planner.step)`, or step it inside a jitted scan. `step` is for one start
    state: map it over environments with
    `jax.vmap(planner.step, (None, 0, 0, 0))`, over tasks with
    `(PlanParams(None, 0), 0, 0, 0)`, over seeds with `(PlanParams(0, 0), 0, 0, 0)`.

    Memory: a call holds the paths of the candidates in hand, the model's work on one
    step of them, and the sequences of all candidates. With an ensemble of width W that
    is about `4 (n E P ((H + 10) D + 2 W) + 7 N H A)` bytes per mapped call, where n is
    N or `chunk_size`, plus what reward_fn needs for n candidates at all H steps.

    Args:
      rollout_fn: imagines; reads `PlanParams.dynamics`. A ModelRolloutFn is bound to
        them once per step.
      reward_fn: rewards one imagined step; reads `PlanParams.reward`.
      optimizer: searches; its state is the planner's state.
      chunk_size: at most so many candidates are imagined and rewarded at a time; None
        for all. The plan is the same, candidate for candidate: a chunk gets a key that
        draws its share of the noise, for which rollout_fn must draw in the shape
        `[E, B, ...]`, as a DynamicsFn does, or not at all, and the key must be JAX's
        default kind, partitionable threefry. Chunks follow one another, so take the
        largest that fits.
      terminal_fn: `(PlanParams.reward, obs [E, P, D]) -> bool [E, P]`, or `[]` for all
        particles: whether an imagined state ends the trial. The step that leads into
        such a state still earns its reward, as in Gymnasium; all later steps of that
        particle earn nothing, and need not be finite. The start is not asked. A reward
        that returns `[]` counts for the share of particles that go on; it still sees
        all of them.
      discount: in [0, 1], a number or a traced float32 scalar; the reward of step h,
        from 0, counts `discount^h`.
      risk_fn: `(returns [E, P]) -> []`, what a candidate is worth given the returns of
        its particles; None for their mean.
      value_fn: `(PlanParams.reward, obs [E, P, D]) -> [E, P]`, or `[]` for all
        particles, float32: what is still to be earned where the horizon ends, counted
        `discount^H`. A reward that is further away than the horizon is found by it.
        None: nothing.
      propose_fn: `(PlanParams, key, obs) -> actions [H, A]` in the box, as a policy
        would go on; see `policies.prior`. The search begins at it where it promises
        more than the last plan, by what each is imagined to return once. Its state
        must have a `mean`, as those of `jaxpets.optimizers` have. CEM draws no wider
        than to the edge of the box: it needs proposals that lie inside.

    Returns:
      A Planner.

    Raises:
      TypeError, ValueError: if an argument is not what it should be; from `step`, at
        trace time, when params is no PlanParams, the state belongs to another search,
        a function returns a shape or dtype that the contract does not allow, or
        chunks are asked of another kind of key; when it is compiled, if the noise
        cannot be divided.
    """
    check_callable("rollout_fn", rollout_fn)
    check_record("optimizer", optimizer, TrajectoryOptimizer)
    if chunk_size is not None:
        chunk_size = check_count("chunk_size", chunk_size)

    wanted: Any = None
    if propose_fn is not None:
        check_callable("propose_fn", propose_fn)
        wanted = _state_with_mean(optimizer)
    returns = candidate_returns(reward_fn, terminal_fn, discount, risk_fn, value_fn)

    def step(
        params: PlanParams, key: Array, state: Any, obs: Any
    ) -> tuple[PlanOutput, Any]:
        check_record("params", params, PlanParams)
        check_key("key", key)
        imagine = _bound(rollout_fn, params.dynamics)

        def objective(key: Array, actions: Array) -> Array:
            path = imagine(key, obs, actions)
            num_samples, horizon, _ = actions.shape
            if path.ndim != 5 or path.shape[:2] != (num_samples, horizon + 1):
                raise ValueError(
                    "rollout_fn must return shape "
                    f"({num_samples}, {horizon + 1}, E, P, D), got {path.shape}."
                )
            # In the order of time, in which it was imagined, no part of it is copied.
            path = path.transpose(1, 2, 0, 3, 4)
            value = returns(params.reward, path, actions.swapaxes(0, 1))
            finite = jnp.isfinite(value)
            return jnp.where(
                finite, jnp.clip(value, WORST_VALUE, -WORST_VALUE), WORST_VALUE
            )

        whole = objective if chunk_size is None else chunked(objective, chunk_size)
        if propose_fn is not None:
            # The search does so, too, but its mean is needed before.
            check_record("state", state, wanted.__class__)
            check_array("state.mean", state.mean, wanted.mean.shape)
            key, propose_key, value_key = jax.random.split(key, 3)
            proposal = propose_fn(params, propose_key, obs)
            check_array("propose_fn's result", proposal, wanted.mean.shape)
            both = jnp.stack([state.mean, proposal])
            last, new = whole(value_key, both)
            state = state._replace(mean=jnp.where(new > last, proposal, state.mean))
        solution, state = optimizer.step(whole, key, state)
        return PlanOutput(solution.actions[0], *solution), state

    return Planner(optimizer.init, step)


def _state_with_mean(optimizer: TrajectoryOptimizer) -> Any:
    """Returns a search's state as shapes; raises unless it says where it begins."""
    state = jax.eval_shape(optimizer.init)
    if not hasattr(state, "mean"):
        kind = type(state).__name__
        raise TypeError(
            f"optimizer must have a state with a mean for propose_fn, got {kind}."
        )
    return state


def _bound(rollout_fn: RolloutFn, params: Any) -> Callable[[Array, Any, Array], Array]:
    """Binds the model, before the loop of the search: XLA would not move it out."""
    if isinstance(rollout_fn, ModelRolloutFn):
        return rollout_fn.bind(params)
    return functools.partial(rollout_fn, params)
