"""Robots by the names under which people know them."""

import functools
from collections.abc import Callable

from jaxpets._src.checks import nearest
from jaxpets.envs import half_cheetah
from jaxpets.envs.dmc import DOMAINS, dmc
from jaxpets.envs.gym import ROBOTS, gym
from jaxpets.envs.robot import Axis, Robot, Tasks

_VELOCITY_EDGES = tuple(i / 2 for i in range(-16, 17))  # m/s
_PITCH_RATE_EDGES = tuple(float(i) for i in range(-15, 16))  # rad/s


def names() -> tuple[str, ...]:
    """Returns what `make` takes."""
    return tuple(_MAKERS)


def make(name: str, *, backend: str = "mujoco") -> Robot:
    """Builds a robot by its name.

    Args:
      name: one of `names()`, as "pets/half_cheetah".
      backend: "mujoco", C on the cores of the host, or "mjx", JAX on the device.

    Raises:
      ValueError: if there is no such name; the nearest are said. Or for a backend that
        is none, or cannot step this robot.
      ImportError: if the package that has its model is missing; it names the extra.
    """
    if name not in _MAKERS:
        near = ", ".join(nearest(name, names()) or names())
        raise ValueError(f"name must be a robot, as {near}, got {name!r}.")
    return _MAKERS[name](backend)


def _half_cheetah(backend: str) -> Robot:
    """HalfCheetah as PETS has it, with the four tasks of the paper."""
    engines = {
        "mujoco": half_cheetah.half_cheetah_native,
        "mjx": half_cheetah.half_cheetah,
    }
    if backend not in engines:
        raise ValueError(f'backend must be "mujoco" or "mjx", got {backend!r}.')
    velocity = Axis("velocity", "m/s", half_cheetah.FORWARD_VELOCITY, _VELOCITY_EDGES)
    pitch_rate = Axis("pitch_rate", "rad/s", half_cheetah.PITCH_RATE, _PITCH_RATE_EDGES)
    return Robot(
        name="pets/half_cheetah",
        env=engines[backend](),
        space=half_cheetah.model_space(),
        tasks=Tasks(
            half_cheetah.TASK_NAMES, half_cheetah.task_reward, half_cheetah.tasks()
        ),
        axes=(velocity, pitch_rate),
        angle=half_cheetah.PITCH,
        model=half_cheetah.load_model(),
        qpos_fn=half_cheetah.qpos_from_obs,
        camera="track",
    )


_MAKERS: dict[str, Callable[[str], Robot]] = {
    "pets/half_cheetah": _half_cheetah,
    **{f"dmc/{name}": functools.partial(dmc, name) for name in DOMAINS},
    **{f"gym/{name}": functools.partial(gym, name) for name in ROBOTS},
}
