"""Where trials of the DeepMind Control Suite start, and what is drawn for each."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets.envs.mujoco_env import ConstantsFn
from jaxpets.envs.starts import PostureFn, lifted, random_joints, without_contact
from jaxpets.envs.trial_start import ResetFn


def joints(model: Any) -> ResetFn:
    """All joints that turn or have limits are anywhere in their ranges."""
    return _at_rest(model, random_joints(model))


def limited_joints(model: Any) -> ResetFn:
    """All joints that have limits are anywhere within them."""
    return _at_rest(model, random_joints(model, only_limited=True))


def joints_without_contact(model: Any) -> ResetFn:
    """As `joints`, drawn until nothing touches."""
    return _at_rest(model, without_contact(model, random_joints(model)))


def ball_in_cup(model: Any) -> ResetFn:
    """The cup is in the middle, the ball around it and not touching."""
    box = {"ball_x": (-0.2, 0.2), "ball_z": (0.2, 0.5)}
    return _at_rest(model, without_contact(model, _in_box(model, box)))


def any_orientation(model: Any) -> ResetFn:
    """The free joint is turned evenly over all rotations, just above the floor."""

    def turned(key: Array) -> Array:
        turn = jax.random.normal(key, (4,), jnp.float32)
        quaternion = turn / jnp.sqrt(jnp.sum(turn**2))
        start = jnp.asarray(model.qpos0, jnp.float32).at[:2].set(0.0)
        return start.at[3:7].set(quaternion)

    return _at_rest(model, lifted(model, turned, 2))


def pole_down(model: Any) -> ResetFn:
    """The cart is in the middle and its pole hangs, within 0.01 of rest."""

    def start(key: Array) -> tuple[Array, Array]:
        position, speed = 0.01 * jax.random.normal(key, (2, model.nq), jnp.float32)
        return position + jnp.asarray([0.0, math.pi], jnp.float32), speed

    return start


def pole_up(model: Any) -> ResetFn:
    """The cart is near the middle and its pole near upright, almost at rest."""
    box = {"slider": (-0.1, 0.1), "hinge_1": (-0.034, 0.034)}
    posture_fn = _in_box(model, box)

    def start(key: Array) -> tuple[Array, Array]:
        key, speed_key = jax.random.split(key)
        speed = jax.random.normal(speed_key, (model.nv,), jnp.float32)
        return posture_fn(key), 0.01 * speed

    return start


def finger_target(model: Any) -> ConstantsFn:
    """The target is on the circle of the spinner's tip; x, z from its hinge."""
    radius = float(np.sum(model.geom("cap1").size))

    def draw(key: Array) -> Array:
        angle = jax.random.uniform(key, (), jnp.float32, -math.pi, math.pi)
        return radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])

    return draw


def reacher_target(model: Any) -> ConstantsFn:
    """The target is 0.05 m to 0.2 m from the shoulder: x, y."""
    del model

    def draw(key: Array) -> Array:
        angle_key, radius_key = jax.random.split(key)
        angle = jax.random.uniform(angle_key, (), jnp.float32, 0.0, 2.0 * math.pi)
        radius = jax.random.uniform(radius_key, (), jnp.float32, 0.05, 0.2)
        return radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])

    return draw


def _at_rest(model: Any, posture_fn: Callable[[Array], Array]) -> ResetFn:
    still = jnp.zeros((model.nv,), jnp.float32)
    return lambda key: (posture_fn(key), still)


def _in_box(model: Any, box: dict[str, tuple[float, float]]) -> PostureFn:
    """Draws some joints evenly, and leaves the others as they are."""
    places = np.array([int(model.joint(name).qposadr[0]) for name in box])
    low, high = jnp.asarray(list(box.values()), jnp.float32).T
    rest = jnp.asarray(model.qpos0, jnp.float32)

    def draw(key: Array) -> Array:
        drawn = jax.random.uniform(key, low.shape, jnp.float32, low, high)
        return rest.at[places].set(drawn)

    return draw
