"""What visitors press and move, and the orders for the world that it makes.

Controls are looked at once a step, however often they change, and what comes over a
socket is taken for what it may be: anything.
"""

import math
import queue
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import viser

from . import readout
from .command import PLAN, POLICY, Command, Commands
from .session import MEMORY, Session

_SPEEDS: Mapping[str, float] = {"1": 1.0, "1/2": 0.5, "1/4": 0.25, "1/10": 0.1}
_FROM_HERE = "go on from here"
_TIMES: Mapping[str, Callable[[Session], None]] = {
    "pause": lambda session: session.pause(True),
    "go on": lambda session: session.pause(False),
    "one step": Session.step_once,
    "start again": Session.restart,
}
_ORDERS = {**_TIMES, _FROM_HERE: Session.go_on_from_here}

# `(kind, seconds, client)`: what a visitor wants to keep, "mp4" or "html".
Save = Callable[[str, float, viser.ClientHandle], None]


class Values(NamedTuple):
    """What the controls say that have a value."""

    line: str
    sliders: tuple[float, ...]  # one for each of `Commands.sliders`
    effort: float  # what a unit of it costs
    back: float  # how many s before now is looked at


class Press(NamedTuple):
    """A button that was pressed: of which group, and which of it."""

    group: str  # "reward", "acts", "time", "speed" or "push"
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
            case Press("acts", name) if name in (PLAN, POLICY):
                return command._replace(acts=name)
            case Press("push", name):
                session.push(name)
            case Press("speed", name):
                session.speed = _SPEEDS.get(name, session.speed)
            case Press("time", name) if name in _ORDERS:
                _ORDERS[name](session)
            case _:
                pass
        return command


class Panel:
    """The controls that every page has, in viser, shared by all who look at it."""

    def __init__(
        self,
        server: viser.ViserServer,
        title: str,
        *,
        pushes: Sequence[str],
        save: Save,
    ) -> None:
        self._presses: queue.SimpleQueue[Press] = queue.SimpleQueue()
        self._pushes, self._save = tuple(pushes), save
        self.gui: Any = server.gui
        self.gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(0, 114, 178)
        )
        self.gui.set_panel_label(title)
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(360)
        self._status = self.gui.add_html(readout.small("It is about to begin."))
        self._readings = self.gui.add_html("")

    # For who puts it together.

    def add_buttons(
        self, group: str, label: str, options: Sequence[str], hint: str
    ) -> None:
        """Adds buttons in a row."""
        handle = self.gui.add_button_group(label, tuple(options), hint=hint)

        async def pressed(event: Any) -> None:
            self._presses.put(Press(group, str(event.target.value)))

        handle.on_click(pressed)

    def add_time(self) -> None:
        """Adds the clock, where a part wants it."""
        with self.gui.add_folder("Time"):
            self.add_buttons("time", "time", [*_TIMES], "For all who look.")
            self.add_buttons("speed", "speed", [*_SPEEDS], "Of real time.")
            if self._pushes:
                self.add_buttons("push", "push", self._pushes, "Adds to its speed.")

    def add_memory(self) -> None:
        """Adds what goes back, and what saves."""
        with self.gui.add_folder("The last minute"):
            hint = "Looks at a moment; the world waits."
            args = ("go back", -MEMORY, 0.0, 0.05, 0.0)
            self._back = self.gui.add_slider(*args, hint=hint)
            hint = "What came after it is forgotten."
            self.add_buttons("time", "and", [_FROM_HERE], hint)
            args = ("seconds", 5.0, MEMORY, 5.0, 15.0)
            self._seconds = self.gui.add_slider(*args, hint="Of the end, to be saved.")
            handle = self.gui.add_button_group("save", ("video (mp4)", "3D (html)"))
            handle.on_click(self._saving)

    # For the thread of the world.

    @property
    def back(self) -> float:
        """How many seconds before now is looked at."""
        return -number(self._back.value, 0.0)

    def presses(self) -> list[Press]:
        """Returns what was pressed since the last call, each thing once."""
        count = self._presses.qsize()
        return list(dict.fromkeys(self._presses.get_nowait() for _ in range(count)))

    def show_back(self, back: float, seen: float) -> None:
        """Has the slider say that only now is looked at, unless it has moved since."""
        if back == 0 and self.back == seen and self._back.value != 0:
            self._back.value = 0.0

    # For the thread that shows.

    def say(self, status: str, readings: str) -> None:
        """Writes the head of the panel, as HTML."""
        write(self._status, status)
        write(self._readings, readings)

    def _saving(self, event: Any) -> None:
        """Runs in a thread of viser's, as it takes a while."""
        if event.client is not None:
            kind = "mp4" if "mp4" in str(event.target.value) else "html"
            seconds = min(max(number(self._seconds.value, 15.0), 1.0), MEMORY)
            self._save(kind, seconds, event.client)


def write(handle: Any, text: str) -> None:
    """Writes a text of HTML where it has changed."""
    if handle.content != text:
        handle.content = text


def number(value: Any, otherwise: float) -> float:
    """Returns what may be a number of a reasonable size, or else another."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return otherwise
    return number if math.isfinite(number) and abs(number) < 1e6 else otherwise


def _sane(values: Values, last: Values) -> Values:
    """Returns values of the types and within the ranges that controls have."""
    pairs = zip(values.sliders, last.sliders, strict=True)
    return Values(
        values.line if isinstance(values.line, str) else last.line,
        tuple(number(value, before) for value, before in pairs),
        max(0.0, number(values.effort, last.effort)),
        min(max(0.0, number(values.back, last.back)), MEMORY),
    )
