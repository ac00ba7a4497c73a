"""What draws a robot, frame by frame, with MuJoCo and OpenGL.

As a program it draws a ball, and so finds out whether it can.
"""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

NO_GL = 69  # exit code where OpenGL does not work; EX_UNAVAILABLE
_BALL = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"


class Look(NamedTuple):
    """Size in pixels and frames per second."""

    width: int = 640
    height: int = 360
    fps: int = 20  # steps of the environment a second of video


Draw = Callable[[np.ndarray], np.ndarray]  # qpos [Q] -> picture [height, width, 3]


def open_renderer(model: Any, look: Look, camera: str | None) -> Draw:
    """Returns what draws a robot; fails, in many ways, where OpenGL does not work.

    Args:
      model: a compiled MuJoCo model.
      look: of the pictures.
      camera: of the model; None for one that suits it.
    """
    import mujoco

    gl: Any = mujoco  # its stubs lack half of it
    model.vis.global_.offwidth, model.vis.global_.offheight = look.width, look.height
    renderer, data = gl.Renderer(model, look.height, look.width), gl.MjData(model)
    view = _camera(model) if camera is None else camera
    period = _floor_period(model)

    def draw(qpos: np.ndarray) -> np.ndarray:
        data.qpos[:] = qpos
        if period is not None:
            data.qpos[0] %= period
        gl.mj_forward(model, data)
        renderer.update_scene(data, camera=view)
        return renderer.render()

    return draw


def _camera(model: Any) -> Any:
    """Returns the camera of the model, or one that follows its first body.

    One that is called `track` comes before others.
    """
    import mujoco

    gl: Any = mujoco
    if model.ncam:
        names = [model.camera(i).name for i in range(model.ncam)]
        return names.index("track") if "track" in names else 0
    camera = gl.MjvCamera()
    camera.type, camera.trackbodyid = gl.mjtCamera.mjCAMERA_TRACKING, model.nbody > 1
    camera.distance = 2.0 * model.stat.extent
    return camera


def _floor_period(model: Any) -> float | None:
    """Returns by how many m the floor looks the same; None where the robot is fixed.

    A good runner leaves the floor and the light. The floor's pattern repeats, so a
    robot put back by whole periods looks the same and stays in the middle.
    """
    import mujoco

    gl: Any = mujoco
    geoms = {model.geom(i).name: model.geom(i) for i in range(model.ngeom)}
    floor, root = geoms.get("floor"), model.joint(0)
    slides = root.type[0] == gl.mjtJoint.mjJNT_SLIDE and root.axis[0] == 1
    if floor is None or floor.matid[0] < 0 or not slides or root.limited[0]:
        return None
    period = 2.0 * floor.size[0] / model.mat(floor.matid[0]).texrepeat[0]
    return float(period) or None


def main() -> int:
    """Draws a ball; returns the exit code, NO_GL with a line where that fails."""
    try:
        import mujoco

        model: Any = mujoco.MjModel.from_xml_string(_BALL)  # pyright: ignore
        gl: Any = mujoco
        renderer, data = gl.Renderer(model, 64, 64), gl.MjData(model)
        gl.mj_forward(model, data)
        renderer.update_scene(data)
        drawn = bool(renderer.render().any())
    except Exception as error:  # ImportError, RuntimeError, AttributeError, ...
        drawn, *reasons = False, *str(error).splitlines(), type(error).__name__
        print("error:", reasons[0], file=sys.stderr)
    return 0 if drawn else NO_GL


if __name__ == "__main__":
    sys.exit(main())
