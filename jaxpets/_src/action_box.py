"""The box of valid actions, in which every search looks for a sequence."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.typing import ArrayLike


class ActionBox(NamedTuple):
    """What a search needs to know of the action bounds.

    Attributes:
      low: `[A]`.
      high: `[A]`.
      center: `[A]`, where a search without a warm start begins.
      half_width: `[A]`, the unit of a box scaled to `[-1, 1]`.
    """

    low: Array
    high: Array
    center: Array
    half_width: Array

    def start(self, horizon: int) -> Array:
        """Returns the sequence `[H, A]` that stays in the middle of the box."""
        return jnp.broadcast_to(self.center, (horizon, *self.center.shape))

    def clip(self, actions: Array) -> Array:
        """Returns actions `[..., A]` inside the box."""
        return jnp.clip(actions, self.low, self.high)

    def shift(self, sequences: Array) -> Array:
        """Drops the first step of `[..., H, A]` and pads with the middle of the box."""
        last = jnp.broadcast_to(self.center, sequences[..., :1, :].shape)
        return jnp.concatenate([sequences[..., 1:, :], last], axis=-2)


def action_box(action_low: ArrayLike, action_high: ArrayLike) -> ActionBox:
    """Returns the box between two bounds.

    Args:
      action_low: `[A]`, finite numbers; they may be traced.
      action_high: `[A]`, above action_low in every entry.

    Raises:
      TypeError, ValueError: for bounds that are no box, also of float32.
    """
    _check(action_low, action_high)
    low, high = (jnp.array(bound, jnp.float32) for bound in (action_low, action_high))
    return ActionBox(low, high, (low + high) / 2, (high - low) / 2)


def _check(action_low: ArrayLike, action_high: ArrayLike) -> None:
    """Raises unless the two are `[A]`, finite and `low < high` in every entry."""
    bounds = (action_low, action_high)
    for name, bound in zip(("action_low", "action_high"), bounds, strict=True):
        if not isinstance(bound, (Array, np.ndarray)) or bound.dtype.kind not in "fiu":
            kind = getattr(bound, "dtype", type(bound).__name__)
            raise TypeError(
                f"{name} must be an array of numbers [A], got {bound!r} ({kind})."
            )
    shape = jnp.shape(action_low)
    if len(shape) != 1 or shape[0] == 0:
        raise ValueError(f"action_low must be [A] with A > 0, got {list(shape)}.")
    if jnp.shape(action_high) != shape:
        raise ValueError(
            f"action_high must be {list(shape)} as action_low, got "
            f"{list(jnp.shape(action_high))}."
        )
    if any(isinstance(bound, Tracer) for bound in bounds):
        return
    # What is searched is a box of float32, whose half width is squared: that may be
    # infinite or zero where the bounds, as they came, are neither.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        low, high = (np.asarray(bound).astype(np.float32) for bound in bounds)
        square = ((high - low) / 2) ** 2
    is_box = (low < high) & np.isfinite(square) & (square >= np.finfo(np.float32).tiny)
    if not is_box.all():
        raise ValueError(
            "action_low and action_high must be finite with low < high, and in float32 "
            "so must be the square of their difference, above 0, got "
            f"{np.asarray(action_low).tolist()} and {np.asarray(action_high).tolist()}."
        )
