"""Tasks of HalfCheetah for the study: the paper's four, and twelve others.

They were written down before any arm was run on them. None is negative where a robot
does what it asks, so that a return is a share of what the simulator as the model
reaches. `upright` is a measure too: every trial is scored by every task, and its score
by this one is how many of its steps were upright.
"""

from collections.abc import Mapping

import jax.numpy as jnp
from jax import Array

from jaxpets.envs import half_cheetah as cheetah
from jaxpets.typing import RewardFn

_UPRIGHT = 0.7  # rad


def tasks() -> Mapping[str, RewardFn]:
    """Returns the rewards by name."""
    return {
        "forward": lambda *step: _velocity(step) - _effort(step),
        "backward": lambda *step: -_velocity(step) - _effort(step),
        "front-flip": lambda *step: _pitch_rate(step) - _effort(step),
        "back-flip": lambda *step: -_pitch_rate(step) - _effort(step),
        "run-upright": lambda *step: _velocity(step) - _tilt(step) - _effort(step),
        "back-upright": lambda *step: -_velocity(step) - _tilt(step) - _effort(step),
        "slow": lambda *step: _at(_velocity(step), 2.0, 1.0) * upright(*step),
        "fast-back": lambda *step: _at(_velocity(step), -4.0, 2.0) * upright(*step),
        "jump": lambda *step: 5.0 * _height(step) - _tilt(step) - _effort(step),
        "crouch": lambda *step: _at(_height(step), -0.25, 0.05) * upright(*step),
        "on-back": lambda *step: _still(step) * (1.0 - jnp.cos(_pitch(step))) / 2.0,
        "rear-up": lambda *step: _still(step) * (1.0 - jnp.sin(_pitch(step))) / 2.0,
        "nose-stand": lambda *step: _still(step) * (1.0 + jnp.sin(_pitch(step))) / 2.0,
        "hind-walk": lambda *step: 0.5 * _velocity(step) - jnp.sin(_pitch(step)),
        "turn-a-second": lambda *step: _at(_pitch_rate(step), 2.0 * jnp.pi, 2.0),
        "upright": upright,
    }


def upright(constants: None, obs: Array, action: Array, next_obs: Array) -> Array:
    """Rewards a body that is not tilted by more than 40 degrees."""
    del constants, obs, action
    return (_tilted(next_obs) < _UPRIGHT).astype(next_obs.dtype)


_Step = tuple[None, Array, Array, Array]


def _velocity(step: _Step) -> Array:
    return step[-1][..., cheetah.FORWARD_VELOCITY]


def _pitch(step: _Step) -> Array:
    return step[-1][..., cheetah.PITCH]


def _pitch_rate(step: _Step) -> Array:
    return step[-1][..., cheetah.PITCH_RATE]


def _height(step: _Step) -> Array:
    return step[-1][..., cheetah.HEIGHT]


def _effort(step: _Step) -> Array:
    return 0.1 * jnp.sum(step[2] ** 2, axis=-1)


def _tilted(next_obs: Array) -> Array:
    """Returns by how much the body is tilted, 0 to pi, however often it has turned."""
    pitch = next_obs[..., cheetah.PITCH]
    return jnp.abs(jnp.arctan2(jnp.sin(pitch), jnp.cos(pitch)))


def _tilt(step: _Step) -> Array:
    return 10.0 * jnp.maximum(_tilted(step[-1]) - _UPRIGHT, 0.0)


def _still(step: _Step) -> Array:
    return _at(_pitch_rate(step), 0.0, 2.0)


def _at(value: Array, wanted: float, width: float) -> Array:
    """Returns 1 at what is wanted, a half where it is a width away, and never 0."""
    return 1.0 / (1.0 + ((value - wanted) / width) ** 2)
