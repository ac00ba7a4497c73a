"""What a person watching sees, and where a loop stops when it is asked to."""

import contextlib
import signal
import sys
import time
from collections.abc import Callable, Iterator

import tqdm

from .errors import StoppedTogether
from .parallel import distributed
from .signals import first_signal

# A log file gets a line per trial, no bar; and one where there was none for so long.
_SILENCE = 60.0  # seconds
_BAR = (
    "{desc} {percentage:3.0f}% |{bar}| {n_fmt}/{total_fmt} steps "
    "[{elapsed} < {remaining}, {rate_fmt}]"
)


class Watch:
    """What else takes notice of how far a command is; here nothing does."""

    has_bar = False
    """Whether it draws a bar, in place of one for each phase."""

    def begin(self, phase: str, done: int = 0) -> None:
        """Takes notice of explore, zero-shot, finetune, videos or a report."""

    def did(self, kind: str, units: int, *, first: bool = False) -> None:
        """Takes notice of steps, of the trials that a fit was to, or of a video."""

    def says(self, what: str) -> None:
        """Takes notice of what is done now."""


class Progress:
    """A bar over environment steps, lines per trial, and the wish to stop."""

    def __init__(
        self, total: int, done: int, what: str, watch: Watch,
        update: Callable[..., None] = lambda **_: None,
    ) -> None:  # fmt: skip
        """Begins to count; `update` is told the pace of every tick, as in `Status`."""
        self._shown = distributed.is_first()
        self._watch, self._compiles = watch, False
        watch.begin(what, done)
        has_bar = self._shown and sys.stderr.isatty() and not watch.has_bar
        self._bar = tqdm.tqdm(
            total=total,
            initial=done,
            desc=what,
            unit=" steps",
            bar_format=_BAR,
            disable=not has_bar,
            dynamic_ncols=True,
            smoothing=0.1,
        )
        self._what = what
        self._start = self._said = time.monotonic()
        self._update = update
        self._first, self._total, self._done = done, total, done
        self._stop = 0

    def tick(self, steps: int) -> None:
        """Counts steps of one environment.

        Raises:
          StoppedTogether: after a signal, on every host if one of them got it.
        """
        self.did(self._what, steps)
        self._done += steps
        self._bar.update(steps)
        rate, left = self.pace()
        self._update(steps_per_second=rate, seconds_left=left)
        if not sys.stderr.isatty() and time.monotonic() - self._said > _SILENCE:
            self.line(f"{self._what} {self._done}/{self._total} steps")
        if number := distributed.agree(self._stop):
            raise StoppedTogether(signal.Signals(number).name)

    def compiling(self, said: str) -> None:
        """Says what is waited for until the next work is done."""
        self._compiles = True
        self._says(f"{self._what}: {said}")

    def did(self, kind: str, units: int) -> None:
        """Tells the watch of work that is done."""
        self._watch.did(kind, units, first=self._compiles)
        if self._compiles:
            self._compiles = False
            self._says(self._what)

    def _says(self, what: str) -> None:
        self._bar.set_description_str(what)
        self._watch.says(what)

    def pace(self) -> tuple[float, float]:
        """Returns steps per second since the start, and the seconds that are left."""
        elapsed = time.monotonic() - self._start
        rate = (self._done - self._first) / max(elapsed, 1e-9)
        return rate, (self._total - self._done) / max(rate, 1e-9)

    def line(self, text: str) -> None:
        """Prints a line above the bar, with the time left where no bar shows it."""
        self._said = time.monotonic()
        if not self._shown:
            return
        if not sys.stderr.isatty():
            rate, left = self.pace()
            text = f"{text}  [{rate:.1f} steps/s, {left / 60:.1f} min left]"
        tqdm.tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[None]:
        """Turns the first signal into a stop at the next tick; see `signals`."""

        def request(number: int) -> None:
            self._stop = number

        try:
            with first_signal(request):
                yield
        finally:
            self._bar.close()
