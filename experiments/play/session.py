"""The one owner of the world: a thread that steps it, remembers, and takes orders.

Others look at what it publishes, which never changes. Nothing that a page does can stop
it: it looks at the controls once a step.
"""

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from .clock import Clock
from .command import Command

MEMORY = 60.0  # s
_NEWS = 3.0  # s of a trial
_IDLE = 1 / 30  # s between looks at the controls while the world stands still


class Frame(NamedTuple):
    """A moment, as it is shown.

    Attributes:
      number: of the step that led here, from 0.
      qpos: `[Q]`.
      obs: `[D]`.
      ghosts: `[G, H+1, Q]`, what was imagined in the step before, from where it began.
      members: `[G]`, whose imagination each of them is.
      earned: by the step; NaN where nothing says it.
      promised: the return that was foreseen, per step; NaN where nothing was planned.
      disagreement: of the members about what was foreseen, likewise.
      wanted: in words, as `Command.label`.
      world: what its Stepper goes on from; None of what is only watched.
    """

    number: int
    qpos: np.ndarray
    obs: np.ndarray
    ghosts: np.ndarray
    members: np.ndarray
    earned: float
    promised: float
    disagreement: float
    wanted: str
    world: Any


class Stepper(Protocol):
    """What a session shows: it gives a frame for a frame.

    Attributes:
      step_time: of a step, in s.
    """

    step_time: float

    @property
    def pushes(self) -> Mapping[str, np.ndarray]:
        """Names of the pushes that there are, and the velocities `[V]` each adds."""
        ...

    def start(self, command: Command) -> Frame:
        """Returns the first frame of a new trial."""
        ...

    def step(
        self, frame: Frame, command: Command, push: str | None
    ) -> tuple[Frame, str]:
        """Returns the frame after a frame, and why there is none after it, if so."""
        ...


class History:
    """The last frames; one thread writes, and any may read."""

    def __init__(self, seconds: float, step_time: float) -> None:
        self._step_time = step_time
        self._frames: deque[Frame] = deque(maxlen=max(2, round(seconds / step_time)))

    def append(self, frame: Frame) -> None:
        """Adds the newest frame; the oldest goes if there are too many."""
        self._frames.append(frame)

    def at(self, seconds_ago: float) -> Frame:
        """Returns the frame of so long ago, as far as is remembered.

        Raises:
          IndexError: before there is any.
        """
        steps = min(
            round(max(seconds_ago, 0.0) / self._step_time), len(self._frames) - 1
        )
        return self._frames[-1 - max(steps, 0)]

    def drop_after(self, frame: Frame) -> None:
        """Forgets what came after a frame that is remembered."""
        while len(self._frames) > 1 and self._frames[-1] is not frame:
            self._frames.pop()

    def recent(self, seconds: float) -> Sequence[Frame]:
        """Returns the frames of the last seconds, oldest first."""
        frames = list(self._frames)
        return frames[-max(1, round(seconds / self._step_time)) :]

    @property
    def seconds(self) -> float:
        """How far back it goes."""
        return max(0, len(self._frames) - 1) * self._step_time


class Shown(NamedTuple):
    """What is to be shown: frames, and when each of them is reached.

    Attributes:
      times: in s, as `time.monotonic` has them, increasing.
      frames: as many.
    """

    times: tuple[float, ...]
    frames: tuple[Frame, ...]

    def at(self, now: float) -> tuple[Frame, Frame, float]:
        """Returns two frames, and how much of the way is done from one to the other."""
        for i in range(len(self.times) - 1, 0, -1):
            start, end = self.times[i - 1], self.times[i]
            if now >= start:
                share = (now - start) / max(end - start, 1e-6)
                return self.frames[i - 1], self.frames[i], min(share, 1.0)
        return self.frames[0], self.frames[0], 1.0


class Session:
    """Owns the world. Methods are for its own thread, but where they say otherwise."""

    def __init__(self, stepper: Stepper, command: Command) -> None:
        self.stepper = stepper
        self.command = command
        self.speed = 1.0
        self.is_paused = False
        self.history = History(MEMORY, stepper.step_time)
        self.clock = Clock(stepper.step_time)
        self.notice = ""
        self.shown: Shown | None = None  # any thread may read it
        self._stopped = threading.Event()
        self._push: str | None = None
        self._steps = 0  # to do while paused
        self.back = 0.0

    # For any thread.

    def stop(self) -> None:
        """Ends `run` after the step under way."""
        self._stopped.set()

    def run(self, steer: Callable[["Session"], None]) -> None:
        """Steps the world until it is stopped; a failure is said, and the world waits.

        Args:
          steer: called before every step; reads controls and gives orders.
        """
        while not self._stopped.is_set():
            try:
                self.tick(steer)
            except Exception as error:  # of whatever a visitor or a file has brought
                traceback.print_exc()
                self.notice = f"stopped by an error: {error}"
                self.is_paused = True
                self._stopped.wait(_IDLE)

    # Orders.

    def restart(self) -> None:
        """Begins a new trial."""
        self.back = 0.0
        frame = self.stepper.start(self.command)
        self.history.append(frame)
        self._show_only(frame)

    def pause(self, is_paused: bool) -> None:
        """Stops the world, or lets it go on from where it is."""
        self.is_paused = is_paused
        self.look_back(0.0)

    def step_once(self) -> None:
        """Does one step, and stands still."""
        if not self.is_paused:
            self.pause(True)
        self.look_back(0.0)
        self._steps += 1

    def push(self, name: str) -> None:
        """Pushes the robot at the next step."""
        if name in self.stepper.pushes:
            self._push = name

    def look_back(self, seconds: float) -> None:
        """Shows a moment of the last minute; other than the last, the world waits."""
        seconds = min(max(seconds, 0.0), self.history.seconds)
        if seconds == self.back:
            return
        self.back = seconds
        self.is_paused = self.is_paused or seconds > 0
        self._show_only(self.history.at(seconds))

    def go_on_from_here(self) -> None:
        """Goes on from what is shown; what came after it is forgotten."""
        self.history.drop_after(self.history.at(self.back))
        self.back = 0.0
        self.is_paused = False

    # Its loop.

    def tick(self, steer: Callable[["Session"], None]) -> None:
        """Waits until a step is due, obeys, and steps."""
        if self.is_paused:
            self._stopped.wait(_IDLE)
            self.clock.restart()
        elif delay := self.clock.wait():
            self._stopped.wait(delay)
        steer(self)
        if self._stopped.is_set() or (self.is_paused and not self._steps):
            return
        self._steps = max(0, self._steps - 1)
        self._step()

    def _step(self) -> None:
        if self.shown is None:
            self.restart()
            self.notice = ""
            return
        last, push, self._push = self.history.at(0.0), self._push, None
        self.clock.begin(self.speed)
        frame, over = self.stepper.step(last, self.command, push)
        if over:
            self.notice = over
            self.restart()
            return
        self.history.append(frame)
        if frame.number * self.stepper.step_time > _NEWS:
            self.notice = ""
        if self.is_paused:
            self._show_only(frame)
            return
        self._show_next(frame, self.clock.end())

    def _show_only(self, frame: Frame) -> None:
        self.shown = Shown((time.monotonic(),), (frame,))
        self.clock.restart()

    def _show_next(self, frame: Frame, at: float) -> None:
        before = self.shown
        assert before is not None
        self.shown = Shown((*before.times[-3:], at), (*before.frames[-3:], frame))
