"""Rewards of gymnasium's robots, of one control step, as functions of what is observed.

The first task of each robot is gymnasium's own reward, version 5 of its environments.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.types import RewardFn
from jaxpets.envs.mujoco_robot import Entry
from jaxpets.envs.recipe import Rewards
from jaxpets.envs.tolerance import holds

# `(observations) -> what a step earns besides`.
HealthFn = Callable[[Array], Array]


def half_cheetah(model: Any, entry: Entry) -> Rewards:
    """Forward in m/s; backward and flipping are ours."""
    del model
    velocity, rate = entry("mean_qvel/rootx"), entry("qvel/rooty")
    return _ways(velocity, 0.1) | _flips(rate, 0.1)


def hopper(model: Any, entry: Entry) -> Rewards:
    """Forward in m/s, and 1 for being upright; backward and flipping are ours."""
    del model
    height, pitch = entry("qpos/rootz"), entry("qpos/rooty")

    def health(obs: Array) -> Array:
        # All entries from the pitch on are positions and velocities.
        calm = jnp.all(jnp.abs(obs[..., pitch:]) < 100.0, axis=-1)
        upright = jnp.abs(obs[..., pitch]) < 0.2
        return (calm & upright & (obs[..., height] > 0.7)).astype(jnp.float32)

    velocity, rate = entry("mean_qvel/rootx"), entry("qvel/rooty")
    return _ways(velocity, 1e-3, health) | _flips(rate, 1e-3)


def walker2d(model: Any, entry: Entry) -> Rewards:
    """Forward in m/s, and 1 for being upright; backward and flipping are ours."""
    del model
    height, pitch = entry("qpos/rootz"), entry("qpos/rooty")

    def health(obs: Array) -> Array:
        high = (obs[..., height] > 0.8) & (obs[..., height] < 2.0)
        return (high & (jnp.abs(obs[..., pitch]) < 1.0)).astype(jnp.float32)

    velocity, rate = entry("mean_qvel/rootx"), entry("qvel/rooty")
    return _ways(velocity, 1e-3, health) | _flips(rate, 1e-3)


def swimmer(model: Any, entry: Entry) -> Rewards:
    """Forward in m/s; backward is ours."""
    del model
    return _ways(entry("mean_qvel/slider1"), 1e-4)


def ant(model: Any, entry: Entry) -> Rewards:
    """Forward in m/s, and 1 for its height; backward is ours.

    Without gymnasium's cost of contacts, at most 0.04 a step, whose forces nobody
    observes.
    """
    del model
    height = entry("qpos/root.z")

    def health(obs: Array) -> Array:
        high = (obs[..., height] >= 0.2) & (obs[..., height] <= 1.0)
        return high.astype(jnp.float32)

    return _ways(entry("mean_qvel/root.x"), 0.5, health)


def humanoid(model: Any, entry: Entry) -> Rewards:
    """Forward, 1.25 for each m/s, and 5 for its height; backward is ours.

    The velocity is that of the centre of mass, at the end of the step and not its mean;
    gymnasium's cost of contacts is left out, whose forces nobody observes.
    """
    del model
    height = entry("qpos/root.z")

    def health(obs: Array) -> Array:
        high = (obs[..., height] > 1.0) & (obs[..., height] < 2.0)
        return 5.0 * high.astype(jnp.float32)

    return _ways(entry("subtree_linvel/torso.x"), 0.1, health, weight=1.25)


def inverted_pendulum(model: Any, entry: Entry) -> Rewards:
    """1 while the pole is within 0.2 rad of upright."""
    del model
    hinge = entry("qpos/hinge")

    def balance(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del constants, obs, action
        angle = next_obs[..., hinge]
        return holds(jnp.abs(angle) <= 0.2, angle)

    return {"balance": balance}


def reacher(model: Any, entry: Entry) -> Rewards:
    """The finger's distance to the target of the trial, x and y in m."""
    first, second = entry("qpos/joint0"), entry("qpos/joint1")
    arm, hand = (float(model.body(name).pos[0]) for name in ("body1", "fingertip"))

    def reach(target: Array, obs: Array, action: Array, next_obs: Array) -> Array:
        del obs
        one = next_obs[..., first]
        both = one + next_obs[..., second]
        x = arm * jnp.cos(one) + hand * jnp.cos(both) - target[..., 0]
        y = arm * jnp.sin(one) + hand * jnp.sin(both) - target[..., 1]
        return -jnp.sqrt(x**2 + y**2) - _square(action)

    return {"reach": reach}


def pusher(model: Any, entry: Entry) -> Rewards:
    """How far the object is from its goal, and half of how far the hand is from it."""
    hand = np.array([entry(f"xpos/tips_arm.{axis}") for axis in "xyz"])
    slide_x, slide_y = entry("qpos/obj_slidex"), entry("qpos/obj_slidey")
    start = jnp.asarray(model.body("object").pos, jnp.float32)
    goal = jnp.asarray(model.body("goal").pos, jnp.float32)

    def push(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del constants, obs
        x, y = next_obs[..., slide_x], next_obs[..., slide_y]
        place = start + jnp.stack([x, y, jnp.zeros_like(x)], axis=-1)
        near, far = _norm(place - next_obs[..., hand]), _norm(place - goal)
        return -far - 0.5 * near - 0.1 * _square(action)

    return {"push": push}


def _ways(
    velocity: int,
    control_cost: float,
    health_fn: HealthFn | None = None,
    weight: float = 1.0,
) -> dict[str, RewardFn]:
    def way(sign: float) -> RewardFn:
        def reward(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
            del constants, obs
            earned = sign * weight * next_obs[..., velocity]
            if health_fn is not None:
                earned = earned + health_fn(next_obs)
            return earned - control_cost * _square(action)

        return reward

    return {"forward": way(1.0), "backward": way(-1.0)}


def _flips(rate: int, control_cost: float) -> dict[str, RewardFn]:
    """Turning over in rad/s, nose down in a front flip, however it lies."""
    ways = _ways(rate, control_cost)
    return {"front-flip": ways["forward"], "back-flip": ways["backward"]}


def _square(action: Array) -> Array:
    return jnp.sum(action**2, axis=-1)


def _norm(vector: Array) -> Array:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1))
