"""C MuJoCo inside JAX programs: physics on the cores of the host, by a callback."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, cast

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.checks import check_count
from jaxpets.envs.extra import needs_extra
from jaxpets.envs.host_call import host_call

with needs_extra():
    import mujoco

_BITS = cast(Any, mujoco).mjtState  # made at import, where pyright does not see it
# One row: the clock, then the inputs in the order in which MuJoCo packs them.
_INPUTS = int(
    _BITS.mjSTATE_TIME
    | _BITS.mjSTATE_QPOS
    | _BITS.mjSTATE_QVEL
    | _BITS.mjSTATE_ACT
    | _BITS.mjSTATE_WARMSTART
    | _BITS.mjSTATE_CTRL
)
# `(qpos, qvel, qacc_warmstart, act, ctrl) -> (qpos, qvel, qacc_warmstart, act)`.
PhysicsFn = Callable[[Array, Array, Array, Any, Array], tuple[Array, Array, Array, Any]]

# To wake a thread takes about as long as two environment steps of HalfCheetah.
_MIN_ROWS_PER_THREAD = 4
# Where the clock of every step starts; MuJoCo sets it to 0 when it resets a state, in
# any substep, and then goes on.
_START_TIME = 1.0


def native_physics(
    model: Any, *, num_substeps: int, num_threads: int | None = None
) -> PhysicsFn:
    """Builds a step of physics that runs in C, in double precision.

    Under any nest of `jax.vmap` the host is called once for the whole batch and spreads
    it over its threads; the result does not depend on how many there are. Threads and
    buffers are made at the first call that needs them, and go with the function.
    Several devices call in turn, each for its share under `jax.shard_map`; under `jit`
    alone each steps the whole batch.

    `mujoco.rollout` is not used: it does not return where its solver would start next.

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
    check_count("num_substeps", num_substeps)
    check_state(model)
    c: Any = mujoco
    ends = np.cumsum([model.nq, model.nv, model.na, model.nv]).tolist()
    size = ends[-1]

    def visit(row: np.ndarray, data: Any) -> None:
        # In place. Python holds its lock for 1 us of the 30 that a row takes.
        c.mj_setState(model, data, row, _INPUTS)
        c.mj_step(model, data, num_substeps)
        c.mj_getState(model, data, row, _INPUTS)

    run = _host_function(
        model, visit, size, num_threads, num_substeps * model.opt.timestep
    )

    def step(
        qpos: Array, qvel: Array, qacc_warmstart: Array, act: Any, ctrl: Array
    ) -> tuple[Array, Array, Array, Any]:
        outputs = run(*_packed(qpos, qvel, qacc_warmstart, act, ctrl))
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
    c: Any = mujoco
    known = 1 + model.nq + model.nv + model.na
    if c.mj_stateSize(model, _BITS.mjSTATE_FULLPHYSICS) != known:
        raise ValueError(
            "model must have no state but positions, velocities and activations."
        )


def _packed(
    qpos: Array, qvel: Array, qacc_warmstart: Array, act: Any, ctrl: Array
) -> list[Array]:
    """Returns the inputs in the order in which MuJoCo packs them."""
    activations = [act] if isinstance(act, Array) else []
    return [qpos, qvel, *activations, qacc_warmstart, ctrl]


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
    """
    c: Any = mujoco
    num_inputs = c.mj_stateSize(model, _INPUTS)
    size = len(places)
    # Neighbours of one array are copied at once.
    arrays: dict[str, tuple[list[int], list[int]]] = {}
    for i, (source, place) in enumerate(places):
        outs, ins = arrays.setdefault(source, ([], []))
        outs.append(1 + i)
        ins.append(place)

    def visit(row: np.ndarray, data: Any) -> None:
        c.mj_setState(model, data, row[:num_inputs], _INPUTS)
        c.mj_forward(model, data)
        if "subtree_linvel" in arrays:
            c.mj_subtreeVel(model, data)
        for source, (outs, ins) in arrays.items():
            row[outs] = np.ravel(getattr(data, source))[ins]

    run = _host_function(model, visit, size, num_threads)

    def read(
        qpos: Array, qvel: Array, qacc_warmstart: Array, act: Any, ctrl: Array
    ) -> Array:
        return run(*_packed(qpos, qvel, qacc_warmstart, act, ctrl))

    return read


def _host_function(
    model: Any,
    visit: Callable[[np.ndarray, Any], None],
    size: int,
    num_threads: int | None,
    duration: float = 0.0,
) -> Callable[..., Array]:
    """Builds a function of JAX that has C MuJoCo visit every row of a batch.

    Args:
      model: a compiled MuJoCo model.
      visit: gets a row, in which the results replace the inputs behind the clock, and
        scratch of its own thread.
      size: how many numbers are left in a row.
      num_threads: at most this many; by default the cores this process may use.
      duration: by how much a visit moves the clock, in s.
    """
    if num_threads is None:
        num_threads = _num_cores()
    check_count("num_threads", num_threads)
    c: Any = mujoco
    lock = threading.Lock()
    pool = ThreadPoolExecutor(max(1, num_threads - 1), "jaxpets-native")
    buffers: list[Any] = []  # scratch of one thread each

    def visit_rows(rows: np.ndarray, data: Any) -> None:
        for row in rows:
            visit(row, data)

    def visit_batch(rows: np.ndarray) -> None:
        count = min(num_threads, max(1, len(rows) // _MIN_ROWS_PER_THREAD))
        with lock:
            while len(buffers) < count:
                buffers.append(c.MjData(model))
            # Every count-th row, as neighbours may all be lying and take longer.
            others = [
                pool.submit(visit_rows, rows[i::count], buffers[i])
                for i in range(1, count)
            ]
            try:
                visit_rows(rows[::count], buffers[0])
            finally:
                wait(others)  # none has scratch of the next call
            for other in others:
                other.result()

    def host(inputs: np.ndarray) -> np.ndarray:
        flat = inputs.reshape(-1, inputs.shape[-1])
        width = 1 + max(flat.shape[1], size)
        rows = np.full((len(flat), width), _START_TIME, np.float64)
        rows[:, 1 : 1 + flat.shape[1]] = flat
        visit_batch(rows)
        # A clock that was set back shows at most the duration.
        rows[rows[:, 0] < duration + 0.5 * _START_TIME] = np.nan
        outputs = rows[:, 1 : 1 + size].astype(np.float32)
        return outputs.reshape(*inputs.shape[:-1], size)

    call = host_call(host, size)

    def run(*parts: Array) -> Array:
        # As one array, so that a GPU copies once each way.
        inputs = jnp.concatenate(parts)
        # MuJoCo takes a control that is not finite for 0, and logs every such state.
        finite = jnp.isfinite(inputs).all()
        outputs = call(jnp.where(finite, inputs, 0.0))
        return jnp.where(finite, outputs, jnp.nan)

    return run


def _num_cores() -> int:
    # macOS does not say what a process may use.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
