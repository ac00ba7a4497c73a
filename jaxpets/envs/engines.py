"""What moves the physics of a MuJoCo model and reads it: C MuJoCo or MJX."""

import contextlib
import io
from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets.envs.extra import needs_extra
from jaxpets.envs.native import check_state, native_physics, native_readings


class Physics(NamedTuple):
    """The part of MuJoCo's state from which the rest follows.

    Attributes:
      qpos: `[Q]`, positions in m and rad, and quaternions.
      qvel: `[V]`, velocities in m/s and rad/s.
      qacc_warmstart: `[V]`, where the contact solver starts.
      act: `[M]`, activations of actuators that have one; () where none has.
    """

    qpos: Array
    qvel: Array
    qacc_warmstart: Array
    act: Any = ()


class Engine(NamedTuple):
    """Physics of one model.

    Attributes:
      advance: `(Physics, action [A]) -> Physics`, by one step of the environment.
      read: `(Physics, action [A]) -> [R]`, what was asked for of MuJoCo's data.
    """

    advance: Callable[[Physics, Array], Physics]
    read: Callable[[Physics, Array], Array]


def native_engine(
    model: Any,
    *,
    num_substeps: int,
    places: Sequence[tuple[str, int]] = (),
    num_threads: int | None = None,
) -> Engine:
    """Builds physics in C MuJoCo, see `native_physics` and `native_readings`.

    Actions are clipped to the range of the actuators, all of which must have one.
    """
    physics_fn = native_physics(
        model, num_substeps=num_substeps, num_threads=num_threads
    )
    clip = _clip_fn(model)

    def advance(before: Physics, action: Array) -> Physics:
        return Physics(*physics_fn(*before, clip(action)))

    if not places:
        return Engine(advance, _nothing)
    read_fn = native_readings(model, places, num_threads=num_threads)

    def read(physics: Physics, action: Array) -> Array:
        return read_fn(*physics, clip(action))

    return Engine(advance, read)


def _nothing(physics: Physics, action: Array) -> Array:
    return jnp.zeros((0,), jnp.float32)


def _clip_fn(model: Any) -> Callable[[Array], Array]:
    """Returns what brings an action into the range of the actuators.

    MuJoCo clips as well, unless a model's flag says that it must not; and C MuJoCo
    takes an infinite control for 0.
    """
    low, high = jnp.asarray(model.actuator_ctrlrange, jnp.float32).T
    return lambda action: jnp.clip(action, low, high)


def mjx_engine(
    model: Any, *, num_substeps: int, places: Sequence[tuple[str, int]] = ()
) -> Engine:
    """Builds physics in MJX, with the settings of the model's solver.

    Actions are clipped as `native_engine` does.

    Raises:
      ValueError: if the model uses what MJX does not have, or has a state that Physics
        does not have.
    """
    check_state(model)
    # MJX writes to stdout when it finds no warp, which it does not need here.
    with needs_extra(), contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx

    try:
        with _as_mjx_needs():
            device_model = mjx.put_model(model, impl="jax")
            template = mjx.make_data(model, impl="jax")
    except NotImplementedError as error:
        raise ValueError(f"MJX lacks what this model uses: {error}.") from error
    mjx_step = cast(Callable[[Any, Any], Any], mjx.step)
    mjx_forward = cast(Callable[[Any, Any], Any], mjx.forward)
    subtree_vel = cast(Callable[[Any, Any], Any], mjx.subtree_vel)
    clip = _clip_fn(model)

    def data_of(physics: Physics, action: Array) -> Any:
        data = template.replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            qacc_warmstart=physics.qacc_warmstart,
            ctrl=clip(action),
        )
        return data.replace(act=physics.act) if model.na else data

    def substep(_: Array, data: Any) -> Any:
        return mjx_step(device_model, data)

    def advance(before: Physics, action: Array) -> Physics:
        data = data_of(before, action)
        with _as_mjx_needs():
            data = cast(Any, jax.lax.fori_loop(0, num_substeps, substep, data))
        act = data.act if model.na else ()
        return Physics(data.qpos, data.qvel, data.qacc_warmstart, act)

    def read(physics: Physics, action: Array) -> Array:
        with _as_mjx_needs():
            data = mjx_forward(device_model, data_of(physics, action))
            if any(source == "subtree_linvel" for source, _ in places):
                data = subtree_vel(device_model, data)
        numbers = [_field(data, source).reshape(-1)[place] for source, place in places]
        return jnp.stack(numbers).astype(jnp.float32)

    return Engine(advance, read)


@contextlib.contextmanager
def _as_mjx_needs() -> Generator[None]:
    """Traces MJX in float32, whatever a caller has set.

    GPUs multiply in TF32 by default: an error 400 times that of float32. And MJX does
    not trace under strict promotion, and under x64 returns other types than it takes.
    """
    with (
        jax.enable_x64(False),
        jax.default_matmul_precision("highest"),
        jax.numpy_dtype_promotion("standard"),
    ):
        yield


def _field(data: Any, name: str) -> Array:
    """Returns an array of MJX's data, wherever this version keeps it."""
    return getattr(data._impl if hasattr(data._impl, name) else data, name)
