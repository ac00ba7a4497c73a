"""C MuJoCo inside JAX programs: physics on the cores of the host."""

import copy
import itertools
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.checks import check_count
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.host_call import host_call
from jaxpets.envs.native_c import c_function

with needs_extra():
    import mujoco
    from mujoco.batch import Batch

_C: Any = mujoco  # its names are made at import, where pyright does not see them
_BITS = _C.mjtState
# `(qpos, qvel, qacc_warmstart, act, ctrl) -> (qpos, qvel, qacc_warmstart, act)`.
PhysicsFn = Callable[[Array, Array, Array, Any, Array], tuple[Array, Array, Array, Any]]

# What MuJoCo computes for sensors alone, and what it is computed of here.
_PARTS = {"subtree_linvel": ("cvel", "xipos", "subtree_com")}

# Where the clock of every step starts; MuJoCo sets it to 0 when it resets a state, in
# any substep, and then goes on.
_START_TIME = 1.0


def native_physics(
    model: Any, *, num_substeps: int, num_threads: int | None = None
) -> PhysicsFn:
    """Builds a step of physics that runs in C, in double precision.

    Under any nest of `jax.vmap` the host is called once for the whole batch, and
    `mujoco.batch` spreads it over threads of C; the result does not depend on how many
    there are. They are made at the first call that needs them, and go with the
    function. Several devices call in turn, each for its share under `jax.shard_map`;
    under `jit` alone each steps the whole batch.

    Args:
      model: a compiled MuJoCo model.
      num_substeps: steps of `model.opt.timestep` per call, with one control.
      num_threads: at most this many; by default the cores this process may use.

    Returns:
      `(qpos [Q], qvel [V], qacc_warmstart [V], act [M], ctrl [U])`, float32, to the
      first four after the step; act is () where no actuator has an activation. All are
      NaN where an input is not finite or where MuJoCo would have reset the state: once
      it has blown up. It has no gradient.

    Raises:
      TypeError, ValueError: unless the counts are positive Python integers, and the
        state of the model is its positions, velocities and activations.
    """
    num_substeps = check_count("num_substeps", num_substeps)
    check_state(model)
    model = copy.copy(model)  # whoever has it may change it
    ends = np.cumsum([model.nq, model.nv, model.na, model.nv]).tolist()
    size = ends[-1]

    def visit(batch: Any, ids: np.ndarray) -> np.ndarray:
        batch.step(ids, num_substeps)
        return batch.state[: len(ids), 1 : 1 + size]

    run = _host_function(model, visit, size, num_threads, num_substeps=num_substeps)

    def step(
        qpos: Array, qvel: Array, qacc_warmstart: Array, act: Any, ctrl: Array
    ) -> tuple[Array, Array, Array, Any]:
        outputs = run(*_packed(model, qpos, qvel, qacc_warmstart, act, ctrl))
        return (
            outputs[: ends[0]],
            outputs[ends[0] : ends[1]],
            outputs[ends[2] :],
            outputs[ends[1] : ends[2]] if model.na else (),
        )

    return step


def check_state(model: Any) -> None:
    """Raises if physics goes on from more than positions, velocities and activations.

    As from what a control was some time ago, where an actuator has a delay.
    """
    known = 1 + model.nq + model.nv + model.na
    if _C.mj_stateSize(model, _BITS.mjSTATE_FULLPHYSICS) != known:
        raise ValueError(
            "model must have no state but positions, velocities and activations."
        )


def _packed(
    model: Any, qpos: Array, qvel: Array, qacc_warmstart: Array, act: Any, ctrl: Array
) -> list[Array]:
    """Returns the inputs in the order in which MuJoCo packs them, each of its size."""
    parts = {
        "qpos": (qpos, model.nq),
        "qvel": (qvel, model.nv),
        "act": (act, model.na),
        "qacc_warmstart": (qacc_warmstart, model.nv),
        "ctrl": (ctrl, model.nu),
    }
    if not model.na:
        del parts["act"]
    for name, (part, size) in parts.items():
        if jnp.shape(part) != (size,):
            shape = [*jnp.shape(part)]
            raise ValueError(f"{name} must have shape [{size}], got {shape}.")
    return [part for part, _ in parts.values()]


def native_readings(
    model: Any, places: Sequence[tuple[str, int]], *, num_threads: int | None = None
) -> Callable[[Array, Array, Array, Any, Array], Array]:
    """Builds what reads MuJoCo's data in a state: sensors, places, velocities.

    As `native_physics` it runs in C, once for a whole batch. Everything is of the state
    it is given, forces and accelerations too: not of the substep before it.

    Args:
      model: as `native_physics` takes it.
      places: R names of arrays of MuJoCo's data and indices in them, read as one row.
      num_threads: as there.

    Returns:
      `(qpos [Q], qvel [V], qacc_warmstart [V], act [M] or (), ctrl [U]) -> [R]`,
      float32; NaN where an input is not finite.

    Raises:
      ValueError: if there is no such array or place to read, or the model has more
        state than `native_physics` takes.
    """
    check_state(model)
    sizes = _sizes(model)
    for source, place in places:
        if not 0 <= place < sizes.get(source, 0):
            known = ", ".join(f"{name} [{size}]" for name, size in sizes.items())
            raise ValueError(f"places must be of {known}, got {source!r}, {place}.")
    model = copy.copy(model)
    size = len(places)
    # Neighbours of one array are copied at once.
    arrays: dict[str, tuple[list[int], list[int]]] = {}
    for i, (source, place) in enumerate(places):
        outs, ins = arrays.setdefault(source, ([], []))
        outs.append(i)
        ins.append(place)
    parts = {source: _PARTS.get(source, (source,)) for source in arrays}
    compute_fns = {x: _subtree_velocity(model) for x in arrays if x in _PARTS}

    def visit(batch: Any, ids: np.ndarray) -> np.ndarray:
        for part in itertools.chain(*parts.values()):
            batch.bind(part)  # so that the call copies it out
        batch.forward(ids)
        count = len(ids)
        rows = np.empty((count, size))
        for source, (outs, ins) in arrays.items():
            found = [batch.bind(part)[:count] for part in parts[source]]
            whole = compute_fns[source](*found) if source in compute_fns else found[0]
            rows[:, outs] = whole.reshape(count, -1)[:, ins]
        return rows

    run = _host_function(model, visit, size, num_threads, places=places)

    def read(
        qpos: Array, qvel: Array, qacc_warmstart: Array, act: Any, ctrl: Array
    ) -> Array:
        return run(*_packed(model, qpos, qvel, qacc_warmstart, act, ctrl))

    return read


