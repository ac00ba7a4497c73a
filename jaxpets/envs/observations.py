"""Entries of an observation by their names in MuJoCo, and how a model sees each."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from jaxpets._src.checks import is_sequence, nearest
from jaxpets._src.types import Coordinate
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.symmetry import free_shifts

with needs_extra():
    import mujoco

_C: Any = mujoco  # its names are made at import, where pyright does not see them

DEFAULT = ("mean_qvel", "qpos", "qvel", "act")
"""What is observed of a model of which nothing is said: where it is and how it moves.

The velocity of a root over the whole step says how far it came, which the position of
a root that may be anywhere does not.
"""

_XYZ = ("x", "y", "z")
_WXYZ = ("qw", "qx", "qy", "qz")


class Reading(NamedTuple):
    """One number of MuJoCo's data.

    Attributes:
      source: its array, by MuJoCo's name; "mean_qvel" is the change of qpos over a step
        of the environment, by its time.
      place: the index in that array, read as one row.
      coordinate: its name, and how a model sees it.
    """

    source: str
    place: int
    coordinate: Coordinate


def readings(model: Any, observe: Sequence[str]) -> tuple[Reading, ...]:
    """Returns what an observation consists of, in its order.

    A name is an array of MuJoCo, a slash, and what it is of: "qpos/rootz" or
    "qvel/rootz" with the name of a joint, "mean_qvel/rootx" (the finite difference over
    a step, of a slide or a hinge), "sensordata/foot", "site_xpos/tip", "xpos/torso",
    "xipos/torso" (its centre of mass), "xmat/torso", "subtree_linvel/torso", and
    "act/hip" with the name of an actuator that has an activation. Of what has several
    numbers, "xpos/torso" is all and "xpos/torso.z" is one. An array alone is all of it,
    but: "qpos" leaves out where the robot stands if nothing depends on it, and
    "mean_qvel" is of that alone.

    How a model sees an entry follows from what it is: a hinge without limits is an
    angle, a ball is a quaternion, so is a free joint behind its place. What depends on
    where the robot stands is neither read by the network nor bounded. A sensor of a
    joint's position or of a place is seen as that position or place. A velocity over a
    step and a sensor of forces are predicted as they are and not read, everything else
    by its change.

    Args:
      model: a compiled MuJoCo model.
      observe: names.

    Raises:
      TypeError, ValueError: if a name is none of the model; the nearest are said. Or if
        it is of a clock, as a state has no time.
    """
    if not is_sequence(observe):
        raise TypeError(f"observe must be a sequence of names, got {observe!r}.")
    shifts = free_shifts(model)
    groups = _groups(model, set(shifts))
    found: list[Reading] = []
    for name in observe:
        chosen = _chosen(groups, name)
        if name == "qpos":
            chosen = [reading for reading in chosen if reading.place not in shifts]
        if name == "mean_qvel":
            chosen = [reading for reading in chosen if reading.place in shifts]
        found += chosen
    if not found:
        raise ValueError(f"observe must name an entry of the model, got {observe!r}.")
    clocks = _clocks(model)
    for reading in found:
        if reading.source == "sensordata" and reading.place in clocks:
            name = reading.coordinate.name
            raise ValueError(
                f"observe must be of a state, which has no time, but {name} is a clock."
            )
    return tuple(found)


def _clocks(model: Any) -> list[int]:
    """Returns where sensors that read the time are in sensordata.

    Physics is stepped from its positions and velocities, so they would stand still.
    """
    kind = int(_C.mjtSensor.mjSENS_CLOCK)
    return [int(place) for place in model.sensor_adr[model.sensor_type == kind]]


def _chosen(groups: dict[str, list[Reading]], name: str) -> list[Reading]:
    """Returns what a name means: an array, a thing of it, or one of its numbers."""
    if name in groups:
        return groups[name]
    every = [reading for group in groups.values() for reading in group]
    exact = [r for r in every if r.coordinate.name == name]
    # A thing's own name may have a dot in it, so only what is behind the last is cut.
    parts = [r for r in every if r.coordinate.name.rpartition(".")[0] == name]
    if exact or parts:
        return exact or parts
    known = [r.coordinate.name for r in every]
    known = list(
        dict.fromkeys([*groups, *known, *(n.rpartition(".")[0] for n in known)])
    )
    near = ", ".join(nearest(name, known) or groups)
    raise ValueError(f"observe must have names of the model, as {near}, got {name!r}.")


def _groups(model: Any, shifts: set[int]) -> dict[str, list[Reading]]:
    """Returns everything that may be observed, by the array it is in."""
    qpos: list[Reading] = []
    qvel: list[Reading] = []
    mean: list[Reading] = []
    for joint in range(model.njnt):
        of_joint = _positions(model, joint, shifts)
        qpos += of_joint
        qvel += _velocities(model, joint)
        mean += [
            Reading("mean_qvel", r.place, Coordinate(_renamed(r), "absolute", False))
            for r in of_joint
            if r.coordinate.kind != "quaternion"
        ]
    bodies = range(1, model.nbody)  # the world stands still
    return {
        "mean_qvel": mean,
        "qpos": qpos,
        "qvel": qvel,
        "act": [
            reading
            for i, name in enumerate(actuators(model))
            for reading in _activations(model, i, f"act/{name}")
        ],
        "sensordata": [
            r for i in range(model.nsensor) for r in _sensor(model, i, shifts)
        ],
        "site_xpos": _points(model, "site_xpos", "SITE", range(model.nsite), shifts),
        "xpos": _points(model, "xpos", "BODY", bodies, shifts),
        "xipos": _points(model, "xipos", "BODY", bodies, shifts),
        "xmat": _arrays(model, "xmat", bodies, [a + b for a in _XYZ for b in _XYZ]),
        "subtree_linvel": _arrays(model, "subtree_linvel", bodies, _XYZ),
    }


def _renamed(reading: Reading) -> str:
    return "mean_qvel/" + reading.coordinate.name.partition("/")[2]


def _name(model: Any, kind: str, number: int) -> str:
    """Returns the name of a thing, or its kind and number where it has none."""
    code = getattr(_C.mjtObj, f"mjOBJ_{kind}")
    return _C.mj_id2name(model, code, number) or f"{kind.lower()}{number}"


def _positions(model: Any, joint: int, shifts: set[int]) -> list[Reading]:
    name = f"qpos/{_name(model, 'JOINT', joint)}"
    start = int(model.jnt_qposadr[joint])
    kind, types = _C.mjtJoint(model.jnt_type[joint]), _C.mjtJoint
    if kind == types.mjJNT_HINGE and not model.jnt_limited[joint]:
        angle = Coordinate(name, "angle", is_bounded=False)
        return [Reading("qpos", start, angle)]
    if kind in (types.mjJNT_HINGE, types.mjJNT_SLIDE):
        here = start not in shifts
        return [Reading("qpos", start, Coordinate(name, "relative", here, here))]
    found: list[Reading] = []
    if kind == types.mjJNT_FREE:
        for i, axis in enumerate(_XYZ):
            here = start + i not in shifts
            row = Coordinate(f"{name}.{axis}", "relative", here, here)
            found.append(Reading("qpos", start + i, row))
    return found + [
        Reading("qpos", start + len(found) + i, _unit(f"{name}.{part}"))
        for i, part in enumerate(_WXYZ)
    ]


def _unit(name: str) -> Coordinate:
    return Coordinate(name, "quaternion", is_bounded=False)


def _velocities(model: Any, joint: int) -> list[Reading]:
    name = f"qvel/{_name(model, 'JOINT', joint)}"
    turns, types = ("wx", "wy", "wz"), _C.mjtJoint
    suffixes = {types.mjJNT_FREE: (*_XYZ, *turns), types.mjJNT_BALL: turns}
    parts = suffixes.get(types(model.jnt_type[joint]), ("",))
    start = int(model.jnt_dofadr[joint])
    return [
        Reading("qvel", start + i, Coordinate(f"{name}.{part}" if part else name))
        for i, part in enumerate(parts)
    ]


def actuators(model: Any) -> list[str]:
    """Returns their names; of MuJoCo 4 on, one may have several controls, or none."""
    return [_name(model, "ACTUATOR", i) for i in range(len(model.actuator_trntype))]


def _activations(model: Any, actuator: int, name: str) -> list[Reading]:
    start, size = (
        int(x[actuator]) for x in (model.actuator_actadr, model.actuator_actnum)
    )
    names = [name] if size == 1 else [f"{name}.{i}" for i in range(size)]
    return [Reading("act", start + i, Coordinate(n)) for i, n in enumerate(names)]


def _sensor(model: Any, sensor: int, shifts: set[int]) -> list[Reading]:
    """Returns what a sensor says, seen as what it is of where that has a name too."""
    kind, types = _C.mjtSensor(model.sensor_type[sensor]), _C.mjtSensor
    no_frame = model.sensor_reftype[sensor] == int(_C.mjtObj.mjOBJ_UNKNOWN)
    in_world = kind in (types.mjSENS_FRAMEPOS, types.mjSENS_SUBTREECOM) and no_frame
    name = f"sensordata/{_name(model, 'SENSOR', sensor)}"
    start, size = int(model.sensor_adr[sensor]), int(model.sensor_dim[sensor])
    if model.sensor_datatype[sensor] == int(_C.mjtDataType.mjDATATYPE_QUATERNION):
        rows = [_unit(f"{name}.{part}") for part in _WXYZ]
    elif kind == types.mjSENS_JOINTPOS:
        joint = int(model.sensor_objid[sensor])
        rows = [_positions(model, joint, shifts)[0].coordinate._replace(name=name)]
    elif in_world:
        rows = [_place(name, axis, shifts) for axis in _XYZ]
    else:
        # Forces and accelerations jump, so that their last value says little.
        jumps = model.sensor_needstage[sensor] == int(_C.mjtStage.mjSTAGE_ACC)
        kind = "absolute" if jumps else "relative"
        parts = _XYZ if size == len(_XYZ) else tuple(map(str, range(size)))
        names = [name] if size == 1 else [f"{name}.{part}" for part in parts]
        rows = [Coordinate(name, kind, not jumps) for name in names]
    return [Reading("sensordata", start + i, row) for i, row in enumerate(rows)]


def _points(
    model: Any, source: str, kind: str, things: range, shifts: set[int]
) -> list[Reading]:
    """Returns places in the world; along the floor they move with the robot."""
    found: list[Reading] = []
    for thing in things:
        for i, axis in enumerate(_XYZ):
            row = _place(f"{source}/{_name(model, kind, thing)}", axis, shifts)
            found.append(Reading(source, len(_XYZ) * thing + i, row))
    return found


def _place(name: str, axis: str, shifts: set[int]) -> Coordinate:
    here = not shifts or axis == "z"
    return Coordinate(f"{name}.{axis}", "relative", here, here)


def _arrays(
    model: Any, source: str, bodies: range, parts: Sequence[str]
) -> list[Reading]:
    return [
        Reading(
            source,
            len(parts) * body + i,
            Coordinate(f"{source}/{_name(model, 'BODY', body)}.{part}"),
        )
        for body in bodies
        for i, part in enumerate(parts)
    ]
