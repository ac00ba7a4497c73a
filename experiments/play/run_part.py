"""What the page of a run says: its last trial, and its curves as they grow."""

import html
import time
from typing import Any

import numpy as np
from viser import uplot

from ..errors import RunError
from ..storage import status
from ..storage.metrics import number
from .controls import Values
from .history import Frame
from .panel import Panel, write
from .readout import small
from .scene import Look
from .session import Session
from .watch import Replay, Watched

_SECONDS = 2.0  # between looks at the folder
_INKS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


class RunPart:
    """Curves of a log; nothing may be asked for."""

    look = Look(paths=False, ghosts=False)

    def __init__(self, panel: Panel, run: Watched, replay: Replay) -> None:
        self._run, self._replay, self._next = run, replay, 0.0
        gui, tasks = panel.gui, run.robot.tasks.names
        self._text = gui.add_html(small("It looks for a trial."))
        panel.add_time()
        with gui.add_folder("How it explores"):
            self._value = _chart(gui, "disagreement that it sought", ["per step"])
            self._error = _chart(gui, "error of the model", ["squared"])
            self._returns = _chart(gui, "what the tasks would have earned", tasks)

    def read(self, back: float) -> Values:
        """Returns how far back is looked."""
        return Values("", (), 0.0, back)

    def show_line(self, line: str) -> None:
        """Has no line."""

    def speak(self, session: Session, frame: Frame) -> None:
        """Says how far the run is; looks at its folder now and then."""
        del session, frame
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _SECONDS
        write(self._text, small(html.escape(self._line())))
        rows = self._run.rows()
        if not rows:
            return
        trials = np.array([row["trial"] for row in rows], float)
        tasks = self._run.robot.tasks.names
        self._value.data = trials, _column(rows, "value")
        self._error.data = trials, _column(rows, "fit", "mse")
        self._returns.data = (trials, *(_column(rows, "returns", x) for x in tasks))

    def _line(self) -> str:
        shown = f"Trial {self._replay.trial} is shown. " if self._replay.trial else ""
        try:
            found = status.read(self._run.folder.path)
        except RunError:
            return shown
        said = found.reason or found.line or ""
        return f"{shown}The run is {found.state}. {said}"


def _column(rows: Any, *keys: str) -> np.ndarray:
    """Returns a number of every row, NaN where it has none."""
    found = []
    for row in rows:
        value = row
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        found.append(number(value))
    return np.array(found, float)


def _chart(gui: Any, title: str, names: Any) -> Any:
    lines = [
        uplot.Series(label=name, stroke=_INKS[i % len(_INKS)], width=2)
        for i, name in enumerate(names)
    ]
    return gui.add_uplot(
        tuple(np.zeros(1) for _ in range(1 + len(lines))),
        (uplot.Series(label="trial"), *lines),
        title=title,
        scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
        height=150,
    )
