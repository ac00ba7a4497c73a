"""A robot that plans: frames from compiled programs."""

from collections.abc import Mapping
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxpets.envs import Robot

from .command import Command
from .core import Core, World
from .geometry import pushes
from .history import Frame


class Stepper(Protocol):
    """What a session shows: it gives a frame for a frame.

    Attributes:
      step_time: of a step, in s.
    """

    step_time: float

    @property
    def pushes(self) -> Mapping[str, np.ndarray]:
        """Names of the pushes that there are, and the velocities `[V]` each adds."""
        ...

    def start(self, command: Command) -> Frame:
        """Returns the first frame of a new trial."""
        ...

    def step(
        self, frame: Frame, command: Command, push: str | None
    ) -> tuple[Frame, str]:
        """Returns the frame after a frame, and why there is none after it, if so."""
        ...


class Live:
    """A robot that plans for what is asked."""

    def __init__(self, robot: Robot, core: Core, params: Any, seed: int = 0) -> None:
        self.step_time = robot.step_time
        self.pushes = pushes(robot.model) if core.push_size else {}
        self._still = np.zeros(core.push_size, np.float32)
        self._params = params
        self._key, self._start_key = jax.random.split(jax.random.key(seed))
        self._starts = 0
        self._start, self._plan, self._step = (
            jax.jit(x) for x in (core.start, core.plan, core.step)
        )

    def start(self, command: Command) -> Frame:
        """Returns the first frame of a new trial; the first call compiles."""
        key = jax.random.fold_in(self._start_key, self._starts)
        self._starts += 1
        world = self._start(command.reward, key)
        # Compiled now, while somebody is told so.
        frame, _ = self._stepped(world, command, None)
        return frame._replace(
            number=0,
            qpos=np.asarray(world.qpos),
            obs=np.asarray(world.env.obs),
            world=world,
        )

    def step(
        self, frame: Frame, command: Command, push: str | None
    ) -> tuple[Frame, str]:
        """Returns the frame after a frame, and why a new trial must begin, if so."""
        assert frame.world is not None
        return self._stepped(frame.world, command, push)

    def _stepped(
        self, world: World, command: Command, push: str | None
    ) -> tuple[Frame, str]:
        added = self.pushes[push] if push else self._still
        plan = self._plan(self._params, command.reward, self._key, world)
        world, earned, ended = self._step(
            command.reward, jnp.asarray(added), world, plan
        )
        ghosts = np.asarray(plan.ghosts)
        members, particles = ghosts.shape[:2]
        frame = Frame(
            number=int(world.number),
            qpos=np.asarray(world.qpos),
            obs=np.asarray(world.env.obs),
            ghosts=ghosts.reshape(-1, *ghosts.shape[2:]),
            members=np.repeat(np.arange(members), particles),
            earned=float(earned),
            promised=float(plan.promised),
            disagreement=float(plan.disagreement),
            wanted=command.label,
            world=world,
        )
        if not np.isfinite(frame.qpos).all():
            return frame, "Physics diverged: a new trial has begun."
        return frame, "The trial ended: a new one has begun." if bool(ended) else ""
