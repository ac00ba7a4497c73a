"""What was seen, as a file to keep: a video, or a page that needs no server."""

import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxpets.envs import Robot

from ..storage import trajectories
from ..tools import video
from . import geometry
from .scene import Look, Scene
from .server import serving
from .session import Frame

_BETWEEN = 2  # pictures per step, so that it moves smoothly


def html(robot: Robot, frames: Sequence[Frame], look: Look) -> bytes:
    """Returns one HTML file that replays frames in 3D, without a server."""
    with serving() as server:
        scene = Scene(server, robot.model)
        scene.show(frames[0].qpos, frames[0], look)
        recording = server.get_scene_serializer()
        for before, after in itertools.pairwise(frames):
            for i in range(_BETWEEN):
                recording.insert_sleep(robot.step_time / _BETWEEN)
                share = (i + 1) / _BETWEEN if after.number > before.number else 1.0
                qpos = geometry.between(robot.model, before.qpos, after.qpos, share)
                scene.show(qpos, after, look)
        return recording.as_html().encode()


def mp4(env: str, frames: Sequence[Frame]) -> bytes:
    """Returns a video of frames, as `tools.video` renders a recorded trial.

    Raises:
      RunError: if no OpenGL works here; one line says why.
    """
    obs = np.stack([frame.obs for frame in frames])[None, None, None]
    seen = {"obs": obs, "seeds": np.array([0]), "tasks": np.array(["seen"])}
    with tempfile.TemporaryDirectory(prefix="jaxpets-play-") as folder:
        source, target = Path(folder, "seen.npz"), Path(folder, "seen.mp4")
        trajectories.save(source, seen)
        video.render(source, target, task="seen", seed=0, trial=1, env=env)
        return target.read_bytes()
