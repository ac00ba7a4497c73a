"""Any robot: an environment from an MJCF, its entries named and its space derived."""

import copy
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_count,
    check_key,
    check_real,
)
from jaxpets._src.coordinates import space
from jaxpets._src.types import Env, EnvState
from jaxpets.envs.engines import Engine, Physics, mjx_engine, native_engine
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.observations import DEFAULT, Reading, actuators, readings
from jaxpets.envs.trial_start import ResetFn, start_fn, unit_quaternions

with needs_extra():
    import mujoco

_C: Any = mujoco  # its names are made at import, where pyright does not see them
_STATE = ("mean_qvel", "qpos", "qvel", "act")

# `(key) -> constants`, any pytree.
ConstantsFn = Callable[[Array], Any]


def mujoco_env(
    model: Any,
    *,
    observe: Sequence[str] = DEFAULT,
    control_step: float = 0.05,
    action_repeat: int = 1,
    reset: ResetFn | Sequence[str] | None = None,
    terminal_fn: Callable[[Array], Array] | None = None,
    settle_time: float = 0.0,
    constants: ConstantsFn | None = None,
    backend: str = "mujoco",
    num_threads: int | None = None,
) -> Env:
    """Builds an environment from a MuJoCo model.

    The coordinates of the model that is learned follow from the joints; they are in
    `Env.coordinates`, and `jaxpets.coordinates.space` makes a ModelSpace of them::

      env = mujoco_env("hopper.xml")
      rows = env.coordinates
      model = jaxpets.ensemble(config, coordinates.space(rows), obs_size=len(rows), ...)

    What is not of positions and velocities alone (sensors, places, contacts) is of the
    state that was reached and the action that led there.

    Args:
      model: a path to an MJCF, its text, or a compiled MuJoCo model as it is now.
      observe: what is observed, by the names that `observations.readings` explains; by
        default all joints, but not where the robot stands if nothing depends on it.
      control_step: in s, a multiple of the model's time step.
      action_repeat: for how many control steps an action is held; a step of the
        environment takes as long.
      reset: names of keyframes, of which a trial starts at one at random; or `(key) ->
        (qpos [Q], qvel [V])`, whose quaternions are made unit; or None for the model's
        own start. All but the function's are off what was named by normal noise, of
        0.001 standard deviation, and have its activations; the function's have none.
      terminal_fn: `(obs [..., D]) -> bool [...]`, whether a trial ends there; None for
        never.
      settle_time: for how long physics goes on from there, with controls of zero, until
        a trial begins, in s; a multiple of the environment's step.
      constants: `(key) -> constants` of a trial, as the place of a target, which are in
        EnvState for rewards to read; physics knows nothing of them.
      backend: "mujoco", C on the cores of the host, for up to hundreds of worlds;
        or "mjx", JAX on the device, with the same physics in float32.
      num_threads: of "mujoco", over which a batch is spread; by default all cores.

    Returns:
      An Env whose actions are in the units of the actuators, within their ranges.

    Raises:
      TypeError, ValueError: naming what cannot be: a model that does not compile or has
        no actuator or one without a finite range, a name that is no entry, a time that
        is no multiple, a function or a number of threads that is none, or what the
        backend lacks.
      FileNotFoundError: if there is no such file.
    """
    for name, function in (("terminal_fn", terminal_fn), ("constants", constants)):
        if function is not None:
            check_callable(name, function)
    if num_threads is not None:
        num_threads = check_count("num_threads", num_threads)
    check_real("settle_time", settle_time, 0.0)
    # C MuJoCo reads it at every step, and whoever has it may make another robot of it.
    model = copy.copy(load_model(model))
    found = readings(model, observe)
    coordinates = space([reading.coordinate for reading in found]).coordinates
    low, high = _action_range(model)
    num_substeps = _num_substeps(model, control_step, action_repeat)
    step_time = num_substeps * model.opt.timestep
    num_settling = _num_settling(settle_time, step_time)
    places = [(r.source, r.place) for r in found if r.source not in _STATE]
    if backend == "mujoco":
        engine = native_engine(
            model, num_substeps=num_substeps, places=places, num_threads=num_threads
        )
    elif backend == "mjx":
        engine = mjx_engine(model, num_substeps=num_substeps, places=places)
    else:
        raise ValueError(f'backend must be "mujoco" or "mjx", got {backend!r}.')
    begin_fn = start_fn(model, reset)
    seen_fn = _seen_fn(model, found, engine, step_time)

    def begin(key: Array) -> EnvState:
        check_key("key", key)
        drawn: Any = ()
        if constants is not None:
            key, constants_key = jax.random.split(key)
            drawn = constants(constants_key)
        qpos, qvel, act = begin_fn(key)
        still = jnp.zeros((model.nv,), jnp.float32)
        act = act if model.na else ()
        physics = Physics(unit_quaternions(model, qpos), qvel, still, act)
        idle = jnp.zeros_like(low)
        physics = _settled(engine, physics, idle, num_settling)
        return EnvState(seen_fn(physics, physics, idle), physics, drawn)

    def step(state: EnvState, action: Array) -> EnvState:
        check_array("action", action, [model.nu])
        physics = engine.advance(state.physics, action)
        obs = seen_fn(state.physics, physics, action)
        return EnvState(obs, physics, state.constants)

    return Env(begin, step, low, high, coordinates, terminal_fn)


