"""How a run is stopped from outside: the first signal asks, and has a deadline.

Python calls a handler between two of its own steps, which is after a program of XLA has
been compiled or has run. A thread that sleeps until a signal comes keeps the deadline.
It leaves without Python's shutdown, which programs that still run can crash; to what is
saved that is a kill, which loses nothing.
"""

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any, NoReturn

from .errors import InterruptedRun, last_line

_URGENT = (signal.SIGINT, signal.SIGTERM)  # if they come again
_SIGNALS = (*_URGENT, signal.SIGHUP)  # of which a terminal that closes sends several


class Stop:
    """What is to be done where a run does not stop in time."""

    def __init__(self) -> None:
        self.seconds = 4.0
        """How long it has, from the first signal on."""
        self.tell: Callable[[str], None] = lambda reason: None
        """Called with the reason, from another thread, before the process ends."""


def as_program(main: Callable[[], int]) -> NoReturn:
    """Runs what returns an exit code as a program, and leaves."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # While there is no run it ends the process. Python would raise it anywhere, and
        # jax, where it looks for a GPU, takes that for a GPU that does not work.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    code: Any = 1
    with unheard():  # to the very end: threads of a failed save come last
        try:
            code = main()
            sys.stdout.flush()
        except SystemExit as error:
            code = error.code
        except BrokenPipeError:  # who reads has seen enough, as in `... --help | head`
            code = 128 + signal.SIGPIPE
        except BaseException:
            traceback.print_exc()
        leave(code)


@contextlib.contextmanager
def stoppable() -> Iterator[Stop]:
    """Turns the first signal into InterruptedRun, or into the end of the process.

    That is SIGINT, SIGTERM or SIGHUP, wherever the program is, for as long as this is
    held; no `except Exception` catches it. `first_signal`, inside, may do something
    else with it. What is not left within seconds is ended: the process tells the Stop,
    and exits with the code of InterruptedRun. A second signal ends it at once.
    """

    def stop(number: int) -> None:
        raise InterruptedRun(signal.Signals(number).name)

    late = Stop()
    with _watched(late), unheard(), first_signal(stop):
        yield late


@contextlib.contextmanager
def first_signal(act: Callable[[int], None]) -> Iterator[None]:
    """Calls `act` with the first signal, when Python can; a second ends the process."""

    def handler(number: int, frame: FrameType | None) -> None:
        del frame
        for name in names:
            again = signal.SIG_DFL if name in _URGENT else signal.SIG_IGN
            signal.signal(name, again)
        act(number)

    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN  # as under nohup
    names = _SIGNALS if hangs_up else _URGENT
    before = [signal.signal(name, handler) for name in names]
    try:
        yield
    finally:
        for name, old in zip(names, before, strict=True):
            signal.signal(name, old)


@contextlib.contextmanager
def unheard() -> Iterator[None]:
    """Keeps tracebacks from being shown of what gets nowhere and means nothing.

    InterruptedRun in callbacks, as those of its garbage collector: the deadline still
    holds. And what the threads of orbax and TensorStore come upon when a save has
    failed before they were done, which they log: the save has said why.
    """
    before, logger = sys.unraisablehook, logging.getLogger("absl")
    level = logger.level

    def hook(unraisable: Any) -> None:
        late = str(unraisable.exc_value) == "Event loop is closed"
        if not late and not issubclass(unraisable.exc_type, InterruptedRun):
            before(unraisable)

    sys.unraisablehook = hook
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
        sys.unraisablehook = before


def say(text: str) -> None:
    """Prints a last line for the user, who may be gone."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def leave(code: int) -> NoReturn:
    """Ends the process, without a shutdown where it did not end well."""
    if not code:
        sys.exit(0)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


@contextlib.contextmanager
def _watched(late: Stop) -> Iterator[None]:
    """Has a thread end the process some time after the first signal, unless over."""
    told, woken = socket.socketpair()
    woken.setblocking(False)
    before = signal.set_wakeup_fd(woken.fileno(), warn_on_full_buffer=False)
    thread = threading.Thread(target=_watch, args=(told, late), daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        woken.close()  # ends the thread
        thread.join()
        told.close()


def _watch(told: socket.socket, late: Stop) -> None:
    first = _next(told, _SIGNALS)
    if first is None:
        return
    try:
        second = _next(told, _URGENT, time.monotonic() + late.seconds)
    except TimeoutError:
        error = InterruptedRun(first.name)
        with contextlib.suppress(Exception):  # nothing may keep it from leaving
            late.tell(first.name)
        say(last_line(error))
        leave(error.exit_code)
    else:
        if second is not None:  # and no handler was called, which lets it end us
            os._exit(128 + second)


def _next(
    told: socket.socket, wanted: Sequence[signal.Signals], end: float | None = None
) -> signal.Signals | None:
    """Returns the next signal of these, None if no more come.

    Raises:
      TimeoutError: if none has come at `end`, whatever other signals have.
    """
    while True:
        if end is not None:
            told.settimeout(max(end - time.monotonic(), 1e-3))
        number = told.recv(1)
        if not number:
            return None
        if number[0] in wanted:
            return signal.Signals(number[0])