def _sizes(model: Any) -> dict[str, int]:
    """Returns what may be read, and how much of it there is."""
    points = {"xpos": 3, "xipos": 3, "xmat": 9, "subtree_linvel": 3}
    return {
        "sensordata": model.nsensordata,
        "site_xpos": 3 * model.nsite,
        **{name: size * model.nbody for name, size in points.items()},
        "ncon": 1,
    }


def _subtree_velocity(model: Any) -> Callable[..., np.ndarray]:
    """Returns what `mj_subtreeVel` computes of `_PARTS`, `[rows, bodies, 3]`."""
    inside = np.eye(model.nbody)  # whether a body is in a subtree
    for body in range(model.nbody - 1, 0, -1):
        inside[model.body_parentid[body]] += inside[body]
    masses = inside * model.body_mass
    shares = masses / np.maximum(masses.sum(-1, keepdims=True), _C.mjMINVAL)

    def velocity(cvel: np.ndarray, xipos: np.ndarray, com: np.ndarray) -> np.ndarray:
        arm = xipos - com[:, model.body_rootid]
        return shares @ (cvel[..., 3:] + np.cross(cvel[..., :3], arm))

    return velocity


def _host_function(
    model: Any,
    visit: Callable[[Any, np.ndarray], np.ndarray],
    size: int,
    num_threads: int | None,
    *,
    num_substeps: int = 0,
    places: Sequence[tuple[str, int]] = (),
) -> Callable[..., Array]:
    """Builds a function of JAX that has C MuJoCo visit every row of a batch.

    XLA calls C itself for a CPU or an NVIDIA GPU where there is a compiler, and else
    the function of NumPy here.

    Args:
      model: a compiled MuJoCo model.
      visit: gets a `mujoco.batch.Batch` and its first simulations `[N]`, whose states
        the inputs are; returns `[N, size]`.
      size: how many numbers are returned for a row.
      num_threads: at most this many; by default the cores this process may use.
      num_substeps: by how many steps a visit moves a row.
      places: what it reads of it, if it moves none.
    """
    if num_threads is None:
        num_threads = _num_cores()
    num_threads = check_count("num_threads", num_threads)
    lock = threading.Lock()
    _batch(model, 1, 1)  # now, and not in a program, is the time to say that it cannot
    batches: list[Any] = []  # one, as large as the largest call
    # A clock that was set back shows at most the duration of a visit.
    least = num_substeps * model.opt.timestep + 0.5 * _START_TIME

    def host(inputs: np.ndarray) -> np.ndarray:
        flat = inputs.reshape(-1, inputs.shape[-1])
        count = len(flat)
        with lock:
            if not batches or batches[0].nsim < count:
                batches[:] = [_batch(model, count, min(num_threads, count))]
            batch = batches[0]
            # A row begins with the clock, and goes on as `_packed` has it.
            state = batch.state[:count]
            state[:, 0] = _START_TIME
            state[:, 1 : 1 + flat.shape[1]] = flat
            outputs = visit(batch, np.arange(count)).astype(np.float32)
            outputs[state[:, 0] < least] = np.nan
        return outputs.reshape(*inputs.shape[:-1], size)

    by_numpy = host_call(host, size)
    by_c = c_function(
        model, size, num_threads=num_threads, num_substeps=num_substeps,
        clock=(_START_TIME, least), places=places,
    )  # fmt: skip

    def call(inputs: Array) -> Array:
        if by_c is None:
            return by_numpy(inputs)
        choose: Any = jax.lax.platform_dependent
        return choose(inputs, cpu=by_c, cuda=by_c, default=by_numpy)

    def run(*parts: Array) -> Array:
        # As one array, so that a GPU copies once each way.
        inputs = jnp.concatenate(parts)
        # MuJoCo takes a control that is not finite for 0, and logs every such state.
        finite = jnp.isfinite(inputs).all()
        outputs = call(jnp.where(finite, inputs, 0.0))
        return jnp.where(finite, outputs, jnp.nan)

    return run


def _batch(model: Any, count: int, num_threads: int) -> Batch:
    try:
        return Batch(model, count, num_threads)
    except ValueError as error:
        raise ValueError(f"model must run in batches: {error}.") from error


def _num_cores() -> int:
    # macOS does not say what a process may use.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
