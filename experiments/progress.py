"""What a person watching sees, and how they stop a run."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType

import tqdm

from experiments.errors import InterruptedRun
from experiments.parallel import distributed

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A log file gets a line per trial, no bar.
_BAR = (
    "{desc} {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} steps "
    "[{elapsed} < {remaining}, {rate_fmt}]"
)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Turns the first SIGINT or SIGTERM into InterruptedRun, wherever the program is.

    `Progress.interruptible`, inside, waits for the next tick instead.
    """

    def stop(number: int) -> None:
        raise InterruptedRun(signal.Signals(number).name)

    with _first_signal(stop):
        yield


@contextlib.contextmanager
def _first_signal(act: Callable[[int], None]) -> Iterator[None]:
    """Calls `act` with the first SIGINT or SIGTERM; a second ends the process."""

    def handler(number: int, frame: FrameType | None) -> None:
        del frame
        for name in _SIGNALS:
            signal.signal(name, signal.SIG_DFL)
        act(number)

    before = [signal.signal(name, handler) for name in _SIGNALS]
    try:
        yield
    finally:
        for name, old in zip(_SIGNALS, before, strict=True):
            signal.signal(name, old)


class Progress:
    """A bar over environment steps, lines per trial, and the wish to stop."""

    def __init__(self, total: int, done: int, what: str) -> None:
        self._shown = distributed.is_first()
        self._bar = tqdm.tqdm(
            total=total,
            initial=done,
            desc=what,
            unit=" steps",
            bar_format=_BAR,
            disable=not (self._shown and sys.stderr.isatty()),
            dynamic_ncols=True,
            smoothing=0.1,
        )
        self._what = what
        self._start = time.monotonic()
        self._first, self._total, self._done = done, total, done
        self._stop = 0

    def tick(self, steps: int) -> None:
        """Counts steps of one environment.

        Raises:
          InterruptedRun: after a signal, on every host if one of them got it.
        """
        self._done += steps
        self._bar.update(steps)
        if number := distributed.agree(self._stop):
            raise InterruptedRun(signal.Signals(number).name)

    def line(self, text: str) -> None:
        """Prints a line above the bar, with the time left where no bar shows it."""
        if not self._shown:
            return
        if not sys.stderr.isatty():
            elapsed = time.monotonic() - self._start
            rate = (self._done - self._first) / max(elapsed, 1e-9)
            left = (self._total - self._done) / max(rate, 1e-9)
            text = f"{text}  [{rate:.1f} steps/s, {left / 60:.1f} min left]"
        tqdm.tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Turns the first SIGINT or SIGTERM into a stop at the next tick.

        A second signal ends the process at once, as if nothing were caught.
        """

        def request(number: int) -> None:
            self._stop = number

        try:
            with _first_signal(request):
                yield
        finally:
            self._bar.close()
