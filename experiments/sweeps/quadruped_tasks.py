"""Tasks of the suite's quadruped for the study: its own two, and six others.

The six were written down before any arm was run on them. They earn from 0 to 1 a
decision, and nothing at rest but for `stand` and `on-back`; its own two earn twice as
much, once for each control step, and half of that at rest on the feet.
"""

import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets import coordinates, envs
from jaxpets.envs.tolerance import linear, tolerance
from jaxpets.typing import RewardFn

_TALL = 0.7  # m, of 0.9 with all legs stretched; 0.2 is on the floor


def tasks() -> Mapping[str, RewardFn]:
    """Returns the rewards by name."""
    robot = envs.make("dmc/quadruped")
    place = functools.partial(coordinates.index, robot.env.coordinates)
    x, y, height = (place(f"qpos/root.{name}") for name in ("qx", "qy", "z"))
    turn = place("qvel/root.wz")
    turns = jnp.array([place("qvel/root.wx"), place("qvel/root.wy"), turn])
    ahead, left, up = (place(f"sensordata/velocimeter.{axis}") for axis in "xyz")
    speeds = jnp.array([ahead, left, up])

    def over(obs: Array) -> Array:  # 0 on the feet, 1 on the back
        return obs[..., x] ** 2 + obs[..., y] ** 2

    def still(obs: Array) -> Array:
        """Falls to a tenth at 0.5 m/s, or 0.5 rad/s."""
        motion = jnp.sum(obs[..., speeds] ** 2 + obs[..., turns] ** 2, axis=-1)
        return tolerance(motion, 0.0, 0.0, margin=0.25)

    def tall(obs: Array) -> Array:
        return tolerance(
            obs[..., height], _TALL, margin=_TALL - 0.2, value=0.0, shape=linear
        )

    def upright(reward: Callable[[Array], Array]) -> RewardFn:
        return _of_state(lambda obs: (1.0 - over(obs)) * reward(obs))

    def moves(entry: int, wanted: float, sign: float = 1.0) -> RewardFn:
        """Rewards a rate near the wanted one, in m/s or rad/s; nothing at rest."""
        low, high = 0.8 * wanted, 1.5 * wanted
        return upright(
            lambda obs: tolerance(
                sign * obs[..., entry], low, high, margin=low, value=0.0, shape=linear
            )
        )

    return {
        **{name: _own(robot, i) for i, name in enumerate(robot.tasks.names)},
        "jog": moves(ahead, 2.0),
        "walk-backwards": moves(ahead, 0.5, -1.0),
        "walk-left": moves(left, 0.5),
        "turn-left": moves(turn, 1.0),
        "stand": upright(lambda obs: tall(obs) * still(obs)),
        "on-back": _of_state(lambda obs: over(obs) * still(obs)),
    }


def _own(robot: envs.Robot, i: int) -> RewardFn:
    task = jax.tree.map(lambda x: x[i], robot.tasks.params)
    return lambda constants, *step: robot.tasks.reward_fn(task, *step)


def _of_state(reward: Callable[[Array], Array]) -> RewardFn:
    return lambda constants, obs, action, next_obs: reward(next_obs)