def load_model(model: Any) -> Any:
    """Returns a compiled MuJoCo model from a path, the text of an MJCF, or itself.

    Raises:
      TypeError, ValueError: if it is none of these, or does not compile.
      FileNotFoundError: if there is no such file.
    """
    if isinstance(model, _C.MjModel):
        return model
    if not isinstance(model, (str, Path)):
        kind = type(model).__name__
        raise TypeError(f"model must be a path, MJCF or an MjModel, got {kind}.")
    # The text of a file may begin with a byte-order mark, which MuJoCo passes over.
    is_text = str(model).lstrip("\ufeff \t\r\n").startswith("<")
    where = "this text" if is_text else str(model)
    if not is_text and not os.path.isfile(model):  # False as well for what is too long
        raise FileNotFoundError(f"model must be a file or MJCF, but {where} is none.")
    load = _C.MjModel.from_xml_string if is_text else _C.MjModel.from_xml_path
    try:
        return load(str(model))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"model must compile, but {where} does not: {reason}"
        ) from error


def _action_range(model: Any) -> tuple[Array, Array]:
    """Returns the least and greatest value of every control, `[A]` both."""
    if not model.nu:
        raise ValueError("model must have an actuator, got none.")
    with np.errstate(over="ignore"):  # what is too large is refused below
        limits = np.asarray(model.actuator_ctrlrange, np.float32)
    owners = _control_names(model)
    controls = zip(owners, model.actuator_ctrllimited, limits, strict=True)
    for name, is_limited, (least, most) in controls:
        if not is_limited:
            raise ValueError(
                f"every actuator must have a ctrlrange, but {name} has none."
            )
        if not -np.inf < least < most < np.inf:
            raise ValueError(
                "every ctrlrange must go from a finite number to a greater one, but "
                f"that of {name} is {least:g} to {most:g}."
            )
    low, high = jnp.asarray(limits).T
    return low, high


def _control_names(model: Any) -> list[str]:
    """Returns whose each control is: of MuJoCo 4 on one may have several, or none."""
    names = actuators(model)
    sizes = getattr(model, "actuator_ctrlnum", [1] * len(names))
    found: list[str] = []
    for name, size in zip(names, sizes, strict=True):
        own = [f"control {k} of {name}" for k in range(size)]
        found += own if size > 1 else [name] * size
    return found


def _num_substeps(model: Any, control_step: float, action_repeat: int) -> int:
    check_real("control_step", control_step, 0.0, above=True)
    action_repeat = check_count("action_repeat", action_repeat)
    ratio = control_step / model.opt.timestep
    count = max(1, round(ratio))
    if abs(ratio - count) > 1e-6 * count:
        near = count * model.opt.timestep
        raise ValueError(
            f"control_step must be a multiple of the model's {model.opt.timestep:g} s, "
            f"as {near:g}, got {control_step!r}."
        )
    return count * action_repeat


def _num_settling(settle_time: float, step_time: float) -> int:
    """Returns how many steps of the environment go before a trial."""
    count = round(settle_time / step_time)
    if abs(settle_time - count * step_time) > 1e-6 * step_time:
        raise ValueError(
            f"settle_time must be a multiple of the {step_time:g} s of a step, "
            f"got {settle_time!r}."
        )
    return count


def _settled(engine: Engine, physics: Physics, idle: Array, count: int) -> Physics:
    """Returns where physics has come to after some steps."""

    def step(_: Array, before: Physics) -> Physics:
        return engine.advance(before, idle)

    if not count:
        return physics
    return cast(Physics, jax.lax.fori_loop(0, count, step, physics))


def _seen_fn(
    model: Any, found: Sequence[Reading], engine: Engine, step_time: float
) -> Callable[[Physics, Physics, Array], Array]:
    """Returns `(physics before, physics, action) -> obs [D]`."""
    act_start = 2 * model.nq + model.nv
    starts = {"mean_qvel": 0, "qpos": model.nq, "qvel": 2 * model.nq, "act": act_start}
    end = act_start + model.na
    places: list[int] = []
    num_read = 0
    for reading in found:
        if reading.source in _STATE:
            places.append(starts[reading.source] + reading.place)
        else:
            places.append(end + num_read)
            num_read += 1
    order = np.array(places)

    def seen(before: Physics, physics: Physics, action: Array) -> Array:
        mean_qvel = (physics.qpos - before.qpos) / step_time
        parts = [mean_qvel, physics.qpos, physics.qvel]
        if model.na:
            parts.append(physics.act)
        if num_read:
            parts.append(engine.read(physics, action))
        return jnp.concatenate(parts)[order]

    return seen
