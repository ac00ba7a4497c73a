"""The one transform: a rollout, a reward and an optimizer become a planner."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_action_box, check_key
from jaxpets._src.types import (
    WORST_VALUE,
    Planner,
    PlanOutput,
    PlanParams,
    RewardFn,
    RolloutFn,
    TrajectoryOptimizer,
)


def plan(
    rollout_fn: RolloutFn, reward_fn: RewardFn, optimizer: TrajectoryOptimizer
) -> Planner:
    """Builds a model-predictive controller.

    At every step it searches for `argmax_a mean_particles sum_h r(s_h, a_h, s_h+1)`
    (section 3.1 of the paper, over the particles of section 3.2), executes the first
    action and keeps the rest as the warm start. A candidate whose return is not
    finite is given the worst value, so that imagined divergence never wins.

    Nothing is jitted. `step` is for one start state: map it over environments with
    `jax.vmap(planner.step, (None, 0, 0, 0))`, over tasks with
    `(PlanParams(None, 0), 0, 0, 0)`, over seeds with `(PlanParams(0, 0), 0, 0, 0)`.

    Args:
      rollout_fn: imagines; reads `PlanParams.dynamics`.
      reward_fn: rewards one imagined step; reads `PlanParams.reward`.
      optimizer: searches; its state is the planner's state.

    Returns:
      A Planner.

    Raises:
      ValueError: from `step`, at trace time, when rollout_fn or reward_fn return a
        shape that the contract does not allow.
    """

    def reward(params: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        reward = jnp.asarray(reward_fn(params, obs, action, next_obs))
        particles = obs.shape[:-1]
        if reward.dtype != jnp.float32:
            raise TypeError(f"reward_fn must return float32, got {reward.dtype}.")
        if reward.shape not in ((), particles):
            raise ValueError(
                f"reward_fn must return shape () or {particles}, got {reward.shape}."
            )
        return jnp.mean(reward)

    rewards = jax.vmap(reward, (None, 0, 0, 0))  # over time
    rewards = jax.vmap(rewards, (None, 0, 0, 0))  # over candidates

    def step(
        params: PlanParams, key: Array, state: Any, obs: Any
    ) -> tuple[PlanOutput, Any]:
        check_key("key", key)

        def objective(key: Array, actions: Array) -> Array:
            path = rollout_fn(params.dynamics, key, obs, actions)
            num_samples, horizon, _ = actions.shape
            if path.ndim != 5 or path.shape[:2] != (num_samples, horizon + 1):
                raise ValueError(
                    "rollout_fn must return shape "
                    f"({num_samples}, {horizon + 1}, E, P, D), got {path.shape}."
                )
            value = rewards(params.reward, path[:, :-1], actions, path[:, 1:]).sum(1)
            finite = jnp.isfinite(value)
            return jnp.where(
                finite, jnp.clip(value, WORST_VALUE, -WORST_VALUE), WORST_VALUE
            )

        solution, state = optimizer.step(objective, key, state)
        return PlanOutput(solution.actions[0], solution.actions, solution.value), state

    return Planner(optimizer.init, step)


def random_planner(action_low: Array, action_high: Array) -> Planner:
    """Builds a planner that draws every action uniformly from the box.

    The random arm of the paper, and the first trial of every other arm.

    Args:
      action_low: `[A]`.
      action_high: `[A]`.

    Returns:
      A Planner with an empty state; its plans have length one and value zero.

    Raises:
      ValueError: if the box is not finite or empty.
    """
    check_action_box(action_low, action_high)

    def step(
        params: PlanParams, key: Array, state: tuple, obs: Any
    ) -> tuple[PlanOutput, tuple]:
        del params, obs
        check_key("key", key)
        uniform = jax.random.uniform(key, action_low.shape, jnp.float32)
        action = action_low + (action_high - action_low) * uniform
        return PlanOutput(action, action[None], jnp.zeros((), jnp.float32)), state

    return Planner(tuple, step)
