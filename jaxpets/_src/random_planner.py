"""Actions that nothing decides about, independent or correlated over time."""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxpets._src.action_box import ActionBox, action_box
from jaxpets._src.checks import (
    check_array,
    check_count,
    check_key,
    check_real,
    check_record,
)
from jaxpets._src.icem import colored_noise
from jaxpets._src.types import Planner, PlanOutput, PlanParams


class ColoredNoise(NamedTuple):
    """A sequence of coloured noise, and how far it has been used.

    Attributes:
      noise: `[period, A]`, of unit variance.
      step: `[]` int32, the next row; the period, if there is none left.
    """

    noise: Array
    step: Array


def random_planner(
    action_low: ArrayLike,
    action_high: ArrayLike,
    *,
    noise_beta: float = 0.0,
    period: int = 1000,
) -> Planner:
    """Builds a planner that draws actions uniformly from the box.

    The random arm of the paper, and the first trial of every other arm. With a
    `noise_beta` an action resembles those before it (Eberhard et al., 2023): the power
    of frequency f is `1 / f^noise_beta`, and the robot is moved further than by
    independent actions, whose effects cancel. Every action is uniform by itself all the
    same, as Gaussian noise is sent through its own distribution function; Eberhard et
    al. add the noise to a policy and clip.

    Args:
      action_low: `[A]`.
      action_high: `[A]`.
      noise_beta: exponent of the noise; 0 is white, 1 pink, 2 a random walk.
      period: steps after which the noise is drawn anew, at best the length of a trial.
        White noise has none.

    Returns:
      A Planner whose plans have length one and value zero. The state of white noise is
      empty.

    Raises:
      TypeError, ValueError: if the box is not finite or empty, noise_beta negative or
        period below 2.
    """
    box = action_box(action_low, action_high)
    noise_beta = check_real("noise_beta", noise_beta, 0.0)
    period = check_count("period", period, minimum=2)
    if noise_beta:
        return _colored(box, noise_beta, period)

    def step(
        params: PlanParams, key: Array, state: tuple[()], obs: Any
    ) -> tuple[PlanOutput, tuple[()]]:
        del params, obs
        check_key("key", key)
        uniform = jax.random.uniform(key, box.low.shape, jnp.float32)
        return _output(box, uniform), state

    return Planner(tuple, step)


def _colored(box: ActionBox, beta: float, period: int) -> Planner:
    shape = (period, *box.low.shape)

    def init() -> ColoredNoise:
        # There is no key here: the first step draws.
        return ColoredNoise(
            jnp.zeros(shape, jnp.float32), jnp.full((), period, jnp.int32)
        )

    def step(
        params: PlanParams, key: Array, state: ColoredNoise, obs: Any
    ) -> tuple[PlanOutput, ColoredNoise]:
        del params, obs
        check_key("key", key)
        check_record("state", state, ColoredNoise)
        check_array("state.noise", state.noise, shape)

        def draw(key: Array) -> ColoredNoise:
            return ColoredNoise(
                colored_noise(key, beta, shape), jnp.zeros((), jnp.int32)
            )

        def keep(key: Array) -> ColoredNoise:
            del key
            return state

        left = cast(ColoredNoise, jax.lax.cond(state.step < period, keep, draw, key))
        unit = jax.scipy.stats.norm.cdf(left.noise[left.step])
        return _output(box, unit), left._replace(step=left.step + 1)

    return Planner(init, step)


def _output(box: ActionBox, unit: Array) -> PlanOutput:
    """Returns the action at `unit` `[A]` of the way from the low to the high bound."""
    action = box.low + (box.high - box.low) * unit
    return PlanOutput(action, action[None], jnp.zeros((), jnp.float32))
