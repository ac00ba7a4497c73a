"""How an agent calls a step: numbers of the host go in, and an action comes back."""

import ctypes
import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Sharding, SingleDeviceSharding

from jaxpets._src.agent_steps import ActFn, Given
from jaxpets._src.ensemble_params import EnsembleParams
from jaxpets._src.types import Planner, PlanParams

_APART = ("gpu",)  # platforms whose memory is not the host's
_UNSEEN = 0x7FC0DEAD  # a NaN that no arithmetic makes


class Places(NamedTuple):
    """Memory of the host that a device reads and writes, and the device's own."""

    host: Sharding
    device: Sharding


def places(params: EnsembleParams) -> Places | None:
    """Returns where a step's numbers and its state lie; None leaves it to JAX.

    Args:
      params: of the model; it is computed where they are. On a CPU there is nothing to
        gain. Where there are several devices a planner may use them all, and then its
        outputs have no one place.
    """
    devices = {x for leaf in jax.tree.leaves(params) for x in leaf.devices()}
    if len(devices) != 1 or jax.local_device_count() != 1:
        return None
    (device,) = devices
    kinds = {memory.kind for memory in device.addressable_memories()}
    if device.platform not in _APART or "pinned_host" not in kinds:
        return None
    here = SingleDeviceSharding(device)
    return Places(here.with_memory_kind("pinned_host"), here)


def first_state(planner: Planner, lead: tuple[int, ...], places: Places | None) -> Any:
    """Returns a planner's state with the leading axes of its worlds, in its place.

    A step returns it there; if it began elsewhere, the second step would compile anew.
    It is a copy, as a step may take its memory, and a planner may keep what it gives.
    """

    def every(leaf: Any) -> Array:
        return jnp.array(jnp.broadcast_to(leaf, (*lead, *jnp.shape(leaf))))

    state = jax.tree.map(every, planner.init())
    return jax.device_put(state, places.device if places else None)


def compiled(act: ActFn, places: Places | None) -> "Direct | Mailbox":
    """Returns a step that compiles in its first call, and waits for its action."""
    return Direct(act) if places is None else Mailbox(act, places)


class Direct:
    """A compiled step as JAX has it."""

    def __init__(self, act: ActFn) -> None:
        self.program: Any = jax.jit(act)

    def __call__(
        self, params: PlanParams, key: Array, state: Any, given: Given
    ) -> tuple[np.ndarray, Any]:
        """Returns the action, a copy, and the state, which may not be computed yet."""
        action, state = self.program(params, key, state, given)
        return np.array(action), state


class Mailbox:
    """A compiled step whose numbers pass through memory that host and device share.

    XLA takes long to bring a few numbers to a GPU, and to say that a program has ended:
    see "A plan that is waited for" in benchmarks/README.md. Here the host writes what
    is given into pinned memory, all in one array, from where the program reads it. The
    action comes into an array that each call gives to the next, filled with a NaN of
    its own, and is there once all of that has been replaced.

    A call takes the memory of the state that it gets. So all numbers of a program are
    where they were in the call before, and XLA can start its CUDA graph as it is.

    That an action is written once, when it is known, is so where the program has its
    other numbers elsewhere: of GPUs and not of a CPU, where it may work in that array.
    """

    def __init__(self, act: ActFn, places: Places) -> None:
        def program(
            slot: Array, state: Any, params: PlanParams, key: Array, words: Array
        ) -> tuple[Array, Any]:
            del slot  # its memory is the action's
            words = jax.device_put(words, jax.memory.Space.Device)
            # All waits for them, so that XLA makes one CUDA graph of the whole step.
            params, key, state, words = jax.lax.optimization_barrier(
                (params, key, state, words)
            )
            return act(params, key, state, _unpacked(words))

        self._act, self._host = act, places.host
        self.program: Any = jax.jit(
            program,
            donate_argnums=(0, 1),
            keep_unused=True,
            out_shardings=tuple(places),
        )
        # The slot and what is given, each with a view of it; None while it is not known
        # who reads and writes there.
        self._boxes: Any = None

    def __call__(
        self, params: PlanParams, key: Array, state: Any, given: Given
    ) -> tuple[np.ndarray, Any]:
        """Returns what Direct does. The state that it gets is gone after that."""
        boxes, self._boxes = self._boxes, None
        if boxes is None:
            action, _ = jax.eval_shape(self._act, params, key, state, given)
            *lead, size = np.shape(given.obs)
            boxes = (
                self._shared(action.shape, action.dtype),
                self._shared((*lead, size + 2), np.int32),
            )
        (slot, action), (inputs, view) = boxes
        slot.block_until_ready()  # the call before has ended, and reads no more
        _pack(view, given)
        awaited = action.reshape(-1).view(np.uint32)
        awaited[:] = _UNSEEN
        slot, state = self.program(slot, state, params, key, inputs)
        if slot.unsafe_buffer_pointer() != action.ctypes.data:
            action = _seen(slot.block_until_ready())  # XLA has put it elsewhere
            awaited = awaited[:0]
        has_ended = False
        while (awaited == _UNSEEN).any():
            if has_ended:
                return np.array(slot), state  # which raises what has failed
            has_ended = slot.is_ready()
            os.sched_yield()  # lets other threads of Python go on
        self._boxes = (slot, action), (inputs, view)
        return action.copy(), state

    def _shared(self, shape: tuple[int, ...], dtype: Any) -> tuple[Array, np.ndarray]:
        """Returns zeros in that memory, and the same as an array of NumPy."""
        array = jax.device_put(np.zeros(shape, dtype), self._host)
        return array, _seen(array.block_until_ready())


def _pack(words: np.ndarray, given: Given) -> None:
    """Writes into `[D + 2]` or `[N, D + 2]`: of every world the number, a flag, obs."""
    words[..., 0] = given.number
    words[..., 1] = given.is_new
    words[..., 2:].view(np.float32)[...] = given.obs


def _unpacked(words: Array) -> Given:
    """Returns what was packed, on the device."""
    obs = jax.lax.bitcast_convert_type(words[..., 2:], jnp.float32)
    return Given(words[..., 0].reshape(-1)[0], words[..., 1] != 0, obs)


def _seen(array: Array) -> np.ndarray:
    """Returns an array in memory of the host as it is, to be read and written."""
    memory = (ctypes.c_char * array.nbytes).from_address(array.unsafe_buffer_pointer())
    return np.frombuffer(memoryview(memory), array.dtype).reshape(array.shape)
