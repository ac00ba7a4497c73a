"""The controls that every page has, in viser: values are read, never trusted."""

import queue
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import viser

from . import pilot, report
from .history import Frame
from .pilot import Event, Inputs
from .scene import Look
from .session import MEMORY, Session

# `(group, label, options, hint)`: buttons in a row.
AddButtons = Callable[[str, str, Sequence[str], str], None]
# `(kind, seconds, client)`: what a visitor wants to keep, "mp4" or "html".
Save = Callable[[str, float, viser.ClientHandle], None]


class Part(Protocol):
    """What is on the panel beside the clock: that of a kind of page."""

    @property
    def look(self) -> Look:
        """What of the imagination is to be seen."""
        ...

    def add_below(self) -> None:
        """Adds what stands below the clock; the rest is there before."""
        ...

    def read(self, back: float) -> Inputs:
        """Returns what its controls say, beside how far back is looked."""
        ...

    def follow(self, said: Inputs) -> None:
        """Has its controls say what they led to."""
        ...

    def speak(self, session: Session, frame: Frame) -> None:
        """Says what goes on; called a few times a second."""
        ...


class Panel:
    """The controls of one page, shared by all who look at it."""

    def __init__(
        self,
        server: viser.ViserServer,
        title: str,
        make_part: Callable[[Any, AddButtons], Part],
        *,
        pushes: Sequence[str],
        save: Save,
    ) -> None:
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._save = save
        self._gui: Any = server.gui
        gui = self._gui
        gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(0, 114, 178)
        )
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(360)
        self._status = gui.add_html(report.small("It is about to begin."))
        self._readings = gui.add_html("")
        self.part = make_part(gui, self._add_buttons)
        self._add_time(pushes)
        self.part.add_below()
        self._add_memory()

    # For the thread of the world.

    def read(self) -> Inputs:
        """Returns what the controls say, which may be anything."""
        value = self._back.value
        return self.part.read(-value if isinstance(value, float | int) else 0.0)

    def events(self) -> list[Event]:
        """Returns what was pressed since the last call."""
        return [self._events.get_nowait() for _ in range(self._events.qsize())]

    def follow(self, said: Inputs) -> None:
        """Has the controls say what they led to."""
        self.part.follow(said)
        if said.back == 0 and self._back.value != 0:
            self._back.value = 0.0

    # For the thread that shows.

    def say(self, status: str, readings: str) -> None:
        """Writes the head of the panel, as HTML."""
        write(self._status, status)
        write(self._readings, readings)

    # Its parts.

    def _add_buttons(
        self, group: str, label: str, options: Sequence[str], hint: str
    ) -> None:
        handle = self._gui.add_button_group(label, tuple(options), hint=hint)

        async def pressed(event: Any) -> None:
            self._events.put(Event(group, str(event.target.value)))

        handle.on_click(pressed)

    def _add_time(self, pushes: Sequence[str]) -> None:
        with self._gui.add_folder("Time"):
            options = (pilot.PAUSE, pilot.GO_ON, pilot.STEP, pilot.RESET)
            self._add_buttons("time", "time", options, "For all who look.")
            self._add_buttons("speed", "speed", tuple(pilot.SPEEDS), "Of real time.")
            if pushes:
                self._add_buttons("push", "push", tuple(pushes), "Adds to its speed.")

    def _add_memory(self) -> None:
        gui = self._gui
        with gui.add_folder("The last minute"):
            hint = "Looks at a moment; the world waits."
            self._back = gui.add_slider("go back", -MEMORY, 0.0, 0.05, 0.0, hint=hint)
            hint = "What came after it is forgotten."
            self._add_buttons("time", "and", (pilot.FROM_HERE,), hint)
            self._seconds = gui.add_slider(
                "seconds", 5.0, MEMORY, 5.0, 15.0, hint="Of the end, to be saved."
            )
            handle = gui.add_button_group("save", ("video (mp4)", "3D (html)"))
            handle.on_click(self._saving)

    def _saving(self, event: Any) -> None:
        """Runs in a thread of viser's, as it takes a while."""
        if event.client is not None:
            kind = "mp4" if "mp4" in str(event.target.value) else "html"
            self._save(kind, self._seconds.value, event.client)


def write(handle: Any, text: str) -> None:
    """Writes a text of HTML where it has changed."""
    if handle.content != text:
        handle.content = text
