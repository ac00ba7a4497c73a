"""The controls of a robot that plans: what is asked of it, and what it imagines."""

import html

import numpy as np
from viser import uplot

from jaxpets import formulas

from . import readout
from .command import PLAN, POLICY, TO_EXPLORE, Commands
from .controls import Panel, Values, write
from .readout import small
from .scene import Look
from .session import MEMORY, Frame, Session

PROMISED, EARNED = "#0072b2", "#d55e00"
_CURVE_SECONDS = 15.0


class PlanPart:
    """Buttons, a line and sliders for what is wanted; curves of what came of it."""

    def __init__(
        self, panel: Panel, commands: Commands, horizon: int, *, has_policy: bool
    ) -> None:
        self._gui, self._commands, self._horizon = panel.gui, commands, horizon
        hint = "The model was never trained for it."
        panel.add_buttons("reward", "task", list(commands.tasks), hint)
        hint = "Seeks what its networks disagree about."
        panel.add_buttons("reward", "or", [TO_EXPLORE], hint)
        hint = "Type what you want more of."
        self._line = self._gui.add_text("reward", "", hint=hint)
        if has_policy:
            hint = "The policy knows the tasks alone; for all else there is a plan."
            panel.add_buttons("acts", "acts by", [PLAN, POLICY], hint)
        self._under_line = self._gui.add_html("")
        with self._gui.add_folder("Words for it", expand_by_default=False):
            self._gui.add_html(_vocabulary(commands))
        with self._gui.add_folder("Or the motion that you want"):
            self._add_motion()
        panel.add_time()
        with self._gui.add_folder("What it imagines"):
            self._add_imagination()

    @property
    def look(self) -> Look:
        """What of the imagination is to be seen."""
        return Look(bool(self._paths.value), bool(self._ghosts.value))

    def read(self, back: float) -> Values:
        """Returns what the controls say, which may be anything."""
        sliders = tuple(slider.value for slider in self._sliders)
        return Values(self._line.value, sliders, self._effort.value, back)

    def show_line(self, line: str, seen: str) -> None:
        """Has the line say what is asked for, unless it has changed since."""
        if self._line.value == seen != line:
            self._line.value = line

    def speak(self, session: Session, frame: Frame) -> None:
        """Says what is asked for, what was promised, and what came."""
        write(self._under_line, readout.under_line(session.command))
        write(self._disagreement, readout.disagreement(frame))
        if session.back > 0:
            return
        step_time = session.stepper.step_time
        # A promise is as old as the horizon; no more frames than are drawn are summed.
        seconds = _CURVE_SECONDS + self._horizon * step_time
        frames = session.history.recent(seconds)
        found = readout.curves(frames, self._horizon, step_time)
        write(self._returns, readout.returns(found))
        minute = [frame.disagreement for frame in session.history.recent(MEMORY)]
        most = max(np.nanmax(minute, initial=0.0), 1e-9)
        share = np.nan_to_num(frame.disagreement) / most
        self._bar.value = float(np.clip(100 * share, 0, 100))
        shown = slice(-round(_CURVE_SECONDS / step_time), None)
        curves = (found.seconds, found.promised, found.earned)
        self._chart.data = tuple(curve[shown] for curve in curves)

    def _add_motion(self) -> None:
        self._sliders = [
            self._gui.add_slider(
                slider.word.replace("_", " "), slider.low, slider.high, slider.step,
                min(max(0.0, slider.low), slider.high), hint=f"In {slider.unit}.",
            )
            for slider in self._commands.sliders
        ]  # fmt: skip
        hint = "What a unit of it costs: the sum of the squares of the action."
        self._effort = self._gui.add_slider(
            "effort costs", 0.0, 1.0, 0.05, 0.1, hint=hint
        )

    def _add_imagination(self) -> None:
        gui = self._gui
        self._paths = gui.add_checkbox("paths", True, hint="A color for each network.")
        hint = "Where it sees itself half way, and at the end."
        self._ghosts = gui.add_checkbox("ghosts", True, hint=hint)
        self._disagreement = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0)
        self._returns = gui.add_html("")
        self._chart = gui.add_uplot(
            (np.zeros(1), np.zeros(1), np.zeros(1)),
            (
                uplot.Series(label="s"),
                uplot.Series(label="promised", stroke=PROMISED, width=2),
                uplot.Series(label="earned", stroke=EARNED, width=2),
            ),
            title="return per step, over the horizon",
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
            height=160,
        )


def _vocabulary(commands: Commands) -> str:
    """Returns what may stand in a reward, as HTML."""
    last = f"action_{commands.action_size - 1}"
    words = [*commands.words, "effort", "action_0", "...", last, "pi"]
    signs = "+ - * / ** < <= > >= == != and or not"
    rows = ("  ".join(words), "  ".join(formulas.FUNCTIONS), signs)
    return small("<br>".join(map(html.escape, rows)))
