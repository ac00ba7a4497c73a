"""Where trials start: random postures of a model, and those that touch nothing."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets.envs.extra import needs_extra
from jaxpets.envs.native import native_readings

with needs_extra():
    import mujoco

_C: Any = mujoco  # its names are made at import, where pyright does not see them
_LIFT = 0.01  # m
# `(key) -> qpos [Q]`.
PostureFn = Callable[[Array], Array]


def random_joints(model: Any, *, only_limited: bool = False) -> PostureFn:
    """Draws every hinge and slide that has limits within them, evenly.

    Args:
      model: a compiled MuJoCo model.
      only_limited: leave hinges without limits as they are, and draw no angle of them.

    Returns:
      `(key) -> qpos [Q]`; slides without limits, balls and free joints stay put.
    """
    low, high = np.array(model.qpos0), np.array(model.qpos0)
    for joint in range(model.njnt):
        place, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
        is_hinge = kind == int(_C.mjtJoint.mjJNT_HINGE)
        if model.jnt_limited[joint] and (is_hinge or kind == _C.mjtJoint.mjJNT_SLIDE):
            low[place], high[place] = model.jnt_range[joint]
        elif is_hinge and not only_limited:
            low[place], high[place] = -math.pi, math.pi
    least, most = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)

    def draw(key: Array) -> Array:
        return jax.random.uniform(key, (model.nq,), jnp.float32, least, most)

    return draw


def drawn_until(
    draw: Callable[[Array], Array], is_refused: Callable[[Array], Array]
) -> Callable[[Array], Array]:
    """Draws again while what was drawn will not do.

    Args:
      draw: `(key) -> x`; it must come to one that will do.
      is_refused: `(x) -> []`, whether it will not.

    Returns:
      `(key) -> x`.
    """

    def again(tried: tuple[Array, Array]) -> tuple[Array, Array]:
        key, own_key = jax.random.split(tried[0])
        return key, draw(own_key)

    def drawn(key: Array) -> Array:
        first = again((key, jnp.zeros(())))
        return jax.lax.while_loop(lambda tried: is_refused(tried[1]), again, first)[1]

    return drawn


def without_contact(model: Any, posture_fn: PostureFn) -> PostureFn:
    """Draws until nothing touches, as C MuJoCo finds it, whatever steps the trial.

    Args:
      model: a compiled MuJoCo model.
      posture_fn: what draws; it must come to a posture without contact.

    Returns:
      `(key) -> qpos [Q]`.
    """
    return drawn_until(posture_fn, _touches(model))


def lifted(model: Any, posture_fn: PostureFn, place: int) -> PostureFn:
    """Lifts what is drawn from height 0 by whole centimetres until nothing touches.

    Args:
      model: a compiled MuJoCo model.
      posture_fn: what draws.
      place: of the height in qpos.

    Returns:
      `(key) -> qpos [Q]`.
    """
    touches = _touches(model)

    def draw(key: Array) -> Array:
        qpos = posture_fn(key)

        def at(step: Array) -> Array:
            return qpos.at[place].set(_LIFT * step.astype(jnp.float32))

        zero = jnp.zeros((), jnp.int32)
        return at(
            jax.lax.while_loop(lambda step: touches(at(step)), lambda n: n + 1, zero)
        )

    return draw


def _touches(model: Any) -> Callable[[Array], Array]:
    """Returns whether a posture has a contact, `(qpos [Q]) -> []`."""
    num_contacts = native_readings(model, [("ncon", 0)])
    still = jnp.zeros((model.nv,), jnp.float32)
    act = jnp.zeros((model.na,), jnp.float32) if model.na else ()
    idle = jnp.zeros((model.nu,), jnp.float32)

    def touches(qpos: Array) -> Array:
        return num_contacts(qpos, still, still, act, idle)[0] > 0

    return touches
