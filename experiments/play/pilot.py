"""From the controls of a page to orders for the world; it knows no page, only values.

Controls are looked at once a step, however often they change, and what comes over a
socket is taken for what it may be: anything.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxpets.envs import Robot

from . import asking
from .asking import Asked
from .session import MEMORY, Session
from .wishes import Language

SPEEDS: Mapping[str, float] = {"1": 1.0, "1/2": 0.5, "1/4": 0.25, "1/10": 0.1}
PAUSE, GO_ON, STEP, RESET, FROM_HERE = (
    "pause", "go on", "one step", "start again", "go on from here",
)  # fmt: skip


class Inputs(NamedTuple):
    """What the controls say that have a value.

    Attributes:
      line: of text.
      sliders: values, one for each of the language.
      effort: weight of the effort.
      back: how many s before now is looked at.
    """

    line: str
    sliders: tuple[float, ...]
    effort: float
    back: float


class Event(NamedTuple):
    """A button that was pressed: of which group, and which of it."""

    group: str  # "wish", "time", "speed" or "push"
    name: str


class Pilot:
    """Gives a session what a page asks for; for the session's thread."""

    def __init__(self, robot: Robot | None, language: Language, first: Inputs) -> None:
        """Prepares.

        Args:
          robot: whose tasks there are; None where nothing may be asked for.
          language: to speak with it.
          first: what the controls say before anybody has touched them.
        """
        self._robot, self._language, self._last = robot, language, first

    def steer(
        self, session: Session, inputs: Inputs, events: Sequence[Event]
    ) -> Inputs:
        """Does what the controls ask for.

        Returns:
          What they should say afterwards: the line follows the buttons and the sliders,
          and the way back ends where the world goes on.
        """
        inputs = _sane(inputs, self._last)
        asked = self._asked(session.asked, inputs)
        if inputs.back != self._last.back:
            session.look_back(inputs.back)
        for event in events:
            asked = self._pressed(session, asked, event)
        session.asked = asked
        self._last = inputs._replace(line=asked.line, back=session.back)
        return self._last

    def _asked(self, asked: Asked, inputs: Inputs) -> Asked:
        last = self._last
        if self._robot is None:
            return asked
        if inputs.line != last.line:
            return asking.by_text(asked, self._language, inputs.line)
        if (inputs.sliders, inputs.effort) != (last.sliders, last.effort):
            return asking.by_sliders(
                asked, self._language, inputs.sliders, inputs.effort
            )
        return asked

    def _pressed(self, session: Session, asked: Asked, event: Event) -> Asked:
        match event:
            case Event("wish", name) if self._robot is not None:
                return asking.by_name(asked, self._robot, self._language, name)
            case Event("push", name):
                session.push(name)
            case Event("speed", name):
                session.speed = SPEEDS.get(name, session.speed)
            case Event("time", name):
                _change_time(session, name)
            case _:
                pass
        return asked


def _change_time(session: Session, name: str) -> None:
    if name == PAUSE:
        session.pause(True)
    elif name == GO_ON:
        session.pause(False)
    elif name == STEP:
        session.step_once()
    elif name == RESET:
        session.restart()
    elif name == FROM_HERE:
        session.go_on_from_here()


def _sane(inputs: Inputs, last: Inputs) -> Inputs:
    """Returns inputs of the types and within the ranges that controls have."""
    sliders = tuple(
        _number(value, before)
        for value, before in zip(inputs.sliders, last.sliders, strict=True)
    )
    return Inputs(
        inputs.line if isinstance(inputs.line, str) else last.line,
        sliders,
        max(0.0, _number(inputs.effort, last.effort)),
        min(max(0.0, _number(inputs.back, last.back)), MEMORY),
    )


def _number(value: Any, otherwise: float) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return otherwise
    return number if math.isfinite(number) and abs(number) < 1e6 else otherwise
