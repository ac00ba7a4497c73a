"""The controls that every page has, in viser: values are read, never trusted."""

import queue
from collections.abc import Callable, Sequence
from typing import Any

import viser

from . import controls, readout
from .controls import Press
from .session import MEMORY

# `(kind, seconds, client)`: what a visitor wants to keep, "mp4" or "html".
Save = Callable[[str, float, viser.ClientHandle], None]


class Panel:
    """The controls of one page, shared by all who look at it."""

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
            names = (controls.PAUSE, controls.GO_ON, controls.STEP, controls.RESET)
            self.add_buttons("time", "time", names, "For all who look.")
            speeds = tuple(controls.SPEEDS)
            self.add_buttons("speed", "speed", speeds, "Of real time.")
            if self._pushes:
                self.add_buttons("push", "push", self._pushes, "Adds to its speed.")

    def add_memory(self) -> None:
        """Adds what goes back, and what saves."""
        with self.gui.add_folder("The last minute"):
            hint = "Looks at a moment; the world waits."
            args = ("go back", -MEMORY, 0.0, 0.05, 0.0)
            self._back = self.gui.add_slider(*args, hint=hint)
            hint = "What came after it is forgotten."
            self.add_buttons("time", "and", (controls.FROM_HERE,), hint)
            args = ("seconds", 5.0, MEMORY, 5.0, 15.0)
            self._seconds = self.gui.add_slider(*args, hint="Of the end, to be saved.")
            handle = self.gui.add_button_group("save", ("video (mp4)", "3D (html)"))
            handle.on_click(self._saving)

    # For the thread of the world.

    @property
    def back(self) -> float:
        """How many s before now is looked at, which may be anything."""
        value = self._back.value
        return -value if isinstance(value, float | int) else 0.0

    def presses(self) -> list[Press]:
        """Returns what was pressed since the last call."""
        return [self._presses.get_nowait() for _ in range(self._presses.qsize())]

    def show_back(self, back: float) -> None:
        """Has the slider say that nothing but now is looked at."""
        if back == 0 and self._back.value != 0:
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
            self._save(kind, self._seconds.value, event.client)


def write(handle: Any, text: str) -> None:
    """Writes a text of HTML where it has changed."""
    if handle.content != text:
        handle.content = text
