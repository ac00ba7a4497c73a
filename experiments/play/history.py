"""What was lived in the last minute; any moment of it may be gone back to."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .core import World


class Frame(NamedTuple):
    """A moment, as it is shown.

    Attributes:
      number: of the step that led here, from 0.
      qpos: `[Q]`.
      obs: `[D]`.
      ghosts: `[G, H+1, Q]`, what was imagined in the step before, from where it began.
      members: `[G]`, whose imagination each of them is.
      earned: by the step; NaN where nothing says it.
      promised: the return that was foreseen, per step.
      disagreement: of the members about what was foreseen.
      wanted: in words, as `Command.label`.
      world: to go on from; None of what is only watched.
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
    world: World | None


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
