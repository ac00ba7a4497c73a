"""A robot from an MJCF: its environment, its tasks, and what videos need."""

from collections.abc import Callable, Mapping
from typing import Any

from jaxpets._src.checks import check_callable, check_real, check_text, is_sequence
from jaxpets._src.coordinates import index, space
from jaxpets._src.types import Coordinate, RewardFn
from jaxpets.envs.mujoco_env import load_model, mujoco_env
from jaxpets.envs.robot import Axis, Robot, tasks_of
from jaxpets.envs.tracks import qpos_fn

# `(entry's name) -> its place in the observation`.
Entry = Callable[[str], int]
# Name, unit, entry, and the end of a histogram's bins on both sides of 0.
Shown = tuple[str, str, str, float]


def mujoco_robot(
    name: str,
    model: Any,
    tasks: Callable[[Entry], Mapping[str, RewardFn]],
    *,
    axes: tuple[Shown, Shown] | tuple[()] = (),
    angle: str | None = None,
    camera: str | None = None,
    control_step: float = 0.05,
    action_repeat: int = 1,
    **env_settings: Any,
) -> Robot:
    """Builds a robot from a MuJoCo model: explored, told what to do, and drawn.

    As in::

      def tasks(entry):
          speed = entry("qvel/x")
          return {"fast": lambda constants, obs, action, next_obs: next_obs[..., speed]}

      robot = mujoco_robot("cart", "cart.xml", tasks)

    Args:
      name: of the robot.
      model: a path to an MJCF, its text, or a compiled MuJoCo model.
      tasks: `(entry) -> rewards` by name, as `tasks_of` takes them; `entry("qpos/x")`
        is the place of an entry in the observation.
      axes: two quantities by which exploration is shown: name, unit, entry, and where
        the bins of a histogram end, as `("speed", "m/s", "qvel/x", 2.0)`; or none.
      angle: the entry, unwrapped and in rad, of which net turns are counted, if any.
      camera: of the model, to draw it by; None for one that suits it.
      control_step: as `mujoco_env` takes it, in s.
      action_repeat: as there.
      **env_settings: the others of `mujoco_env`: observe, reset, terminal_fn,
        settle_time, constants, backend, num_threads.

    Raises:
      TypeError, ValueError, FileNotFoundError: as `mujoco_env`, for an entry, an axis
        or a camera that is none, and unless there is a task.
    """
    check_text("name", name)
    check_callable("tasks", tasks)
    _check_axes(axes)
    model = load_model(model)
    _check_camera(model, camera)
    env = mujoco_env(
        model, control_step=control_step, action_repeat=action_repeat, **env_settings
    )
    rows, step_time = env.coordinates, control_step * action_repeat
    shown: Any = tuple(_axis(rows, *axis) for axis in axes)
    return Robot(
        name=name,
        env=env,
        space=space(rows),
        tasks=tasks_of(tasks(lambda entry: index(rows, entry))),
        axes=shown,
        angle=None if angle is None else index(rows, angle),
        model=model,
        qpos_fn=qpos_fn(model, rows, step_time),
        camera=camera,
        action_repeat=action_repeat,
        step_time=step_time,
    )


def _check_axes(axes: Any) -> None:
    if not is_sequence(axes) or len(axes) not in {0, 2}:
        raise ValueError(f"axes must be two of (name, unit, entry, end), got {axes!r}.")
    for axis in axes:
        if not is_sequence(axis) or len(axis) != len(Axis._fields):
            raise ValueError(f"an axis must be (name, unit, entry, end), got {axis!r}.")
        if not check_real("the end of an axis", axis[-1], 0.0):
            raise ValueError("the end of an axis must be above 0, got 0.")


def _check_camera(model: Any, camera: Any) -> None:
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera is not None and camera not in names:
        raise ValueError(f"camera must be one of the model, {names}, got {camera!r}.")


def _axis(
    rows: tuple[Coordinate, ...], name: str, unit: str, entry: str, end: float
) -> Axis:
    edges = tuple(end * i / 15 for i in range(-15, 16))
    return Axis(name, unit, index(rows, entry), edges)
