"""Where a robot stands on the floor: coordinates on which nothing depends."""

from typing import Any

import numpy as np

from jaxpets.envs.extra import needs_extra

with needs_extra():
    import mujoco

_C: Any = mujoco  # its names are made at import, where pyright does not see them
_PARALLEL = 1e-6  # of the sine between two unit vectors, as MuJoCo rounds them


def free_shifts(model: Any) -> list[int]:
    """Returns the entries of qpos that only say where the robot is, in their order.

    These are horizontal shifts of a model's only moving tree: slides at its root, or x
    and y of a free joint, without limit, spring, actuator or tendon, over a world in
    which everything that collides is a plane along the shift. Where in doubt a
    coordinate is not among them.

    Args:
      model: a compiled MuJoCo model.
    """
    roots = {int(model.body_rootid[body]) for body in model.dof_bodyid}
    if len(roots) != 1 or model.nmocap or _is_tied_to_world(model):
        return []
    (root,) = roots
    data = _C.MjData(model)
    _C.mj_kinematics(model, data)
    free, slide = int(_C.mjtJoint.mjJNT_FREE), int(_C.mjtJoint.mjJNT_SLIDE)
    found: list[int] = []
    first = model.body_jntadr[root]
    # Joints of one body act in their order: a slide past a hinge turns with it.
    for joint in range(first, first + model.body_jntnum[root]):
        place = int(model.jnt_qposadr[joint])
        if model.jnt_type[joint] == free:
            axes = {place: np.eye(3)[0], place + 1: np.eye(3)[1]}
        elif model.jnt_type[joint] == slide:
            axes = {place: data.xaxis[joint]}
        else:
            break
        if not _is_held(model, joint):
            found += [i for i, axis in axes.items() if _is_along(model, axis)]
    return found


def _is_held(model: Any, joint: int) -> bool:
    """Whether something pulls at a joint, or stops it, by where it is."""
    wraps = model.wrap_type == int(_C.mjtWrap.mjWRAP_JOINT)
    joints = (_C.mjtTrn.mjTRN_JOINT, _C.mjtTrn.mjTRN_JOINTINPARENT)
    driven = np.isin(model.actuator_trntype, [int(kind) for kind in joints])
    coupled = model.eq_type == int(_C.mjtEq.mjEQ_JOINT)
    return bool(
        model.jnt_limited[joint]
        or np.any(model.jnt_stiffness[joint])
        or (model.wrap_objid[wraps] == joint).any()
        or (model.actuator_trnid[driven, 0] == joint).any()
        or (model.eq_obj1id[coupled] == joint).any()
        or (model.eq_obj2id[coupled] == joint).any()
    )


def _is_tied_to_world(model: Any) -> bool:
    """Whether a tendon, an actuator or an equality leads to what stands still.

    An equality between frames counts as one: which of them are fixed is not looked at.
    """
    sites = np.concatenate([_wrapped(model, "SITE"), _driven_sites(model)])
    geoms = np.concatenate([_wrapped(model, "SPHERE"), _wrapped(model, "CYLINDER")])
    bodies = np.concatenate([model.site_bodyid[sites], model.geom_bodyid[geoms]])
    fixed = model.body_weldid[bodies] == 0
    frames = (_C.mjtEq.mjEQ_JOINT, _C.mjtEq.mjEQ_TENDON)
    tied = ~np.isin(model.eq_type, [int(kind) for kind in frames])
    return bool(fixed.any() or tied.any())


def _wrapped(model: Any, kind: str) -> np.ndarray:
    """Returns the things of a kind that a tendon runs by."""
    code = int(getattr(_C.mjtWrap, f"mjWRAP_{kind}"))
    return model.wrap_objid[model.wrap_type == code]


def _driven_sites(model: Any) -> np.ndarray:
    """Returns the sites between which an actuator acts.

    One that acts on a site alone, with no other to refer to, is not among them.
    """
    kinds = (_C.mjtTrn.mjTRN_SITE, _C.mjtTrn.mjTRN_SLIDERCRANK)
    acts = np.isin(model.actuator_trntype, [int(kind) for kind in kinds])
    pairs = model.actuator_trnid[acts]
    return pairs[(pairs >= 0).all(axis=1)].ravel()


def _is_along(model: Any, axis: np.ndarray) -> bool:
    """Whether an axis is level, and all fixed things that collide extend along it."""
    up = -model.opt.gravity if model.opt.gravity.any() else np.array([0.0, 0.0, 1.0])
    if abs(axis @ up) > _PARALLEL * np.linalg.norm(up):
        return False
    for geom in range(model.ngeom):
        if model.body_weldid[model.geom_bodyid[geom]]:
            continue
        pairs = (model.pair_geom1, model.pair_geom2)
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        if not collides and not any((pair == geom).any() for pair in pairs):
            continue
        normal = np.zeros(3)
        _C.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), _orientation(model, geom))
        is_plane = model.geom_type[geom] == int(_C.mjtGeom.mjGEOM_PLANE)
        if not is_plane or abs(axis @ normal) > _PARALLEL:
            return False
    return True


def _orientation(model: Any, geom: int) -> np.ndarray:
    """Returns the quaternion of a fixed geom in the world."""
    quaternion = np.array(model.geom_quat[geom])
    body = model.geom_bodyid[geom]
    while body:
        _C.mju_mulQuat(quaternion, np.array(model.body_quat[body]), quaternion.copy())
        body = model.body_parentid[body]
    return quaternion
