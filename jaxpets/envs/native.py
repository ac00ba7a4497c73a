"""C MuJoCo inside JAX programs: physics on the cores of the host, by a callback."""

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxpets._src.checks import check_count
from jaxpets.envs.extra import needs_extra

with needs_extra():
    import mujoco

# `(qpos, qvel, qacc_warmstart, ctrl) -> (qpos, qvel, qacc_warmstart)`.
PhysicsFn = Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]

# To wake a thread takes about as long as two environment steps of HalfCheetah.
_MIN_ROWS_PER_THREAD = 4
# Where the clock of every step starts; MuJoCo sets it to 0 when it resets a state.
_START_TIME = 1.0


def native_physics(
    model: Any, *, num_substeps: int, num_threads: int | None = None
) -> PhysicsFn:
    """Builds a step of physics that runs in C, in double precision.

    Under any nest of `jax.vmap` the host is called once for the whole batch and spreads
    it over its threads; the result does not depend on how many there are. Threads and
    buffers are made at the first call that needs them, and go with the function.
    Calls from several devices take turns.

    `mujoco.rollout` is not used: it does not return where its solver would start next.

    Args:
      model: a compiled MuJoCo model.
      num_substeps: steps of `model.opt.timestep` per call, with one control.
      num_threads: at most this many; by default the cores this process may use.

    Returns:
      `(qpos [Q], qvel [V], qacc_warmstart [V], ctrl [U])`, float32, to the first three
      after the step. All are NaN where an input is not finite or where MuJoCo would
      have reset the state: once it has blown up. It has no gradient.

    Raises:
      TypeError, ValueError: unless the counts are positive Python integers, and the
        state of the model is its positions and velocities.
    """
    check_count("num_substeps", num_substeps)
    if num_threads is None:
        num_threads = _num_cores()
    check_count("num_threads", num_threads)
    c: Any = mujoco  # its names are made at import, where pyright does not see them
    bits = c.mjtState
    if c.mj_stateSize(model, bits.mjSTATE_FULLPHYSICS) != 1 + model.nq + model.nv:
        raise ValueError("model must have no state but positions and velocities.")
    # One row: the clock, then the inputs in the order in which MuJoCo packs them.
    spec = int(
        bits.mjSTATE_TIME
        | bits.mjSTATE_QPOS
        | bits.mjSTATE_QVEL
        | bits.mjSTATE_WARMSTART
        | bits.mjSTATE_CTRL
    )
    ends = np.cumsum([model.nq, model.nv, model.nv]).tolist()
    size = ends[-1]

    lock = threading.Lock()
    pool = ThreadPoolExecutor(max(1, num_threads - 1), "jaxpets-native")
    buffers: list[Any] = []  # scratch of one thread each

    def step_rows(rows: np.ndarray, data: Any) -> None:
        # In place. Python holds its lock for 1 us of the 30 that a row takes.
        for row in rows:
            c.mj_setState(model, data, row, spec)
            c.mj_step(model, data, num_substeps)
            c.mj_getState(model, data, row, spec)

    def step_batch(rows: np.ndarray) -> None:
        count = min(num_threads, max(1, len(rows) // _MIN_ROWS_PER_THREAD))
        with lock:
            while len(buffers) < count:
                buffers.append(c.MjData(model))
            # Every count-th row, as neighbours may all be lying and take longer.
            others = [
                pool.submit(step_rows, rows[i::count], buffers[i])
                for i in range(1, count)
            ]
            step_rows(rows[::count], buffers[0])
            for other in others:
                other.result()

    def host(inputs: Any) -> np.ndarray:
        # NumPy only: an operation of JAX in here can wait for itself for ever.
        inputs = np.asarray(inputs)
        flat = inputs.reshape(-1, inputs.shape[-1])
        rows = np.full((len(flat), 1 + flat.shape[1]), _START_TIME, np.float64)
        rows[:, 1:] = flat
        step_batch(rows)
        rows[rows[:, 0] < _START_TIME] = np.nan
        outputs = rows[:, 1 : 1 + size].astype(np.float32)
        return outputs.reshape(*inputs.shape[:-1], size)

    def step(
        qpos: Array, qvel: Array, qacc_warmstart: Array, ctrl: Array
    ) -> tuple[Array, Array, Array]:
        # As one array, so that a GPU copies once each way.
        inputs = jnp.concatenate([qpos, qvel, qacc_warmstart, ctrl])
        # MuJoCo takes a control that is not finite for 0, and logs every such state.
        finite = jnp.isfinite(inputs).all()
        outputs = jax.pure_callback(
            host,
            jax.ShapeDtypeStruct((size,), jnp.float32),
            jnp.where(finite, inputs, 0.0),
            vmap_method="broadcast_all",
        )
        outputs = jnp.where(finite, outputs, jnp.nan)
        return outputs[: ends[0]], outputs[ends[0] : ends[1]], outputs[ends[1] :]

    return step


def _num_cores() -> int:
    # macOS does not say what a process may use.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
