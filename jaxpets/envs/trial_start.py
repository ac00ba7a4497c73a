"""Where a trial of a MuJoCo model starts: its posture, a keyframe, or a function's."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.checks import check_array, is_sequence
from jaxpets.envs.extra import needs_extra

with needs_extra():
    import mujoco

_C: Any = mujoco  # its names are made at import, where pyright does not see them
_RESET_STD = 0.001  # as PETS starts HalfCheetah
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0], np.float32)

# `(key) -> (qpos [Q], qvel [V])`.
ResetFn = Callable[[Array], tuple[Array, Array]]
# The same with `act [M]` behind.
StartFn = Callable[[Array], tuple[Array, Array, Array]]


def start_fn(model: Any, reset: ResetFn | Sequence[str] | None) -> StartFn:
    """Returns what draws the start of a trial."""
    if callable(reset):
        return functools.partial(_own_start, model, reset)
    places = np.array([model.qpos0]), np.zeros((1, model.nv)), np.zeros((1, model.na))
    if reset is not None:
        names = [model.key(i).name for i in range(model.nkey)]
        is_names = is_sequence(reset) and all(name in names for name in reset)
        if not (is_names and reset):
            wanted = f"keyframes among {names}"
            if not names:
                wanted = "None or a function, as the model has no keyframes"
            raise ValueError(f"reset must be {wanted}, got {reset!r}.")
        chosen = [names.index(name) for name in reset]
        _check_mocap(model, chosen)
        arrays = (model.key_qpos, model.key_qvel, model.key_act)
        places = tuple(array[chosen] for array in arrays)
    qpos, qvel, act = (jnp.asarray(x, jnp.float32) for x in places)

    def start(key: Array) -> tuple[Array, Array, Array]:
        one: Any = 0
        if len(qpos) > 1:
            key, one_key = jax.random.split(key)
            one = jax.random.randint(one_key, (), 0, len(qpos))
        qpos_key, qvel_key = jax.random.split(key)
        noise = jax.random.normal(qpos_key, (model.nq,), jnp.float32)
        speed = jax.random.normal(qvel_key, (model.nv,), jnp.float32)
        return qpos[one] + _RESET_STD * noise, qvel[one] + _RESET_STD * speed, act[one]

    return start


def _own_start(model: Any, reset: ResetFn, key: Array) -> tuple[Array, Array, Array]:
    """Returns the start that a function of the user's draws."""
    drawn: Any = reset(key)
    if not is_sequence(drawn) or len(drawn) != 2:
        kind = type(drawn).__name__
        got = f"{len(drawn)} of them" if is_sequence(drawn) else kind
        raise TypeError(f"reset must return (qpos, qvel), got {got}.")
    qpos, qvel = drawn
    check_array("the qpos of reset", qpos, [model.nq])
    check_array("the qvel of reset", qvel, [model.nv])
    return jnp.asarray(qpos), jnp.asarray(qvel), jnp.zeros((model.na,), jnp.float32)


def _check_mocap(model: Any, chosen: Sequence[int]) -> None:
    """Raises if a keyframe moves a body that stays where the model has it."""
    ids = model.body_mocapid
    bodies = [int(np.flatnonzero(ids == i)[0]) for i in range(model.nmocap)]
    place, turn = (x[bodies].ravel() for x in (model.body_pos, model.body_quat))
    # Texts of keyframes are rounded, as MuJoCo's own are to six digits.
    near = functools.partial(np.allclose, rtol=0.0, atol=_RESET_STD)
    for one in chosen:
        if not (near(model.key_mpos[one], place) and near(model.key_mquat[one], turn)):
            name = model.key(one).name
            raise ValueError(
                "reset must be keyframes that leave mocap bodies where the model has "
                f"them, got {name!r}."
            )


def unit_quaternions(model: Any, qpos: Array) -> Array:
    """Returns positions whose quaternions are unit; one of zeros turns nothing.

    So MuJoCo reads it, too.
    """
    free, ball = int(_C.mjtJoint.mjJNT_FREE), int(_C.mjtJoint.mjJNT_BALL)
    for kind, start in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind in (free, ball):
            first = int(start) + (3 if kind == free else 0)
            part = qpos[first : first + 4]
            size = cast(Array, jnp.linalg.norm(part))
            unit = jnp.where(size > 0.0, part / size, _NO_TURN)
            qpos = qpos.at[first : first + 4].set(unit)
    return qpos
