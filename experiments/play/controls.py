"""From the controls of a page to orders for the world; it knows no page, only values.

Controls are looked at once a step, however often they change, and what comes over a
socket is taken for what it may be: anything.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from .command import Command, Commands
from .session import MEMORY, Session

SPEEDS: Mapping[str, float] = {"1": 1.0, "1/2": 0.5, "1/4": 0.25, "1/10": 0.1}
PAUSE, GO_ON, STEP, RESET, FROM_HERE = (
    "pause", "go on", "one step", "start again", "go on from here",
)  # fmt: skip

_ORDERS: Mapping[str, Callable[[Session], None]] = {
    PAUSE: lambda session: session.pause(True),
    GO_ON: lambda session: session.pause(False),
    STEP: Session.step_once,
    RESET: Session.restart,
    FROM_HERE: Session.go_on_from_here,
}


class Values(NamedTuple):
    """What the controls say that have a value."""

    line: str
    sliders: tuple[float, ...]  # one for each of `Commands.sliders`
    effort: float  # what a unit of it costs
    back: float  # how many s before now is looked at


class Press(NamedTuple):
    """A button that was pressed: of which group, and which of it."""

    group: str  # "reward", "time", "speed" or "push"
    name: str


class Controls:
    """Gives a session what a page asks for; for the session's thread."""

    def __init__(self, commands: Commands | None, first: Values) -> None:
        """Takes what can be asked for, if anything, and what the controls say first."""
        self._commands, self._last = commands, first

    def apply(
        self, session: Session, values: Values, presses: Sequence[Press]
    ) -> Values:
        """Does what the controls ask for.

        Returns:
          What they should say afterwards: the line follows the buttons and the sliders,
          and the way back ends where the world goes on.
        """
        values = _sane(values, self._last)
        command = self._command(session.command, values)
        if values.back != self._last.back:
            session.look_back(values.back)
        for press in presses:
            command = self._pressed(session, command, press)
        session.command = command
        self._last = values._replace(line=command.line, back=session.back)
        return self._last

    def _command(self, command: Command, values: Values) -> Command:
        last = self._last
        if self._commands is None:
            return command
        if values.line != last.line:
            return self._commands.by_text(command, values.line)
        if (values.sliders, values.effort) != (last.sliders, last.effort):
            return self._commands.by_sliders(command, values.sliders, values.effort)
        return command

    def _pressed(self, session: Session, command: Command, press: Press) -> Command:
        match press:
            case Press("reward", name) if self._commands is not None:
                return self._commands.by_name(command, name)
            case Press("push", name):
                session.push(name)
            case Press("speed", name):
                session.speed = SPEEDS.get(name, session.speed)
            case Press("time", name) if name in _ORDERS:
                _ORDERS[name](session)
            case _:
                pass
        return command


def _sane(values: Values, last: Values) -> Values:
    """Returns values of the types and within the ranges that controls have."""
    pairs = zip(values.sliders, last.sliders, strict=True)
    return Values(
        values.line if isinstance(values.line, str) else last.line,
        tuple(number(value, before) for value, before in pairs),
        max(0.0, number(values.effort, last.effort)),
        min(max(0.0, number(values.back, last.back)), MEMORY),
    )


def number(value: Any, otherwise: float) -> float:
    """Returns what may be a number of a reasonable size, or else another."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return otherwise
    return number if math.isfinite(number) and abs(number) < 1e6 else otherwise
