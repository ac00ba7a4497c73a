"""What a MuJoCo model looks like: unit meshes, and where copies of them are."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from .meshes import UNIT

_C: Any = mujoco  # its stubs lack half of it
_HIDDEN_GROUP = 3  # from here on MuJoCo's own viewer shows no geom


class Shape(NamedTuple):
    """A mesh, and the N copies of it that a robot is made of.

    Attributes:
      vertices: `[V, 3]`, in m, or of unit size where it is scaled.
      faces: `[F, 3]`, places in `vertices`.
      bodies: `[N]`, which body carries a copy.
      positions: `[N, 3]`, in m, in the frame of its body.
      quaternions: `[N, 4]`, w first, in that frame.
      scales: `[N, 3]`.
      colors: `[N, 3]`, uint8.
    """

    vertices: np.ndarray
    faces: np.ndarray
    bodies: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    scales: np.ndarray
    colors: np.ndarray


class Pose(NamedTuple):
    """Where the bodies are, for any leading axes.

    Attributes:
      positions: `[..., bodies, 3]`, in m.
      quaternions: `[..., bodies, 4]`, w first.
      center: `[..., 3]`, the center of mass of what moves.
    """

    positions: np.ndarray
    quaternions: np.ndarray
    center: np.ndarray


def shapes(model: Any, *, seamless: bool = False) -> list[Shape]:
    """Returns what is seen of a model but for its floor: one Shape per kind of mesh.

    A capsule is a cylinder between two spheres, so that few meshes do for all limbs.
    Fields of heights, and what its own viewer would not show, are left out.

    Args:
      model: a compiled MuJoCo model.
      seamless: a capsule is one mesh, with ends that are a little too long; for what is
        seen through.
    """
    copies: dict[Any, list[tuple[Any, ...]]] = {}
    for geom in range(model.ngeom):
        color = _color(model, geom)
        if color is None:
            continue
        own = (model.geom_pos[geom], model.geom_quat[geom])
        for kind, offset, scale in _pieces(model, geom, seamless):
            place = own[0] + _rotated(own[1], np.asarray(offset, float))
            row = (model.geom_bodyid[geom], place, own[1], scale, color)
            copies.setdefault(kind, []).append(row)
    found = []
    for kind, rows in copies.items():
        bodies, positions, quaternions, scales, colors = map(
            np.array, zip(*rows, strict=True)
        )
        mesh = UNIT[kind]() if kind in UNIT else _asset(model, kind)
        found.append(Shape(*mesh, bodies, positions, quaternions, scales, colors))
    return found


def poses(model: Any) -> Callable[[np.ndarray], Pose]:
    """Returns `(qpos [..., Q]) -> Pose`; a call is for one thread at a time."""
    data = _C.MjData(model)
    moving = min(1, model.nbody - 1)

    def pose(qpos: np.ndarray) -> Pose:
        rows = qpos.reshape(-1, model.nq)
        positions = np.empty((len(rows), model.nbody, 3), np.float32)
        quaternions = np.empty((len(rows), model.nbody, 4), np.float32)
        centers = np.empty((len(rows), 3), np.float32)
        for i, row in enumerate(rows):
            data.qpos[:] = row
            _C.mj_kinematics(model, data)
            _C.mj_comPos(model, data)
            positions[i], quaternions[i] = data.xpos, data.xquat
            centers[i] = data.subtree_com[moving]
        lead = qpos.shape[:-1]
        return Pose(
            *(x.reshape(*lead, *x.shape[1:]) for x in (positions, quaternions, centers))
        )

    return pose


def placed(shape: Shape, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the copies of a shape are: `[..., N, 3]` and `[..., N, 4]`."""
    carried = pose.quaternions[..., shape.bodies, :]
    offset = _rotated(carried, shape.positions)
    positions = pose.positions[..., shape.bodies, :] + offset
    quaternions = _product(carried, shape.quaternions)
    return positions.astype(np.float32), quaternions.astype(np.float32)


def between(
    model: Any, first: np.ndarray, second: np.ndarray, share: float
) -> np.ndarray:
    """Returns the positions `[Q]` on the way from one to another, as joints move."""
    way, found = np.zeros(model.nv), np.array(first, np.float64)
    _C.mj_differentiatePos(model, way, 1.0, found, np.asarray(second, np.float64))
    _C.mj_integratePos(model, found, way, share)
    return found


def floor_height(model: Any) -> float | None:
    """Returns where the floor is, in m, None if there is none."""
    planes = np.flatnonzero(model.geom_type == int(_C.mjtGeom.mjGEOM_PLANE))
    return float(model.geom_pos[planes[0], 2]) if len(planes) else None


