"""A policy as what a search begins with."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_count,
    check_record,
)
from jaxpets._src.types import DynamicsFn, Planner, PlanParams


def prior(
    policy: Planner, dynamics_fn: DynamicsFn, *, horizon: int, num_members: int = 1
) -> Callable[[PlanParams, Array, Array], Array]:
    """Builds what a policy would do from here on, for `plan(propose_fn=)`.

    A plan has one action for all members, and each leads them elsewhere: it is the mean
    of what the policy would do where each of them is.

    Args:
      policy: a Planner that keeps no state, as of `distill` and
        `policies.actor_critic`.
      dynamics_fn: the model; reads `PlanParams.dynamics`.
      horizon: H, of the search.
      num_members: E, of the model.

    Returns:
      `(PlanParams, key, obs [D]) -> actions [H, A]`, with the policy's PlanParams.

    Raises:
      TypeError, ValueError: if an argument is not what it should be.
    """
    check_record("policy", policy, Planner)
    check_callable("dynamics_fn", dynamics_fn)
    horizon = check_count("horizon", horizon)
    num_members = check_count("num_members", num_members)
    each = jax.vmap(policy.step, (None, 0, None, 0))

    def propose(params: PlanParams, key: Array, obs: Array) -> Array:
        check_array("obs", obs, ["D"])

        def step(obs: Array, key: Array) -> tuple[Array, Array]:
            act_key, move_key = jax.random.split(key)
            act_keys = jax.random.split(act_key, num_members)
            plans, _ = each(params, act_keys, policy.init(), obs)
            action = jnp.mean(plans.action, axis=0)
            moved = dynamics_fn(params.dynamics, move_key, obs[:, None], action[None])
            return moved[:, 0], action

        start = jnp.broadcast_to(obs, (num_members, *obs.shape))
        return jax.lax.scan(step, start, jax.random.split(key, horizon))[1]

    return propose
