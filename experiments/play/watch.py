"""A run that explores, as it is seen from outside: its last trial, and its log."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxpets.envs import Robot

from .. import exploration, user_files
from ..errors import CheckpointError, RunError
from ..storage import metrics, rundir
from ..storage.folder import RunFolder
from .command import Command
from .history import Frame
from .source import robot_named


class Watched:
    """A run's folder, which is only read, and while another process writes there."""

    def __init__(self, run: Path, *, env: str | None, seed: int | None) -> None:
        """Opens it.

        Raises:
          RunError: if it is no run, or its robot is of a file that nobody named.
        """
        self.folder = RunFolder(run)
        config = exploration.config_of(self.folder)
        user_files.check_named("--env", env, config.env, run / rundir.CONFIG)
        self.env = env or config.env
        self.seed = config.seeds[0] if seed is None else seed
        if self.seed not in config.seeds:
            raise CheckpointError(f"{run} has no seed {self.seed}.")
        self.robot: Robot = robot_named(self.env)
        self._place = config.seeds.index(self.seed)
        self._length = config.trial_length

    def trial(self) -> int:
        """Returns the last trial that is saved, 0 if there is none."""
        return max(self.folder.steps(), default=0)

    def last_obs(self) -> tuple[int, np.ndarray] | None:
        """Returns the last trial and its observations `[T, D]`; None before the first.

        Steps from where physics diverged on are left out.
        """
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


class Replay:
    """Shows the last trial of a run over and over, and a newer one when there is."""

    pushes: Mapping[str, np.ndarray] = {}

    def __init__(self, run: Watched) -> None:
        self.step_time = run.robot.step_time
        self.trial = 0
        self._run = run
        assert run.robot.qpos_fn is not None
        self._track = jax.jit(run.robot.qpos_fn)
        self._frames = [self._rest()]

    def start(self, command: Command) -> Frame:
        """Returns the first frame of the last trial, or the robot at rest."""
        del command
        try:
            if self._run.trial() > self.trial and (found := self._run.last_obs()):
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
        rest = np.asarray(self._run.robot.model.qpos0, np.float32)
        positions = np.where(np.isfinite(positions), positions, rest)
        return [
            _frame(i, *row) for i, row in enumerate(zip(positions, obs, strict=True))
        ]

    def _rest(self) -> Frame:
        robot = self._run.robot
        obs = jax.eval_shape(robot.env.reset, jax.random.key(0)).obs
        qpos = np.asarray(robot.model.qpos0, np.float32)
        return _frame(0, qpos, np.zeros(obs.shape, np.float32))


def _frame(number: int, qpos: np.ndarray, obs: np.ndarray) -> Frame:
    nothing = np.zeros((0, 1, len(qpos)), np.float32)
    none = float("nan")
    return Frame(
        number, qpos, obs, nothing, np.zeros(0, int), none, none, none, "", None
    )
