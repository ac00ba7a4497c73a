"""A robot that plans: a plan and what it imagines, then a step of the world.

Two programs, as JAX keeps none that calls Python between two processes, and the step of
C MuJoCo does where there is no C++ compiler.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jaxpets
from jaxpets import rewards
from jaxpets.envs import Robot
from jaxpets.policies import Guided

from ..acting import at_start
from ..policy import Policy
from .command import Command, RewardChoice, bound, earned_of, reward_of
from .geometry import pushes
from .session import Frame


class World(NamedTuple):
    """Where the robot stands: all that is needed to go on from there.

    Attributes:
      env: the environment's state.
      planner: the warm start of the search.
      number: `[]` int32, of the steps since the start.
      qpos: `[Q]`, where it is drawn, in m and rad, and quaternions.
    """

    env: jaxpets.EnvState
    planner: Any
    number: Array
    qpos: Array


class Plan(NamedTuple):
    """A plan, and what it leads to.

    Attributes:
      planner: the state of the search after it.
      action: `[A]`, to execute.
      promised: `[]`, the return that it foresees, per step.
      disagreement: `[]`, of the members about where it leads, in the units of the
        model's own noise: the mean over its steps.
      ghosts: `[E, P, H+1, Q]`, where each particle goes, as it is drawn.
    """

    planner: Any
    action: Array
    promised: Array
    disagreement: Array
    ghosts: Array


class Live:
    """A robot that plans for what is asked, a `session.Stepper`."""

    def __init__(
        self,
        robot: Robot,
        rollout: jaxpets.typing.RolloutFn,
        search: jaxpets.optimizers.TrajectoryOptimizer,
        params: Any,
        *,
        horizon: int,
        terminal_fn: Callable[[Any, Array], Array] | None = None,
        policy: Policy | None = None,
    ) -> None:
        self.step_time = robot.step_time
        reset = jax.eval_shape(robot.env.reset, jax.random.key(0))
        self.pushes = pushes(robot.model) if hasattr(reset.physics, "qvel") else {}
        self._still = np.zeros(robot.model.nv, np.float32)
        self._params = params
        self._key, self._start_key = jax.random.split(jax.random.key(0))
        self._starts = 0
        planner = jaxpets.plan(
            rollout, reward_of(robot), search, terminal_fn=terminal_fn
        )
        self._start = jax.jit(_start(robot, planner))
        self._plan = jax.jit(_plan(robot, rollout, planner, horizon))
        self._decide = jax.jit(_decide(policy, planner)) if policy else None
        self._step = jax.jit(_step(robot))

    def start(self, command: Command) -> Frame:
        """Returns the first frame of a new trial; the first call compiles."""
        key = jax.random.fold_in(self._start_key, self._starts)
        self._starts += 1
        world = self._start(command.reward, key)
        # Compiled now, while somebody is told so.
        if self._decide is not None:
            jax.block_until_ready(self._decide(command.reward, self._key, world))
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
        return self._stepped(frame.world, command, push)

    def _stepped(
        self, world: World, command: Command, push: str | None
    ) -> tuple[Frame, str]:
        added = self.pushes[push] if push else self._still
        if self._decide is not None and command.is_for_policy:
            plan = self._decide(command.reward, self._key, world)
        else:
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
            ghosts=ghosts.reshape(members * particles, *ghosts.shape[2:]),
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


def _start(robot: Robot, planner: jaxpets.Planner) -> Callable[..., World]:
    track = _track(robot)

    def start(choice: RewardChoice, key: Array) -> World:
        state = at_start(robot, choice.task).reset(key)
        qpos = _drawn(state, track(state.obs[None])[0])
        return World(state, planner.init(), jnp.int32(0), qpos)

    return start


def _plan(
    robot: Robot,
    rollout: jaxpets.typing.RolloutFn,
    planner: jaxpets.Planner,
    horizon: int,
) -> Callable[..., Plan]:
    track = _track(robot)

    def plan(params: Any, choice: RewardChoice, key: Array, world: World) -> Plan:
        obs = world.env.obs
        choice = bound(choice, world.env.constants)
        plan_key, ghost_key = jax.random.split(jax.random.fold_in(key, world.number))
        known = jaxpets.PlanParams(params, choice)
        output, state = planner.step(known, plan_key, world.planner, obs)
        path = rollout(params, ghost_key, obs, output.actions[None])[0]
        spread = jax.vmap(rewards.epistemic, (None, 0, 0, 0))(
            choice.base, path[:-1], output.actions, path[1:]
        )
        each = jax.vmap(jax.vmap(track, 1), 1)(path)  # [E, P, H+1, Q]
        # It starts where the robot is, also where that is not observed.
        ghosts = each + (world.qpos - each[:, :, :1])
        ghosts = jnp.where(jnp.isfinite(ghosts), ghosts, world.qpos)
        return Plan(
            state, output.action, output.value / horizon, jnp.mean(spread), ghosts
        )

    return plan


def _decide(policy: Policy, planner: jaxpets.Planner) -> Callable[..., Plan]:
    """Returns what acts and imagines nothing; later plans begin anew."""

    def decide(choice: RewardChoice, key: Array, world: World) -> Plan:
        task = bound(choice, world.env.constants).task
        known = jaxpets.PlanParams((), Guided(task, policy.networks))
        key = jax.random.fold_in(key, world.number)
        output, _ = policy.planner.step(known, key, (), world.env.obs)
        unknown, nobody = jnp.float32(jnp.nan), jnp.zeros((0, 0, 2, *world.qpos.shape))
        return Plan(planner.init(), output.action, unknown, unknown, nobody)

    return decide


def _step(robot: Robot) -> Callable[..., tuple[World, Array, Array]]:
    """Returns a step after a push `[V]`, with what it earns and whether it ends."""
    earned, track = earned_of(robot), _track(robot)

    def step(
        choice: RewardChoice, push: Array, world: World, plan: Plan
    ) -> tuple[World, Array, Array]:
        state = robot.env.step(_pushed(world.env, push), plan.action)
        choice = bound(choice, state.constants)
        reward = earned(choice, world.env.obs, plan.action, state.obs)
        steps = track(jnp.stack([world.env.obs, state.obs]))
        qpos = _drawn(state, world.qpos + steps[1] - steps[0])
        ends = robot.env.terminal_fn
        ended = jnp.zeros((), bool) if ends is None else ends(state.obs)
        return World(state, plan.planner, world.number + 1, qpos), reward, ended

    return step


def _track(robot: Robot) -> Callable[[Array], Array]:
    assert robot.qpos_fn is not None
    return robot.qpos_fn


def _drawn(state: jaxpets.EnvState, tracked: Array) -> Array:
    """Returns positions as physics has them, or else as observations tell."""
    known = getattr(state.physics, "qpos", tracked)
    return jnp.asarray(known, jnp.float32)


def _pushed(state: jaxpets.EnvState, push: Array) -> jaxpets.EnvState:
    if not hasattr(state.physics, "qvel"):
        return state
    physics = state.physics._replace(qvel=state.physics.qvel + push)
    return state._replace(physics=physics)
