"""Positions of a recorded trial, of what was observed."""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxpets._src.types import Coordinate
from jaxpets.envs.observations import readings


def qpos_fn(
    model: Any, coordinates: Sequence[Coordinate], step_time: float
) -> Callable[[Array], Array]:
    """Builds what a recorded trial is drawn from.

    A joint whose position is not observed is where its velocity over the steps has
    brought it from the model's own start, or stays there if that is not observed.

    Args:
      model: a compiled MuJoCo model.
      coordinates: D entries that `mujoco_env` observes of it.
      step_time: of the environment, in s.

    Returns:
      `(obs [T, D]) -> [T, Q]`.
    """
    every = readings(model, [row.name for row in coordinates])
    seen = {(r.source, r.place): i for i, r in enumerate(every)}
    rest = jnp.asarray(model.qpos0, jnp.float32)

    def column(obs: Array, place: int) -> Array:
        if ("qpos", place) in seen:
            return obs[:, seen["qpos", place]]
        if ("mean_qvel", place) in seen:
            return rest[place] + step_time * jnp.cumsum(
                obs[:, seen["mean_qvel", place]]
            )
        return jnp.broadcast_to(rest[place], obs.shape[:1])

    return lambda obs: jnp.stack([column(obs, i) for i in range(model.nq)], axis=-1)
