"""Rewards of the DeepMind Control Suite, as functions of what a robot observes.

Tassa et al., "DeepMind Control Suite", 2018. Each is in [0, 1] in the state that was
reached. What dm_control reads of the simulator follows here from the observation: from
positions where the geometry is simple and exact, else from an entry that carries it.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxpets._src.types import RewardFn
from jaxpets.envs.mujoco_robot import Entry
from jaxpets.envs.recipe import Rewards
from jaxpets.envs.tolerance import holds, linear, quadratic, tolerance

_SPIN_RATE = 10.0  # rad/s, of a flip; ours
_TORSO_SPEED = "sensordata/torso_subtreelinvel.x"


def acrobot(model: Any, entry: Entry) -> Rewards:
    """Swing-up: the tip within the target; smooth, or all or nothing."""
    shoulder, elbow = entry("qpos/shoulder"), entry("qpos/elbow")
    upper, lower = (
        float(model.body("lower_arm").pos[2]),
        float(model.site("tip").pos[2]),
    )
    up = float(model.site("target").pos[2] - model.body("upper_arm").pos[2])
    radius = float(model.site("target").size[0])

    def distance(obs: Array) -> Array:
        first = obs[..., shoulder]
        second = first + obs[..., elbow]
        x = upper * jnp.sin(first) + lower * jnp.sin(second)
        z = upper * jnp.cos(first) + lower * jnp.cos(second) - up
        return jnp.sqrt(x**2 + z**2)

    return {
        "swingup": _of_state(
            lambda obs: tolerance(distance(obs), high=radius, margin=1.0)
        ),
        "swingup-sparse": _of_state(lambda obs: tolerance(distance(obs), high=radius)),
    }


def cartpole(model: Any, entry: Entry) -> Rewards:
    """A pole upright over the middle of the rail; swing-up only starts elsewhere."""
    del model
    slider, hinge = entry("qpos/slider"), entry("qpos/hinge_1")
    hinge_velocity = entry("qvel/hinge_1")

    def smooth(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del constants, obs
        upright = (jnp.cos(next_obs[..., hinge]) + 1.0) / 2.0
        centered = tolerance(next_obs[..., slider], 0.0, 0.0, margin=2.0)
        still = tolerance(next_obs[..., hinge_velocity], 0.0, 0.0, margin=5.0)
        weak = _small_control(action)
        return upright * weak * (1.0 + still) / 2.0 * (1.0 + centered) / 2.0

    def sparse(obs: Array) -> Array:
        centered = tolerance(obs[..., slider], -0.25, 0.25)
        return centered * tolerance(jnp.cos(obs[..., hinge]), 0.995)

    return {
        "balance": smooth,
        "balance-sparse": _of_state(sparse),
        "swingup": smooth,
        "swingup-sparse": _of_state(sparse),
    }


def cheetah(model: Any, entry: Entry) -> Rewards:
    """Running at 10 m/s; backwards, jumping and flipping are ours."""
    height, rest = entry("qpos/rootz"), float(model.body("torso").pos[2])
    speed = entry(_TORSO_SPEED)

    def fast(velocity: Array) -> Array:
        return tolerance(velocity, 10.0, margin=10.0, value=0.0, shape=linear)

    def high(obs: Array) -> Array:  # nothing at rest, all 0.5 m above it
        return tolerance(
            rest + obs[..., height], rest + 0.5, margin=0.5, value=0.0, shape=linear
        )

    return {
        "run": _of_state(lambda obs: fast(obs[..., speed])),
        "run-backwards": _of_state(lambda obs: fast(-obs[..., speed])),
        "jump": _of_state(high),
        **_flips(entry),
    }


def ball_in_cup(model: Any, entry: Entry) -> Rewards:
    """The ball is in the cup, or it is not."""
    axes = ((0, "x"), (2, "z"))
    cup = [entry(f"qpos/cup_{axis}") for _, axis in axes]
    ball = [entry(f"qpos/ball_{axis}") for _, axis in axes]
    target = model.body("cup").pos + model.site("target").pos - model.body("ball").pos
    room = model.site("target").size - model.geom("ball").size[0]

    def catch(obs: Array) -> Array:
        away = [
            jnp.abs(obs[..., c] - obs[..., b] + float(target[i]))
            for (i, _), c, b in zip(axes, cup, ball, strict=True)
        ]
        inside = [x < float(room[i]) for (i, _), x in zip(axes, away, strict=True)]
        return holds(inside[0] & inside[1], away[0] + away[1])

    return {"catch": _of_state(catch)}


def finger_spin(model: Any, entry: Entry) -> Rewards:
    """The spinner turns at 15 rad/s."""
    del model
    rate = entry("qvel/hinge")
    return {"spin": _of_state(lambda obs: tolerance(obs[..., rate], high=-15.0))}


def finger(model: Any, entry: Entry) -> Rewards:
    """The tip of the spinner is at the target of the trial, x and z from the hinge."""
    hinge, length = entry("qpos/hinge"), float(model.site("tip").pos[2])

    def turn(radius: float) -> RewardFn:
        def reward(target: Array, obs: Array, action: Array, next_obs: Array) -> Array:
            del obs, action
            angle = next_obs[..., hinge]
            x, z = -length * jnp.sin(angle), length * jnp.cos(angle)
            far = jnp.sqrt((x - target[..., 0]) ** 2 + (z - target[..., 1]) ** 2)
            return tolerance(far, high=radius)

        return reward

    return {"turn-easy": turn(0.07), "turn-hard": turn(0.03)}


def hopper(model: Any, entry: Entry) -> Rewards:
    """Standing, and hopping at 2 m/s; backwards and flipping are ours."""
    del model
    torso, foot = entry("xipos/torso.z"), entry("xipos/foot.z")
    speed = entry(_TORSO_SPEED)

    def standing(obs: Array) -> Array:
        return tolerance(obs[..., torso] - obs[..., foot], 0.6, 2.0)

    def fast(velocity: Array) -> Array:
        return tolerance(velocity, 2.0, margin=1.0, value=0.5, shape=linear)

    def stand(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del constants, obs
        return standing(next_obs) * _small_control(action)

    return {
        "stand": stand,
        "hop": _of_state(lambda obs: standing(obs) * fast(obs[..., speed])),
        "hop-backwards": _of_state(lambda obs: standing(obs) * fast(-obs[..., speed])),
        **_flips(entry),
    }


def pendulum(model: Any, entry: Entry) -> Rewards:
    """Within 8 degrees of upright."""
    del model
    hinge, bound = entry("qpos/hinge"), math.cos(math.radians(8.0))
    return {
        "swingup": _of_state(lambda obs: tolerance(jnp.cos(obs[..., hinge]), bound))
    }


def quadruped(model: Any, entry: Entry) -> Rewards:
    """Upright, walking at 0.5 m/s and running at 5 m/s."""
    del model
    x, y = entry("qpos/root.qx"), entry("qpos/root.qy")
    speed = entry("sensordata/velocimeter.x")

    def move(wanted: float) -> RewardFn:
        def reward(obs: Array) -> Array:
            upright = 1.0 - obs[..., x] ** 2 - obs[..., y] ** 2
            fast = tolerance(
                obs[..., speed], wanted, margin=wanted, value=0.5, shape=linear
            )
            return upright * fast

        return _of_state(reward)

    return {"walk": move(0.5), "run": move(5.0)}


def reacher(model: Any, entry: Entry) -> Rewards:
    """The finger is at the target of the trial, x and y."""
    shoulder, wrist = entry("qpos/shoulder"), entry("qpos/wrist")
    arm, hand = (float(model.body(name).pos[0]) for name in ("hand", "finger"))
    own_radius = float(model.geom("finger").size[0])

    def reach(radius: float) -> RewardFn:
        def reward(target: Array, obs: Array, action: Array, next_obs: Array) -> Array:
            del obs, action
            first = next_obs[..., shoulder]
            second = first + next_obs[..., wrist]
            x = arm * jnp.cos(first) + hand * jnp.cos(second) - target[..., 0]
            y = arm * jnp.sin(first) + hand * jnp.sin(second) - target[..., 1]
            return tolerance(jnp.sqrt(x**2 + y**2), high=radius + own_radius)

        return reward

    return {"easy": reach(0.05), "hard": reach(0.015)}


def walker(model: Any, entry: Entry) -> Rewards:
    """Standing, walking at 1 m/s, running at 8 m/s; backwards and flipping are ours."""
    height, pitch = entry("qpos/rootz"), entry("qpos/rooty")
    rest, speed = float(model.body("torso").pos[2]), entry(_TORSO_SPEED)

    def stand(obs: Array) -> Array:
        high = tolerance(rest + obs[..., height], 1.2, margin=0.6)
        return (3.0 * high + (1.0 + jnp.cos(obs[..., pitch])) / 2.0) / 4.0

    def move(wanted: float, sign: float = 1.0) -> RewardFn:
        def reward(obs: Array) -> Array:
            velocity = sign * obs[..., speed]
            fast = tolerance(
                velocity, wanted, margin=wanted / 2.0, value=0.5, shape=linear
            )
            return stand(obs) * (5.0 * fast + 1.0) / 6.0

        return _of_state(reward)

    return {
        "stand": _of_state(stand),
        "walk": move(1.0),
        "run": move(8.0),
        "walk-backwards": move(1.0, -1.0),
        "run-backwards": move(8.0, -1.0),
        **_flips(entry),
    }


def _of_state(reward: Callable[[Array], Array]) -> RewardFn:
    """Returns a reward that reads nothing but the state that was reached."""

    def of_step(constants: Any, obs: Array, action: Array, next_obs: Array) -> Array:
        del constants, obs, action
        return reward(next_obs)

    return of_step


def _small_control(action: Array) -> Array:
    """Returns 1 for no control, 0.8 for controls of 1, `[...]` of `[..., A]`."""
    small = tolerance(action, 0.0, 0.0, margin=1.0, value=0.0, shape=quadratic)
    return (4.0 + jnp.mean(small, axis=-1)) / 5.0


def _flips(entry: Entry) -> Rewards:
    """Turning over, nose down in a front flip."""
    rate = entry("qvel/rooty")

    def spin(sign: float) -> RewardFn:
        return _of_state(
            lambda obs: tolerance(
                sign * obs[..., rate],
                _SPIN_RATE,
                margin=_SPIN_RATE,
                value=0.0,
                shape=linear,
            )
        )

    return {"front-flip": spin(1.0), "back-flip": spin(-1.0)}
