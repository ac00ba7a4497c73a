"""A run that explores, as it is seen from outside: its last trial, and its curves."""

import html
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from viser import uplot

from jaxpets.envs import Robot

from .. import exploration
from ..errors import CheckpointError, RunError
from ..storage import metrics, rundir, status
from ..storage.folder import RunFolder
from .command import Command
from .controls import Panel, Values, write
from .readout import small
from .scene import Look
from .session import Frame, Session
from .source import robot_named

_SECONDS = 2.0  # between looks at the log
_INKS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


class Watched:
    """A run's folder, which is only read, and while another process writes there."""

    def __init__(self, run: Path, *, env: str | None, seed: int | None) -> None:
        """Opens it.

        Raises:
          RunError: if it is no run, or its robot is of a file that nobody named.
        """
        self.folder = RunFolder(run)
        config = exploration.config_of(self.folder)
        self.env = exploration.without_files(config, env, run).env
        self.seed = config.seeds[0] if seed is None else seed
        if self.seed not in config.seeds:
            raise CheckpointError(f"{run} has no seed {self.seed}.")
        self.robot: Robot = robot_named(self.env)
        self._place = config.seeds.index(self.seed)
        self._length = config.trial_length

    def last_obs(self, after: int) -> tuple[int, np.ndarray] | None:
        """Returns the last trial and its observations `[T, D]`, if it is a later one.

        Steps from where physics diverged on are left out.
        """
        if max(self.folder.steps(), default=0) <= after:
            return None
        found = self.folder.restore(exploration.data_template, part=True)
        if found is None:
            return None
        trial, state = found
        data = state.dataset
        end = int(np.ravel(data.size)[0])
        rows = slice(max(0, end - self._length), end)
        obs = np.asarray(data.data.next_obs[self._place, rows])
        lost = self.folder.lost_steps(trial)
        count = lost[self._place] if self._place < len(lost) else 0
        return trial, obs[: max(1, len(obs) - count)]

    def rows(self) -> list[Mapping[str, Any]]:
        """Returns what the log says of every trial of this seed, oldest first."""
        log = self.folder.path / rundir.METRICS
        if not log.is_file():
            return []
        found = metrics.read(log, self.folder.config())
        rows = [row for row in found if row.phase == "explore"]
        return [row.data for row in rows if row.seed == self.seed]

    def line(self) -> str:
        """Returns what the run does now, "" where that is not said."""
        try:
            found = status.read(self.folder.path)
        except RunError:
            return ""
        return f"The run is {found.state}. {found.reason or found.line or ''}"


class Replay:
    """Shows the last trial of a run over and over, and a newer one when there is."""

    pushes: Mapping[str, np.ndarray] = {}

    def __init__(self, run: Watched) -> None:
        self.step_time = run.robot.step_time
        self.trial = 0
        self._run = run
        assert run.robot.qpos_fn is not None
        self._track = jax.jit(run.robot.qpos_fn)
        self._rest = np.asarray(run.robot.model.qpos0, np.float32)
        seen = jax.eval_shape(run.robot.env.reset, jax.random.key(0)).obs
        self._frames = [_frame(0, self._rest, np.zeros(seen.shape, np.float32))]

    def start(self, command: Command) -> Frame:
        """Returns the first frame of the last trial, or the robot at rest."""
        del command
        try:
            if found := self._run.last_obs(self.trial):
                self.trial, obs = found
                self._frames = self._of(obs)
        except RunError:  # it is being written; the next time there will be one
            pass
        return self._frames[0]

    def step(
        self, frame: Frame, command: Command, push: str | None
    ) -> tuple[Frame, str]:
        """Returns the frame after a frame, and why there is none after it, if so."""
        del command, push
        if frame.number + 1 < len(self._frames):
            return self._frames[frame.number + 1], ""
        return frame, "It is shown again." if self.trial else "No trial is over yet."

    def _of(self, obs: np.ndarray) -> list[Frame]:
        positions = np.asarray(self._track(obs))
        positions = np.where(np.isfinite(positions), positions, self._rest)
        rows = enumerate(zip(positions, obs, strict=True))
        return [_frame(i, *row) for i, row in rows]


class RunPart:
    """The curves of a run on the page, where nothing may be asked for."""

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

    def show_line(self, line: str, seen: str) -> None:
        """Has no line."""

    def speak(self, session: Session, frame: Frame) -> None:
        """Says how far the run is; looks at its folder now and then."""
        del session, frame
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _SECONDS
        trial = self._replay.trial
        shown = f"Trial {trial} is shown. " if trial else ""
        write(self._text, small(html.escape(shown + self._run.line())))
        rows = self._run.rows()
        if not rows:
            return
        trials = np.array([row["trial"] for row in rows], float)
        tasks = self._run.robot.tasks.names
        self._value.data = trials, _column(rows, "value")
        self._error.data = trials, _column(rows, "fit", "mse")
        self._returns.data = (trials, *(_column(rows, "returns", x) for x in tasks))


def _frame(number: int, qpos: np.ndarray, obs: np.ndarray) -> Frame:
    ghosts, members = np.zeros((0, 1, len(qpos)), np.float32), np.zeros(0, int)
    none = float("nan")
    return Frame(number, qpos, obs, ghosts, members, none, none, none, "", None)


def _column(rows: Sequence[Mapping[str, Any]], *keys: str) -> np.ndarray:
    """Returns a number of every row, NaN where it has none."""
    found: list[float] = []
    for row in rows:
        value: Any = row
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        found.append(metrics.number(value))
    return np.array(found, float)


def _chart(gui: Any, title: str, names: Sequence[str]) -> Any:
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