def _color(model: Any, geom: int) -> np.ndarray | None:
    """Returns the color of a geom, None where it is not seen."""
    material = model.geom_matid[geom]
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    if rgba[3] == 0 or model.geom_group[geom] >= _HIDDEN_GROUP:
        return None
    return np.round(255 * np.clip(rgba[:3], 0, 1)).astype(np.uint8)


def _pieces(model: Any, geom: int, seamless: bool) -> list[tuple[Any, Any, Any]]:
    """Returns the kind, the offset and the scale of each piece of a geom."""
    kinds, kind = _C.mjtGeom, int(model.geom_type[geom])
    a, b, c = map(float, model.geom_size[geom])
    here = (0.0, 0.0, 0.0)
    ends = [("sphere", (0.0, 0.0, end), (a, a, a)) for end in (-b, b)]
    capsule = [("pill", here, (a, a, a + b))]
    found = {
        int(kinds.mjGEOM_SPHERE): [("sphere", here, (a, a, a))],
        int(kinds.mjGEOM_ELLIPSOID): [("sphere", here, (a, b, c))],
        int(kinds.mjGEOM_BOX): [("box", here, (a, b, c))],
        int(kinds.mjGEOM_CYLINDER): [("can", here, (a, a, b))],
        int(kinds.mjGEOM_CAPSULE): capsule
        if seamless
        else [("tube", here, (a, a, b)), *ends],
        int(kinds.mjGEOM_MESH): [(int(model.geom_dataid[geom]), here, (1.0, 1.0, 1.0))],
    }
    return found.get(kind, [])


def _asset(model: Any, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return (
        np.array(model.mesh_vert[start : start + count]),
        np.array(model.mesh_face[first : first + faces]),
    )


def _rotated(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Rotates vectors `[..., 3]` by quaternions `[..., 4]`."""
    w, axis = quaternions[..., :1], quaternions[..., 1:]
    t = 2 * np.cross(axis, vectors)
    return vectors + w * t + np.cross(axis, t)


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Returns quaternion products `[..., 4]`: the second rotation, then the first."""
    w, v = first[..., :1], first[..., 1:]
    w2, v2 = second[..., :1], second[..., 1:]
    scalar = w * w2 - np.sum(v * v2, -1, keepdims=True)
    return np.concatenate([scalar, w * v2 + w2 * v + np.cross(v, v2)], -1)


def pushes(model: Any) -> dict[str, np.ndarray]:
    """Returns velocities `[V]` to add to those of a robot, by a name for each.

    Of the root, where it moves freely along x or z; else of the first joint.
    """
    found = {}
    speed = 1.5 * np.sqrt(9.81 * max(float(model.stat.meansize), 0.1))
    directions = {"push back": (0, -speed), "push on": (0, speed), "toss": (2, speed)}
    for name, (axis, value) in directions.items():
        dof = _root_dof(model, axis)
        if dof is not None:
            found[name] = value * np.eye(model.nv, dtype=np.float32)[dof]
    if not found and model.nv:
        kick = np.eye(model.nv, dtype=np.float32)[0]
        found = {"push back": -2 * kick, "push on": 2 * kick}
    return found


def _root_dof(model: Any, axis: int) -> int | None:
    """Returns which velocity moves the first body along a world axis."""
    for joint in range(model.njnt):
        if model.jnt_bodyid[joint] != 1:
            break
        dof = int(model.jnt_dofadr[joint])
        if model.jnt_type[joint] == _C.mjtJoint.mjJNT_FREE:
            return dof + axis
        is_slide = model.jnt_type[joint] == _C.mjtJoint.mjJNT_SLIDE
        if (
            is_slide
            and not model.jnt_limited[joint]
            and model.jnt_axis[joint][axis] == 1
        ):
            return dof
    return None


def is_roaming(model: Any) -> bool:
    """Returns whether the robot may go where it likes."""
    return any(_root_dof(model, axis) is not None for axis in (0, 1))


def size(model: Any) -> float:
    """Returns how far the parts of a robot are from its middle as it starts, in m."""
    data = _C.MjData(model)
    _C.mj_kinematics(model, data)
    moving = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_rgba[:, 3] > 0))
    if not len(moving):
        return float(model.stat.extent)
    places, radii = data.geom_xpos[moving], model.geom_rbound[moving, None]
    low, high = (places - radii).min(0), (places + radii).max(0)
    return float(np.linalg.norm(high - low)) / 2
