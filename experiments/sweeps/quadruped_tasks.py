"""Tasks of the suite's quadruped for the study: its own two, and six others.

The six were written down before any arm was run on them. They are made like the
suite's: from 0 to 1 a decision, where its own count once for each of its two steps.
"""

from collections.abc import Callable, Mapping

import jax
from jax import Array

from jaxpets import envs
from jaxpets.envs.tolerance import linear, tolerance
from jaxpets.typing import RewardFn


def tasks() -> Mapping[str, RewardFn]:
    """Returns the rewards by name."""
    robot = envs.make("dmc/quadruped")
    place = [entry.name for entry in robot.env.coordinates].index
    x, y = place("qpos/root.qx"), place("qpos/root.qy")
    ahead, left = place("sensordata/velocimeter.x"), place("sensordata/velocimeter.y")
    turn = place("qvel/root.wz")

    def over(obs: Array) -> Array:  # 0 on the feet, 1 on the back
        return obs[..., x] ** 2 + obs[..., y] ** 2

    def still(obs: Array) -> Array:
        motion = obs[..., ahead] ** 2 + obs[..., left] ** 2 + obs[..., turn] ** 2
        return tolerance(motion, 0.0, 0.0, margin=0.25)

    def upright(reward: Callable[[Array], Array]) -> RewardFn:
        return _of_state(lambda obs: (1.0 - over(obs)) * reward(obs))

    def moves(entry: int, wanted: float, sign: float = 1.0) -> RewardFn:
        """Rewards a rate near the wanted one, in m/s or rad/s."""

        def near(obs: Array) -> Array:
            rate = sign * obs[..., entry]
            margin = {"margin": wanted, "value": 0.5, "shape": linear}
            return tolerance(rate, 0.8 * wanted, 1.5 * wanted, **margin)

        return upright(near)

    return {
        **{name: _own(robot, i) for i, name in enumerate(robot.tasks.names)},
        "jog": moves(ahead, 2.0),
        "walk-backwards": moves(ahead, 0.5, -1.0),
        "walk-left": moves(left, 0.5),
        "turn-left": moves(turn, 1.0),
        "stand": upright(still),
        "on-back": _of_state(lambda obs: over(obs) * still(obs)),
    }


def _own(robot: envs.Robot, i: int) -> RewardFn:
    task = jax.tree.map(lambda x: x[i], robot.tasks.params)
    return lambda constants, *step: robot.tasks.reward_fn(task, *step)


def _of_state(reward: Callable[[Array], Array]) -> RewardFn:
    return lambda constants, obs, action, next_obs: reward(next_obs)
