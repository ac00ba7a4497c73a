"""Rewards of what really happened."""

from typing import Any

import jax
from jax import Array

from jaxpets._src.checks import check_array, check_record
from jaxpets._src.returns import single_reward
from jaxpets._src.types import RewardFn, Transition


def score(reward_fn: RewardFn, params: Any, transitions: Transition) -> Array:
    """Returns the rewards of recorded steps, such as those of a trial from `unroll`.

    A recorded step is one particle of one member: the reward gets `[1, 1, D]`, and a
    reward that plans can be scored as it stands. One that compares members, such as
    `epistemic`, has none to compare and raises.

    Args:
      reward_fn: what a planner maximises, or any other reward.
      params: its data, as in `PlanParams.reward`.
      transitions: `[T, ...]`; map over more axes with `jax.vmap`.

    Returns:
      `[T]`, in the reward's unit.

    Raises:
      TypeError, ValueError: when traced, if an argument is not what it should be, or
        reward_fn returns a shape or dtype that its contract does not allow.

    >>> import jax.numpy as jnp
    >>> speed = lambda unit, obs, action, next_obs: (next_obs - obs)[..., 0] / unit
    >>> obs = jnp.arange(4.0)[:, None] ** 2
    >>> score(speed, 0.5, Transition(obs[:-1], jnp.zeros((3, 1)), obs[1:])).tolist()
    [2.0, 6.0, 10.0]
    """
    reward = single_reward(reward_fn)
    check_record("transitions", transitions, Transition)
    check_array("transitions.obs", transitions.obs, ["T", "D"])
    check_array("transitions.action", transitions.action, [len(transitions.obs), "A"])
    check_array("transitions.next_obs", transitions.next_obs, transitions.obs.shape)
    return jax.vmap(reward, (None, 0, 0, 0))(params, *transitions)
