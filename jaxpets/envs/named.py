"""Robots by the names under which people know them."""

import functools
from collections.abc import Callable

from jaxpets._src.checks import check_text, nearest
from jaxpets.envs import half_cheetah
from jaxpets.envs.dmc import DOMAINS, dmc
from jaxpets.envs.gym import ROBOTS, gym
from jaxpets.envs.registries import REGISTRIES, registered
from jaxpets.envs.robot import Axis, Robot, Tasks

_BACKENDS = ("mujoco", "mjx")
_VELOCITY_EDGES = tuple(i / 2 for i in range(-16, 17))  # m/s
_PITCH_RATE_EDGES = tuple(float(i) for i in range(-15, 16))  # rad/s


def names() -> tuple[str, ...]:
    """Returns what `make` takes, besides what is in `registries`."""
    return tuple(_MAKERS)


def registries() -> dict[str, str]:
    """Returns packages of whose names `make` takes any, as `brax/ant`.

    The values say where a package lists them, as `brax.envs`; it is not imported.
    """
    return {package: registry.where for package, registry in REGISTRIES.items()}


def make(name: str, *, backend: str = "mujoco") -> Robot:
    """Builds a robot by its name.

    Args:
      name: one of `names()`, as "pets/half_cheetah", or one of a package in
        `registries`, as "brax/ant" or "playground/CheetahRun".
      backend: "mujoco", C on the cores of the host, or "mjx", JAX on the device. Those
        of a package have an engine of their own in JAX, and never another.

    Raises:
      TypeError, ValueError: if there is no such name; the nearest are said. Or for a
        backend that is none, or cannot step this robot.
      ImportError: if the package that has its model is missing; it names the extra.
    """
    if backend not in _BACKENDS:
        raise ValueError(f'backend must be "mujoco" or "mjx", got {backend!r}.')
    check_text("name", name)
    package, _, own = name.partition("/")
    if package in REGISTRIES:
        return registered(package, own)
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
        step_time=half_cheetah.TIMESTEP,
    )


_MAKERS: dict[str, Callable[[str], Robot]] = {
    "pets/half_cheetah": _half_cheetah,
    **{f"dmc/{name}": functools.partial(dmc, name) for name in DOMAINS},
    **{f"gym/{name}": functools.partial(gym, name) for name in ROBOTS},
}
