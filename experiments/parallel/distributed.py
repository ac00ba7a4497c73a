"""A run on several hosts: processes that join, and the little they tell each other.

Process 0 has the run's folder and the screen. What it reads, decides or fails at gets
to the others through here, so that all of them go on, stop or end together.
"""

import contextlib
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from .. import errors
from ..errors import (
    InterruptedRun,
    OutOfMemoryError,
    RunEnd,
    RunError,
    StoppedTogether,
    UsageError,
)

_CONNECTIONS = ("Gloo", "NCCL")  # what carries an exchange; its errors have the name


class ProcessSpec(NamedTuple):
    """This process among the others; None is for jax to find out."""

    coordinator_address: str | None
    num_processes: int | None
    process_id: int | None


def say(text: str) -> None:
    """Prints a line for the user, once for all processes."""
    if is_first():
        print(errors.printable(text), file=sys.stderr, flush=True)


@contextlib.contextmanager
def joined(spec: ProcessSpec | None) -> Iterator[None]:
    """Makes this process one of several for a while; None leaves it alone.

    Raises:
      UsageError: if jax cannot tell where the others are. If they are not there within
        five minutes, it ends the process.
    """
    if spec is None:
        yield
        return
    say("waiting for the other processes, at most 5 minutes.")
    # It would catch SIGTERM, which is a run's own to handle.
    jax.config.update("jax_enable_preemption_service", False)
    # A cluster is asked for the place only: it would also give us one device of many.
    detect = "deactivate" if spec.coordinator_address else None
    try:
        jax.distributed.initialize(*spec, cluster_detection_method=detect)
    except (RuntimeError, ValueError) as error:
        why = str(error).partition("\n")[0].rstrip(".")
        raise UsageError(
            f"cannot join the other processes ({why}). Check --coordinator-address, "
            "--num-processes and --process-id on every host."
        ) from error
    try:
        yield
    except BaseException as error:
        if _is_known_to_all(error):
            _leave()
        raise  # else the others wait for us, and end once we are gone
    _leave()


def _is_known_to_all(error: BaseException) -> bool:
    together = isinstance(error, (RunError, StoppedTogether))
    return together and not isinstance(error, OutOfMemoryError)


def _leave() -> None:
    with contextlib.suppress(InterruptedRun):
        agree(0)  # process 0 may have been busy for longer than a shutdown waits
        jax.distributed.shutdown()


def is_alone() -> bool:
    """Returns whether there is no other process.

    Asked in a way that starts no backend: usage errors come before that.
    """
    return not jax.distributed.is_initialized()


def is_first() -> bool:
    """Returns whether this process has the run's folder and the screen."""
    return is_alone() or jax.process_index() == 0


def on_first(call: Callable[[], Any]) -> Any:
    """Calls on process 0 only; all processes get the JSON value or the RunEnd."""
    if is_alone():
        return call()
    answer, failure = {}, None
    if is_first():
        try:
            answer = {"value": call()}
        except (Exception, RunEnd) as error:
            failure = error
            kind = error if isinstance(error, RunEnd) else RunError()
            words = str(error) or type(error).__name__
            answer = {"kind": type(kind).__name__, "words": words}
    data = np.frombuffer(json.dumps(answer).encode(), np.uint8)
    size = int(_from_first(np.array([data.size], np.int32))[0])
    data = _from_first(data if is_first() else np.zeros(size, np.uint8))
    answer = json.loads(data.tobytes())
    if failure is not None:
        raise failure
    if "kind" in answer:
        raise getattr(errors, answer["kind"])(answer["words"])
    return answer["value"]


@contextlib.contextmanager
def held_by_first(manager: contextlib.AbstractContextManager[None]) -> Iterator[None]:
    """Enters a context on process 0 only, for all of them."""
    with contextlib.ExitStack() as stack:
        on_first(lambda: stack.enter_context(manager))
        yield


def share(tree: Any) -> Any:
    """Gives every process the NumPy arrays of process 0.

    Args:
      tree: of the same types everywhere; elsewhere its values do not count.
    """
    if is_alone():
        return tree
    leaves, structure = jax.tree.flatten(tree)
    data = _from_first(_packed(leaves))
    return structure.unflatten(x[0] for x in _unpacked(data[None], leaves))


def gather(tree: Any) -> Any:
    """Returns the NumPy arrays of all processes, `[processes, ...]`, to all."""
    leaves, structure = jax.tree.flatten(tree)
    every = _from_all(_packed(leaves))
    return structure.unflatten(_unpacked(every, leaves))


def agree(number: int) -> int:
    """Returns the largest number that any process has brought."""
    if is_alone():
        return number
    return int(_from_all(np.array(number, np.int32)).max())


def _from_first(array: np.ndarray) -> np.ndarray:
    with _with_others():
        return multihost_utils.broadcast_one_to_all(array)


def _from_all(array: np.ndarray) -> np.ndarray:
    with _with_others():
        return multihost_utils.process_allgather(array)


@contextlib.contextmanager
def _with_others() -> Iterator[None]:
    """Stops this process, as a signal does, where another one no longer answers."""
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:  # as jax has both
        if not any(name in str(error) for name in _CONNECTIONS):
            raise
        other = "another process"
        if jax.process_count() == 2:
            other = f"process {1 - jax.process_index()}"
        raise InterruptedRun(f"{other} is gone") from error


def _packed(arrays: Iterable[np.ndarray]) -> np.ndarray:
    """Returns all bytes in one array: one message, and no arithmetic on numbers."""
    return np.frombuffer(b"".join(np.asarray(x).tobytes() for x in arrays), np.uint8)


def _unpacked(rows: np.ndarray, like: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Returns what was packed in every row of `[rows, bytes]`."""
    done, found = 0, []
    for x in like:
        part = np.ascontiguousarray(rows[:, done : done + x.nbytes])
        found.append(part.view(x.dtype).reshape(len(rows), *x.shape))
        done += x.nbytes
    return found
