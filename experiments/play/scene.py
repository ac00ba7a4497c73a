"""What is seen: the robot, what it imagines, and the ground that passes below it.

The world moves and the robot stays in the middle, so that everybody may look at it from
where they like, and a recording follows it too.
"""

from typing import Any, NamedTuple

import numpy as np
import viser

from . import geometry
from .geometry import Pose, Shape
from .session import Frame

# By member; they differ also for those who do not see red or green (Okabe and Ito).
COLORS = np.array(
    [(0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (204, 121, 167),
     (86, 180, 233), (240, 228, 66), (120, 120, 120)], np.uint8,
)  # fmt: skip
_GHOST_SHARES = (0.5, 1.0)  # of the way, where robots are drawn
_MARKS = 4  # on each side, with the distance
_MARK_GAP = 5  # m


class Look(NamedTuple):
    """What of the imagination is to be seen."""

    paths: bool = True
    ghosts: bool = True


class Scene:
    """Draws frames of one robot on one server; for one thread at a time."""

    def __init__(self, server: viser.ViserServer, model: Any) -> None:
        self._model = model
        self._poses = geometry.poses(model)
        self._shapes = geometry.shapes(model)
        self._ghost_shapes = geometry.shapes(model, seamless=True)
        self._server = server
        self._size = geometry.size(model)
        self._is_roaming = geometry.is_roaming(model)
        self._drawn: tuple[Any, Look] | None = None
        scene = server.scene
        scene.set_up_direction("+z")
        _light(scene)
        self._ground = _Ground(scene, geometry.floor_height(model), self._size)
        self._world = scene.add_frame("/world", show_axes=False)
        rest = self._poses(np.asarray(model.qpos0))
        self._robot = [
            _copies(scene, f"/robot/{i}", shape, rest)
            for i, shape in enumerate(self._shapes)
        ]
        self._ghosts: list[Any] = []
        self._paths: Any = None
        self._aim(rest)

    def show(self, qpos: np.ndarray, frame: Frame, look: Look) -> None:
        """Shows a robot where it is, and what was imagined in a frame."""
        pose = self._poses(qpos)
        middle = np.append(pose.center[:2], 0.0) if self._is_roaming else np.zeros(3)
        with self._server.atomic():
            for handle, shape in zip(self._robot, self._shapes, strict=True):
                positions, handle.batched_wxyzs = geometry.placed(shape, pose)
                # Here and not by the world's frame: a slow browser is late with either.
                handle.batched_positions = (positions - middle).astype(np.float32)
            self._world.position = -middle
            self._ground.pass_by(middle)
            if (
                self._drawn is None
                or self._drawn[0] is not frame
                or self._drawn[1] != look
            ):
                self._drawn = frame, look
                self._imagine(frame, look)

    def _imagine(self, frame: Frame, look: Look) -> None:
        num, steps = frame.ghosts.shape[:2]
        colors = COLORS[frame.members % len(COLORS)]
        if self._paths is not None:
            self._paths.visible = look.paths and num > 0
        for handle in self._ghosts:
            handle.visible = look.ghosts and num > 0
        if not num or not (look.paths or look.ghosts):
            return
        pose = self._poses(frame.ghosts)
        if look.paths:
            lines = np.stack([pose.center[:, :-1], pose.center[:, 1:]], axis=2)
            shade = np.broadcast_to(colors[:, None, None], (*lines.shape[:3], 3))
            self._draw_paths(lines.reshape(-1, 2, 3), shade.reshape(-1, 2, 3))
        if look.ghosts:
            at = [round(share * (steps - 1)) for share in _GHOST_SHARES]
            parts = Pose(*(x[:, at].reshape(-1, *x.shape[2:]) for x in pose))
            self._draw_ghosts(parts, np.repeat(colors, len(at), axis=0))

    def _draw_paths(self, lines: np.ndarray, colors: np.ndarray) -> None:
        if self._paths is None:
            self._paths = self._server.scene.add_line_segments(
                "/world/paths", lines, colors, thickness=0.012 * self._size
            )
        else:
            self._paths.points, self._paths.colors = lines, colors

    def _draw_ghosts(self, pose: Pose, colors: np.ndarray) -> None:
        """Draws G robots, see-through, in G colors."""
        first = not self._ghosts
        for i, shape in enumerate(self._ghost_shapes):
            positions, quaternions = geometry.placed(shape, pose)
            flat = (quaternions.reshape(-1, 4), positions.reshape(-1, 3))
            count = len(shape.bodies)
            if not first:
                self._ghosts[i].batched_wxyzs, self._ghosts[i].batched_positions = flat
                continue
            handle = self._server.scene.add_batched_meshes_simple(
                f"/world/ghosts/{i}", shape.vertices, shape.faces, *flat,
                batched_scales=np.tile(shape.scales, (len(colors), 1)),
                batched_colors=np.repeat(colors, count, axis=0),
                opacity=0.16, lod="off", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._ghosts.append(handle)

    def _aim(self, pose: Pose) -> None:
        """Places the camera at first: from the side, a little above."""
        camera, size = self._server.initial_camera, self._size
        height = float(pose.center[2])
        place = (0.25 * size, 0.0) if self._is_roaming else pose.center[:2]
        middle = np.append(place, height)  # what it imagines is ahead of it
        camera.look_at = middle
        camera.position = middle + size * np.array([0.4, -4.0, 1.2])
        camera.fov = 0.75


class _Ground:
    """A floor with lines a meter apart, and distances; it is where the world was."""

    def __init__(self, scene: Any, height: float | None, size: float) -> None:
        self._height = 0.0 if height is None else height
        self._floor: Any = None
        self._marks: list[Any] = []
        self._numbers: list[int | None] = []
        if height is None:
            return
        self._floor = scene.add_grid(
            "/floor", infinite_grid=True, cell_size=0.5, section_size=1.0,
            cell_color=(222, 226, 230), section_color=(196, 202, 210),
            cell_thickness=1.0, section_thickness=1.4,
            plane_color=(233, 236, 240), plane_opacity=1.0, shadow_opacity=0.4,
            fade_distance=25 * size, fade_strength=1.2,
        )  # fmt: skip
        for i in range(2 * _MARKS + 1):
            label = scene.add_label(
                f"/marks/{i}", "", anchor="bottom-center", depth_test=True
            )
            self._marks.append(label)
            self._numbers.append(None)

    def pass_by(self, middle: np.ndarray) -> None:
        """Moves the ground so that a place `[3]` of the world is in the middle."""
        if self._floor is None:
            return
        x, y = float(middle[0]), float(middle[1])
        self._floor.position = (-(x % 1.0), -(y % 1.0), self._height)
        first = round(x / _MARK_GAP) - _MARKS
        for number in range(first, first + len(self._marks)):
            place = number % len(self._marks)  # so that a mark keeps its number
            mark = self._marks[place]
            if self._numbers[place] != number:
                self._numbers[place] = number
                mark.text = f"{number * _MARK_GAP} m"
            mark.position = (number * _MARK_GAP - x, -1.0 - y % 1.0, self._height)


def _copies(scene: Any, name: str, shape: Shape, pose: Pose) -> Any:
    positions, quaternions = geometry.placed(shape, pose)
    return scene.add_batched_meshes_simple(
        name, shape.vertices, shape.faces, quaternions, positions,
        batched_scales=shape.scales.astype(np.float32), batched_colors=shape.colors,
        lod="off",
    )  # fmt: skip


def _light(scene: Any) -> None:
    """Lights the middle, where the robot is: a sun that casts shadows, and the sky."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.set_background_image(_sky(), format="png")
    scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(190, 180, 170),
        intensity=1.3,
    )  # fmt: skip
    scene.add_light_directional(
        "/lights/sun", intensity=2.6, cast_shadow=True, position=(-0.5, -1.2, 2.5)
    )


def _sky() -> np.ndarray:
    """Returns a picture `[H, 1, 3]` that gets lighter towards the horizon."""
    share = np.linspace(0, 1, 64)[:, None, None] ** 0.7
    top, bottom = np.array([201, 218, 238.0]), np.array([255, 255, 255.0])
    return np.round((1 - share) * top + share * bottom).astype(np.uint8)
