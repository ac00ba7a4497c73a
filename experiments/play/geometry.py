"""What a MuJoCo model looks like: unit meshes, and where copies of them are."""

from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from trimesh import creation
from viser.transforms import SO3

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
            place = own[0] + SO3(own[1]) @ np.array([0.0, 0.0, offset])
            row = (model.geom_bodyid[geom], place, own[1], scale, color)
            copies.setdefault(kind, []).append(row)
    found = []
    for kind, rows in copies.items():
        bodies, positions, quaternions, scales, colors = map(
            np.array, zip(*rows, strict=True)
        )
        mesh = _asset(model, kind) if isinstance(kind, int) else _unit(kind)
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
    carried = SO3(pose.quaternions[..., shape.bodies, :])
    positions = pose.positions[..., shape.bodies, :] + carried @ shape.positions
    quaternions = carried.multiply(SO3(shape.quaternions)).wxyz
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


def _pieces(model: Any, geom: int, seamless: bool) -> list[tuple[Any, float, Any]]:
    """Returns the kind, the offset along z and the scale of each piece of a geom."""
    kinds, kind = _C.mjtGeom, int(model.geom_type[geom])
    a, b, c = map(float, model.geom_size[geom])
    capsule = [("pill", 0.0, (a, a, a + b))]
    if not seamless:
        capsule = [("can", 0.0, (a, a, b))]
        capsule += [("sphere", end, (a, a, a)) for end in (-b, b)]
    found = {
        int(kinds.mjGEOM_SPHERE): [("sphere", 0.0, (a, a, a))],
        int(kinds.mjGEOM_ELLIPSOID): [("sphere", 0.0, (a, b, c))],
        int(kinds.mjGEOM_BOX): [("box", 0.0, (a, b, c))],
        int(kinds.mjGEOM_CYLINDER): [("can", 0.0, (a, a, b))],
        int(kinds.mjGEOM_CAPSULE): capsule,
        int(kinds.mjGEOM_MESH): [(int(model.geom_dataid[geom]), 0.0, (1.0, 1.0, 1.0))],
    }
    return found.get(kind, [])


def _unit(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns a mesh between -1 and 1; a pill is a capsule that is much too thick."""
    mesh = {
        "sphere": lambda: creation.uv_sphere(count=[12, 24]),
        "box": lambda: creation.box(extents=(2, 2, 2)).smooth_shaded,
        "can": lambda: creation.cylinder(1, 2, sections=24).smooth_shaded,
        "pill": lambda: creation.capsule(8, 1, count=[12, 24]),
    }[kind]()
    return mesh.vertices / np.abs(mesh.bounds).max(0), mesh.faces


def _asset(model: Any, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return (
        np.array(model.mesh_vert[start : start + count]),
        np.array(model.mesh_face[first : first + faces]),
    )


def pushes(model: Any) -> dict[str, np.ndarray]:
    """Returns velocities `[V]` to add to those of a robot, by a name for each.

    Of the root, where it moves freely along x or z; else of the first joint.
    """
    dofs, units = _root_dofs(model), np.eye(model.nv, dtype=np.float32)
    speed = 1.5 * np.sqrt(9.81 * max(float(model.stat.meansize), 0.1))
    if not dofs:
        dofs, speed = {0: 0}, 2.0
    directions = {"push back": (0, -speed), "push on": (0, speed), "toss": (2, speed)}
    return {
        name: np.float32(value) * units[dofs[axis]]
        for name, (axis, value) in directions.items()
        if axis in dofs and model.nv
    }


def is_roaming(model: Any) -> bool:
    """Returns whether the robot may go where it likes."""
    return bool(_root_dofs(model).keys() & {0, 1})


def _root_dofs(model: Any) -> dict[int, int]:
    """Returns which velocity moves the whole robot, by the axis along which it does."""
    if model.nbody < 2:
        return {}
    data, jacobian = _C.MjData(model), np.zeros((3, model.nv))
    _C.mj_forward(model, data)
    _C.mj_jacSubtreeCom(model, data, jacobian, 1)
    is_free = ~model.jnt_limited[model.dof_jntid].astype(bool)
    return {
        axis: dof
        for axis, unit in enumerate(np.eye(3))
        for dof in np.flatnonzero(is_free).tolist()
        if np.allclose(jacobian[:, dof], unit)
    }


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
