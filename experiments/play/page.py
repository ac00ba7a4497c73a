"""The page: what a session publishes, shown to all who look, at an even rate."""

import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from jaxpets.envs import Robot

from ..errors import RunError, reason
from . import geometry, recorder, report
from .panel import AddButtons, Panel, Part
from .pilot import Pilot
from .scene import Scene
from .session import MEMORY, Session

_WORDS_RATE = 5.0


class Page:
    """One page on one server."""

    def __init__(
        self,
        server: viser.ViserServer,
        robot: Robot,
        env: str,
        session: Session,
        make_part: Callable[[Any, AddButtons], Part],
        make_pilot: Callable[[Any], Pilot],
        title: str,
    ) -> None:
        """Builds it.

        Args:
          server: that serves it.
          robot: that is seen.
          env: its name, or its file.
          session: to be shown and steered.
          make_part: of the panel.
          make_pilot: of what the controls say at first.
          title: in a few words.
        """
        self._robot, self._env, self._session = robot, env, session
        self._scene = Scene(server, robot.model)
        pushes = tuple(session.stepper.pushes)
        self._panel = Panel(server, title, make_part, pushes=pushes, save=self._save)
        self._panel.follow(self._panel.read()._replace(line=session.asked.line))
        self._pilot = make_pilot(self._panel.read())
        self._is_saving = threading.Lock()

    def steer(self, session: Session) -> None:
        """Reads the controls, for the thread of the world."""
        said = self._pilot.steer(session, self._panel.read(), self._panel.events())
        self._panel.follow(said)

    def run(self, is_over: Callable[[float], bool], rate: float) -> None:
        """Shows what there is to be shown.

        Args:
          is_over: waits for so many s, and returns whether to end.
          rate: pictures a second.
        """
        words_at = 0.0
        while not is_over(1 / rate):
            now = time.monotonic()
            try:
                self._show(now)
                if now >= words_at:
                    words_at = now + 1 / _WORDS_RATE
                    self._speak(now)
            except Exception:  # of what a visitor has made of a control
                traceback.print_exc()
                is_over(1.0)

    def _show(self, now: float) -> None:
        shown = self._session.shown
        if shown is None:
            return
        before, after, share = shown.at(now)
        qpos = after.qpos
        if share < 1 and after.number == before.number + 1:
            model = self._robot.model
            qpos = geometry.between(model, before.qpos, after.qpos, share)
        self._scene.show(qpos, after, self._panel.part.look)

    def _speak(self, now: float) -> None:
        session, shown = self._session, self._session.shown
        if shown is None:
            self._panel.say(report.small(session.notice), "")
            return
        frame, clock = shown.at(now)[1], session.clock
        status = report.status(
            clock.rate, clock.pace, session.speed, session.is_paused, session.back,
            session.notice,
        )  # fmt: skip
        self._panel.say(status, report.readings(self._robot, frame))
        self._panel.part.speak(session, frame)

    def _save(self, kind: str, seconds: float, client: viser.ClientHandle) -> None:
        """Makes a file of the last seconds for one visitor, one file at a time."""
        text = "It takes a moment."
        note = client.add_notification("Saving", text, loading=True)
        name = f"{self._robot.name.replace('/', '-')}.{kind}"
        try:
            with self._is_saving:
                frames = self._session.recent(float(np.clip(seconds, 1.0, MEMORY)))
                if kind == "mp4":
                    data = recorder.mp4(self._env, frames)
                else:
                    look = self._panel.part.look
                    data = recorder.html(self._robot, frames, look)
            client.send_file_download(name, data)
            note.body = f"{name}, {len(data) / 1e6:.1f} MB"
        except (RunError, OSError, ValueError) as error:
            note.body = reason(error)
        note.loading = False
