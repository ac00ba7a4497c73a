"""The controls of the page, in viser: values are read, never trusted."""

import html
import queue
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser
from viser import uplot

from jaxpets import formulas

from . import pilot, report
from .asking import EXPLORE
from .pilot import Event, Inputs
from .report import Curves
from .scene import Look
from .session import MEMORY
from .wishes import Language

_PROMISED, _EARNED = "#0072b2", "#d55e00"
_CURVE_SECONDS = 15.0
# `(kind, seconds, client)`: what a visitor wants to keep.
Save = Callable[[str, float, viser.ClientHandle], None]


class Panel:
    """The controls of one page, shared by all who look at it."""

    def __init__(
        self,
        server: viser.ViserServer,
        title: str,
        language: Language,
        pushes: Sequence[str],
        save: Save,
    ) -> None:
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._gui: Any = server.gui
        self._language = language
        self._save = save
        gui = self._gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(0, 114, 178))
        gui.set_panel_label(title)
        gui.main_panel.dock_right()
        self._status = gui.add_html(report.status(0, 0, 1, False, 0, "starting"))
        self._readings = gui.add_html("")
        self._wishes()
        self._motion()
        self._imagination()
        self._time(pushes)
        self._memory()

    # For the thread of the world.

    def read(self) -> Inputs:
        """Returns what the controls say, which may be anything."""
        return Inputs(
            self._line.value,
            tuple(slider.value for slider in self._sliders),
            self._effort.value,
            -self._back.value,
        )

    def events(self) -> list[Event]:
        """Returns what was pressed since the last call."""
        return [self._events.get_nowait() for _ in range(self._events.qsize())]

    def follow(self, said: Inputs) -> None:
        """Has the controls say what they led to."""
        if self._line.value != said.line:
            self._line.value = said.line
        if said.back == 0 and self._back.value != 0:
            self._back.value = 0.0

    # For the thread that shows.

    @property
    def look(self) -> Look:
        """What of the imagination is to be seen."""
        return Look(bool(self._paths.value), bool(self._ghosts.value))

    def say(self, status: str, readings: str, under_line: str, doubt: str) -> None:
        """Writes texts, as HTML, where they have changed."""
        for handle, text in (
            (self._status, status), (self._readings, readings),
            (self._under_line, under_line), (self._doubt, doubt),
        ):  # fmt: skip
            if handle.content != text:
                handle.content = text

    def draw(self, curves: Curves) -> None:
        """Draws the curves of the last seconds."""
        most = np.nanmax(curves.disagreement, initial=1e-9)
        last = curves.disagreement[-1] if len(curves.disagreement) else 0.0
        self._bar.value = float(np.clip(100 * np.nan_to_num(last) / most, 0, 100))
        shown = slice(-round(_CURVE_SECONDS / max(_step(curves.seconds), 1e-3)), None)
        self._chart.data = (
            curves.seconds[shown], curves.promised[shown], curves.earned[shown],
        )  # fmt: skip

    # Its parts.

    def _group(self, group: str, label: str, options: Sequence[str], hint: str) -> None:
        handle = self._gui.add_button_group(label, tuple(options), hint=hint)

        async def pressed(event: Any) -> None:
            self._events.put(Event(group, str(event.target.value)))

        handle.on_click(pressed)

    def _wishes(self) -> None:
        gui = self._gui
        tasks = list(self._language.tasks)
        self._group("wish", "task", tasks, "What it was never trained for.")
        self._group("wish", "or", [EXPLORE], "Seeks what its networks disagree about.")
        self._line = gui.add_text("reward", "", hint="Type what you want more of.")
        self._under_line = gui.add_html("")
        with gui.add_folder("Words", expand_by_default=False):
            gui.add_html(_vocabulary(self._language))

    def _motion(self) -> None:
        gui = self._gui
        with gui.add_folder("Or the motion that you want", expand_by_default=True):
            self._sliders = [
                gui.add_slider(
                    slider.word.replace("_", " "), slider.low, slider.high, slider.step,
                    min(max(0.0, slider.low), slider.high), hint=f"In {slider.unit}.",
                )
                for slider in self._language.sliders
            ]  # fmt: skip
            hint = "What a unit of it costs: the sum of the squares of the action."
            self._effort = gui.add_slider("effort costs", 0.0, 1.0, 0.05, 0.1, hint=hint)

    def _imagination(self) -> None:
        gui = self._gui
        with gui.add_folder("What it imagines"):
            self._paths = gui.add_checkbox("paths", True, hint="One color per network.")
            self._ghosts = gui.add_checkbox("ghosts", True, hint="Half way, and at the end.")
            self._doubt = gui.add_html("")
            self._bar = gui.add_progress_bar(0.0)
            self._chart = gui.add_uplot(
                (np.zeros(1), np.zeros(1), np.zeros(1)),
                (
                    uplot.Series(label="s"),
                    uplot.Series(label="promised", stroke=_PROMISED, width=2),
                    uplot.Series(label="earned", stroke=_EARNED, width=2),
                ),
                title="return per step, as promised and as it came",
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
                height=150,
            )

    def _time(self, pushes: Sequence[str]) -> None:
        with self._gui.add_folder("Time"):
            options = (pilot.PAUSE, pilot.GO_ON, pilot.STEP, pilot.RESET)
            self._group("time", "time", options, "For all who look.")
            self._group("speed", "speed", tuple(pilot.SPEEDS), "Of real time.")
            if pushes:
                self._group("push", "push", tuple(pushes), "Adds to its speed.")

    def _memory(self) -> None:
        gui = self._gui
        with gui.add_folder("The last minute"):
            hint = "Looks at a moment; the world waits."
            self._back = gui.add_slider("go back", -MEMORY, 0.0, 0.05, 0.0, hint=hint)
            hint = "What came after it is forgotten."
            self._group("time", "", (pilot.FROM_HERE,), hint)
            self._seconds = gui.add_slider("save last", 5.0, MEMORY, 5.0, 15.0, hint="In s.")
            handle = gui.add_button_group("save", ("video (mp4)", "3D (html)"))
            handle.on_click(self._saving)

    def _saving(self, event: Any) -> None:
        """Runs in a thread of viser's, as it takes a while."""
        if event.client is not None:
            kind = "mp4" if "mp4" in str(event.target.value) else "html"
            self._save(kind, float(self._seconds.value), event.client)


def _vocabulary(language: Language) -> str:
    actions = [f"action_0 … action_{language.action_size - 1}"]
    rows = (
        ("", [*language.words, "effort", *actions, "pi"]),
        ("functions: ", [*formulas.FUNCTIONS]),
        ("signs: ", "+ - * / ** < <= > >= == != and or not".split()),
    )
    lines = [name + html.escape("  ".join(words)) for name, words in rows]
    return report.small("<br>".join(lines))


def _step(seconds: np.ndarray) -> float:
    return float(seconds[1] - seconds[0]) if len(seconds) > 1 else 1.0
