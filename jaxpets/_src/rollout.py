"""Trajectory sampling: particles that keep their ensemble member (TS-infinity)."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_count,
    check_key,
)
from jaxpets._src.types import DynamicsFn, RolloutFn


def particle_rollout(
    dynamics_fn: DynamicsFn, *, num_members: int = 1, num_particles: int = 1
) -> RolloutFn:
    """Builds the particle rollout of PETS (section 3.2 of the paper).

    Every candidate starts `num_particles` particles at the same observation; particle
    p moves by `s_{h+1} ~ f_{b(p)}(s_h, a_h)` with a member b(p) that it keeps for the
    whole horizon. Members get equally many particles, which the means per member in
    the exploration reward need; the paper's text draws b(p) at random, the code of
    PETS splits equally. All particles of one member are the rows of one batch, so a
    layer of the ensemble is one batched matrix product.

    Args:
      dynamics_fn: the model; called once per step with obs `[E, B, D]`, B = N * P.
      num_members: E.
      num_particles: E * P, over all members.

    Returns:
      A RolloutFn whose start is an observation `[D]`.

    Raises:
      TypeError, ValueError: if num_particles is not a multiple of num_members, or an
        argument is not what it should be; from the rollout, when traced, if an array
        does not fit.
    """
    check_callable("dynamics_fn", dynamics_fn)
    num_members = check_count("num_members", num_members)
    num_particles = check_count("num_particles", num_particles)
    if num_particles % num_members:
        raise ValueError(
            f"num_particles must be a multiple of num_members ({num_members}), "
            f"got {num_particles}."
        )
    per_member = num_particles // num_members

    def rollout(params: Any, key: Array, obs: Array, actions: Array) -> Array:
        check_key("key", key)
        check_array("obs", obs, ["D"])
        check_array("actions", actions, ["N", "H", "A"])
        num_samples, horizon, _ = actions.shape
        check_count("the number of candidates in actions", num_samples)
        check_count("the horizon of actions", horizon)
        rows = num_samples * per_member
        start = jnp.broadcast_to(obs, (num_members, rows, obs.shape[0]))
        row_actions = jnp.repeat(actions.swapaxes(0, 1), per_member, axis=1)

        def step(obs: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            key, action = inputs
            next_obs = dynamics_fn(params, key, obs, action)
            check_array("dynamics_fn's result", next_obs, obs.shape)
            return next_obs, next_obs

        keys = jax.random.split(key, horizon)
        _, path = jax.lax.scan(step, start, (keys, row_actions))
        path = path.reshape(horizon, num_members, num_samples, per_member, -1)
        path = jnp.concatenate([jnp.broadcast_to(obs, (1, *path.shape[1:])), path])
        # Last, so that it cancels where a planner undoes it: the path is never copied.
        return path.transpose(2, 0, 1, 3, 4)

    return rollout
