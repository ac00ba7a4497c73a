"""The law of a ModelSpace, tried on data, and its size."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.checks import check_array, check_count, check_real, check_record
from jaxpets._src.types import ModelSpace


def check_space(
    space: ModelSpace, obs: Array, next_obs: Array, *, tolerance: float = 1e-4
) -> None:
    """Raises unless a model can be learned in these coordinates.

    Tries the law `next_obs(o, target(o, x)) == x`, that features and targets are finite
    and that all results have the right shape. A space that breaks the law trains as
    well as any other and predicts nonsense. Call it once, on real transitions, outside
    `jit`.

    Args:
      space: what to try.
      obs: `[T, D]`, as a Transition has them; at least one row.
      next_obs: `[T, D]`.
      tolerance: how far an entry may be off, as a share of the largest number in it or,
        where that is less, of 1: data of a small unit are best tried in a larger one.

    Raises:
      TypeError, ValueError: naming the entry that is wrong, and by how much.
    """
    check_record("space", space, ModelSpace)
    check_real("tolerance", tolerance, 0.0)
    check_array("obs", obs, ["T", "D"])
    check_array("next_obs", next_obs, list(jnp.shape(obs)))
    num_rows, obs_size = jnp.shape(obs)
    check_count("the number of rows of obs", num_rows)
    features, target = space.features(obs), space.target(obs, next_obs)
    check_array("space.features's result", features, [num_rows, "F"])
    check_array("space.target's result", target, [num_rows, obs_size])
    for name, value in (("features", features), ("target", target)):
        finite = np.isfinite(value).all(axis=0)
        if not finite.all():
            entry = int(np.argmin(finite))
            raise ValueError(
                f"space.{name} must return finite numbers, but entry {entry} is not."
            )
    rebuilt = space.next_obs(obs, target)
    check_array("space.next_obs's result", rebuilt, [num_rows, obs_size])
    bounded = space.bound(next_obs, obs[0], obs[0])
    check_array("space.bound's result", bounded, [num_rows, obs_size])
    error = np.abs(np.asarray(rebuilt) - np.asarray(next_obs)).max(axis=0)
    scale = np.maximum(np.abs(next_obs).max(axis=0), 1.0)
    worst = int(np.argmax(error / scale))
    if not error[worst] <= tolerance * scale[worst]:
        raise ValueError(
            "space.next_obs(obs, space.target(obs, next_obs)) must be next_obs, but "
            f"entry {worst} is off by up to {error[worst]:.3g}."
        )


def check_space_size(space: Any, obs_size: Any) -> None:
    """Raises unless this is a space of observations of this size.

    A table of one row would be taken for all entries, and one of fewer would leave
    entries out, without a word. A space of functions of your own cannot say its size.
    """
    check_record("space", space, ModelSpace)
    obs_size = check_count("obs_size", obs_size)
    size = len(space.coordinates)
    if size not in (0, obs_size):
        raise ValueError(f"obs_size must be {size} as of space, got {obs_size}.")
