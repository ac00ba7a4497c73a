"""How long a study will still take: exploring, performing, videos and the report.

What is known beforehand is how much there is of each kind of work, and how the kinds
compare, as measured with preset `laptop` on two CPU cores. What a kind takes here is
what it took lately, as soon as it was seen.
"""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

# Kinds by phase. A `first` is the call that compiles; units of the others are steps of
# exploring and of performing, trials that a fit is to, videos, and the report.
_PHASES = {
    "explore": ("first explore", "explore", "fit"),
    "zero-shot": ("first zero-shot", "zero-shot"),
    "video": ("video",),
    "report": ("report",),
}
_SECONDS = {"video": 25.0, "report": 10.0}  # until one is seen
_KEPT = 0.995  # of what was seen, at each new sight: the last 200 count


class Sizes(NamedTuple):
    """Of a study, in steps and numbers."""

    num_trials: int
    num_random: int  # of these, at first
    trial_length: int
    num_branches: int  # trials that are performed at once
    task_length: int
    num_videos: int


class Forecast:
    """The seconds that are left of a study, by what was seen of it."""

    def __init__(self, sizes: Sizes) -> None:
        self._sizes = sizes
        self._seen: dict[str, tuple[float, float]] = {}  # units, seconds
        # Until one is seen it takes so many times what another does. Trials in a batch
        # share the cores.
        self._like: Mapping[str, tuple[float, str]] = {
            "fit": (11.0, "explore"),
            "first zero-shot": (1.2, "first explore"),
            "zero-shot": (1.1 * sizes.num_branches, "explore"),
        }
        self.begin("explore")

    def begin(self, phase: str, done: int = 0) -> None:
        """Takes notice of a phase that begins, exploring after so many steps."""
        if phase == "explore":
            self._done, self._ahead = done, self._whole(done)
        for earlier in itertools.takewhile(lambda name: name != phase, _PHASES):
            self._ahead |= dict.fromkeys(_PHASES[earlier], 0)

    def did(self, kind: str, units: int, seconds: float, *, first: bool) -> None:
        """Takes notice of work.

        Args:
          kind: explore, fit, zero-shot or video.
          units: of it.
          seconds: that it took.
          first: whether it was compiled, too.
        """
        if kind == "explore":
            self._done += units
            if self._done <= self._sizes.num_random * self._sizes.trial_length:
                return  # random actions cost nothing
        self._ahead[kind] -= units
        if first:
            self._ahead[f"first {kind}"] = 0
            self._seen[f"first {kind}"] = (1.0, seconds)
            return
        before = self._seen.get(kind, (0.0, 0.0))
        self._seen[kind] = (_KEPT * before[0] + units, _KEPT * before[1] + seconds)

    def left(self, waited: float = 0.0) -> float | None:
        """Returns the seconds that are left, None while nothing is known yet.

        Args:
          waited: the seconds since the last work was done or a phase began; no more
            of them count than a unit takes.
        """
        under_way, total = None, 0.0
        for kind, units in self._ahead.items():
            if not units:
                continue
            each = self._each(kind)
            if each is None:
                return None
            under_way = each if under_way is None else under_way
            total += units * each
        return total - min(waited, under_way or 0.0)

    def _whole(self, done: int) -> dict[str, int]:
        """Returns the units of a study that has explored for so many steps."""
        sizes = self._sizes
        trials = range(done // sizes.trial_length + 1, sizes.num_trials + 1)
        planned = sum(trial > sizes.num_random for trial in trials)
        return {
            "first explore": min(planned, 1),
            "explore": planned * sizes.trial_length,
            "fit": sum(trials),
            "first zero-shot": 1,
            "zero-shot": sizes.task_length,
            "video": sizes.num_videos,
            "report": 1,
        }

    def _each(self, kind: str) -> float | None:
        """Returns the seconds that a unit takes."""
        if kind in self._seen:
            units, seconds = self._seen[kind]
            return seconds / units
        if kind in self._like:
            times, other = self._like[kind]
            seconds = self._each(other)
            return None if seconds is None else times * seconds
        return _SECONDS.get(kind)
