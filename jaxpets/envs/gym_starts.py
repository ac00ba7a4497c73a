"""Where trials of gymnasium's robots start, and what is drawn for each."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets.envs.mujoco_env import ConstantsFn
from jaxpets.envs.starts import drawn_until
from jaxpets.envs.trial_start import ResetFn

_SPEED = 0.005
_OBJECT = ("obj_slidey", "obj_slidex")
_ARM = (
    "r_shoulder_pan_joint", "r_shoulder_lift_joint", "r_upper_arm_roll_joint",
    "r_elbow_flex_joint", "r_forearm_roll_joint", "r_wrist_flex_joint",
    "r_wrist_roll_joint",
)  # fmt: skip
# What moves of Pusher: its goal does not.
PUSHER = tuple(f"{of}/{joint}" for of in ("qpos", "qvel") for joint in _ARM + _OBJECT)


def noise(width: float, *, std: float | None = None) -> Callable[[Any], ResetFn]:
    """All positions are within `width` of the model's own, and so are all velocities.

    Args:
      width: in m and rad.
      std: of velocities that are normal instead, in m/s and rad/s.
    """

    def of_model(model: Any) -> ResetFn:
        rest = jnp.asarray(model.qpos0, jnp.float32)

        def start(key: Array) -> tuple[Array, Array]:
            qpos_key, qvel_key = jax.random.split(key)
            qpos = rest + _even(qpos_key, model.nq, width)
            if std is None:
                return qpos, _even(qvel_key, model.nv, width)
            return qpos, std * jax.random.normal(qvel_key, (model.nv,), jnp.float32)

        return start

    return of_model


def reacher(model: Any) -> ResetFn:
    """The arm is nearly stretched and at rest."""
    rest = jnp.asarray(model.qpos0, jnp.float32)

    def start(key: Array) -> tuple[Array, Array]:
        qpos_key, qvel_key = jax.random.split(key)
        qpos = rest.at[:2].add(_even(qpos_key, 2, 0.1))
        qvel = jnp.zeros((model.nv,), jnp.float32)
        return qpos, qvel.at[:2].set(_even(qvel_key, 2, _SPEED))

    return start


def reacher_target(model: Any) -> ConstantsFn:
    """The target is anywhere on a disc of 0.2 m: x, y."""
    del model

    def draw(key: Array) -> Array:
        radius_key, angle_key = jax.random.split(key)
        # Even over the disc, as what is drawn from a square until it is within.
        radius = 0.2 * jnp.sqrt(jax.random.uniform(radius_key, (), jnp.float32))
        angle = jax.random.uniform(angle_key, (), jnp.float32, 0.0, 2.0 * math.pi)
        return radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    return draw


def pusher(model: Any) -> ResetFn:
    """The object is before its goal, over 0.17 m away, and the arm almost rests."""
    places = [int(model.joint(name).qposadr[0]) for name in _OBJECT]
    low = jnp.asarray([-0.3, -0.2], jnp.float32)
    high = jnp.asarray([0.0, 0.2], jnp.float32)
    rest = jnp.asarray(model.qpos0, jnp.float32)

    def anywhere(key: Array) -> Array:
        return jax.random.uniform(key, (2,), jnp.float32, low, high)

    def is_near(place: Array) -> Array:
        return jnp.sum(place**2) <= 0.17**2

    object_fn = drawn_until(anywhere, is_near)

    def start(key: Array) -> tuple[Array, Array]:
        key, qvel_key = jax.random.split(key)
        place = object_fn(key)
        moving = len(_ARM)
        qvel = jnp.zeros((model.nv,), jnp.float32)
        qvel = qvel.at[:moving].set(_even(qvel_key, moving, _SPEED))
        return rest.at[jnp.array(places)].set(place), qvel

    return start


def _even(key: Array, count: int, width: float) -> Array:
    return jax.random.uniform(key, (count,), jnp.float32, -width, width)
