"""When the next step of the world may begin, and when it is shown. Knows no threads."""

import math
import time
from collections import deque
from collections.abc import Callable

_SLACK = 0.25  # of a period, by which a late step may be made good
_SMOOTHING = 0.2
_FADING = 0.95  # of the longest computation, per step


class Clock:
    """Gives every step a deadline, and never makes good for lost time in a burst.

    A machine that is too slow has a slower clock. What is shown lags behind what is
    computed by a step, so that there is always one to go towards, and steps that are
    computed a little early or late look even.
    """

    def __init__(
        self, step_time: float, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._step_time = step_time
        self._now = now
        self._begins: deque[float] = deque(maxlen=40)
        self.restart()

    def restart(self) -> None:
        """Begins anew, as after a pause: the next step is due at once."""
        self._due = -math.inf
        self._began: float | None = None
        self._interval = self._step_time
        self._computing = 0.0
        self._shown = -math.inf
        self._begins.clear()

    def wait(self) -> float:
        """Returns in how many s the next step is due, 0 if it is late."""
        return max(0.0, self._due - self._now())

    def begin(self, speed: float) -> None:
        """Notes that a step begins, in a world at so many times its real speed."""
        now, period = self._now(), self._step_time / speed
        if self._began is not None:
            took = max(now - self._began, period)
            self._interval += _SMOOTHING * (took - self._interval)
        # As if it had begun on time, unless that was long ago.
        on_time = max(self._due, now - _SLACK * period)
        self._due = on_time + period
        self._began = now
        self._begins.append(now)

    def end(self) -> float:
        """Notes that the step is computed, and returns when it is shown, as `now`."""
        assert self._began is not None
        computing = self._now() - self._began
        self._computing = max(computing, _FADING * self._computing)
        begun = max(self._began, self._due - self._interval)
        self._shown = max(self._shown, begun + self._computing + self._interval)
        return self._shown

    @property
    def rate(self) -> float:
        """Steps a second, of late."""
        if len(self._begins) < 2:
            return 0.0
        return (len(self._begins) - 1) / max(self._begins[-1] - self._begins[0], 1e-9)

    @property
    def pace(self) -> float:
        """Seconds of the world that pass in a second."""
        return self.rate * self._step_time
