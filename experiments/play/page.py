"""The page: what a session publishes, shown to all who look, at an even rate."""

import contextlib
import threading
import time
import traceback
from collections.abc import Callable, Iterator

import viser

from jaxpets.envs import Robot

from ..errors import RunError, reason
from . import geometry, readout, recorder
from .command import Commands
from .controls import Controls, Panel
from .plan_part import PlanPart
from .scene import Scene
from .session import Session
from .watch import RunPart

_WORDS_RATE = 5.0


class Page:
    """One page on one server."""

    def __init__(
        self,
        server: viser.ViserServer,
        robot: Robot,
        env: str,
        session: Session,
        title: str,
        commands: Commands | None,
        make_part: Callable[[Panel], PlanPart | RunPart],
    ) -> None:
        self._robot, self._env, self._session = robot, env, session
        self._scene = Scene(server, robot.model)
        title = f"{robot.name.rpartition('/')[2]}: {title}"
        pushes = tuple(session.stepper.pushes)
        self._panel = Panel(server, title, pushes=pushes, save=self._save)
        self._part = make_part(self._panel)
        self._panel.add_memory()
        self._part.show_line(session.command.line, "")
        self._controls = Controls(commands, self._part.read(0.0))
        self._is_saving = threading.Lock()
        self._complaints: set[str] = set()

    def steer(self, session: Session) -> None:
        """Reads the controls, for the thread of the world."""
        with self._unharmed():
            seen = self._part.read(self._panel.back)
            values = self._controls.apply(session, seen, self._panel.presses())
            self._part.show_line(values.line, seen.line)
            self._panel.show_back(values.back, seen.back)

    def run(self, is_over: Callable[[float], bool], rate: float) -> None:
        """Shows what there is to be shown.

        Args:
          is_over: waits for so many s, and returns whether to end.
          rate: pictures a second.
        """
        words_at = 0.0
        while not is_over(1 / rate):
            now = time.monotonic()
            with self._unharmed():
                self._show(now)
                if now >= words_at:
                    words_at = now + 1 / _WORDS_RATE
                    self._speak(now)

    @contextlib.contextmanager
    def _unharmed(self) -> Iterator[None]:
        """Goes on whatever a visitor has made of viser's controls; says it once."""
        try:
            yield
        except Exception as error:
            if str(error) not in self._complaints:
                self._complaints.add(str(error))
                traceback.print_exc()

    def _show(self, now: float) -> None:
        shown = self._session.shown
        if shown is None:
            return
        before, after, share = shown.at(now)
        qpos = after.qpos
        if share < 1 and after.number == before.number + 1:
            model = self._robot.model
            qpos = geometry.between(model, before.qpos, after.qpos, share)
        self._scene.show(qpos, after, self._part.look)

    def _speak(self, now: float) -> None:
        session, shown = self._session, self._session.shown
        if shown is None:
            self._panel.say(readout.small(session.notice), "")
            return
        frame, clock = shown.at(now)[1], session.clock
        status = readout.status(
            clock.rate, clock.pace, session.speed, session.is_paused, session.back,
            session.notice,
        )  # fmt: skip
        self._panel.say(status, readout.readings(self._robot, frame))
        self._part.speak(session, frame)

    def _save(self, kind: str, seconds: float, client: viser.ClientHandle) -> None:
        """Makes a file of the last seconds for one visitor, one file at a time."""
        text = "It takes a moment."
        note = client.add_notification("Saving", text, loading=True)
        name = f"{self._robot.name.replace('/', '-')}.{kind}"
        try:
            with self._is_saving:
                frames = self._session.history.recent(seconds)
                if kind == "mp4":
                    data = recorder.mp4(self._env, frames)
                else:
                    data = recorder.html(self._robot, frames, self._part.look)
            client.send_file_download(name, data, save_immediately=True)
            note.body = f"{name}, {len(data) / 1e6:.1f} MB"
        except (RunError, OSError, ValueError) as error:
            note.body = reason(error)
        note.loading = False
