"""What the page computes: a plan and what it imagines, then a step of the world. Pure.

Two programs, as one that calls C MuJoCo cannot be kept by JAX between two processes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jaxpets
from jaxpets import rewards
from jaxpets.envs import Robot

from .reward import RewardChoice, bound, earned_of, reward_of


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


class Core(NamedTuple):
    """Pure functions, to be jitted.

    Attributes:
      start: `(RewardChoice, key) -> World`.
      plan: `(EnsembleParams, RewardChoice, key, World) -> Plan`.
      step: `(RewardChoice, push [V], World, Plan) -> (World, reward [], has ended [])`;
        the push is added to the velocities first.
      push_size: V; 0 where the physics cannot be pushed.
      horizon: H.
    """

    start: Callable[[RewardChoice, Array], World]
    plan: Callable[[Any, RewardChoice, Array, World], Plan]
    step: Callable[[RewardChoice, Array, World, Plan], tuple[World, Array, Array]]
    push_size: int
    horizon: int


def core(
    robot: Robot,
    rollout: jaxpets.typing.RolloutFn,
    search: jaxpets.optimizers.TrajectoryOptimizer,
    *,
    horizon: int,
    terminal_fn: Callable[[Any, Array], Array] | None = None,
) -> Core:
    """Builds the core of a page about one robot, which has a `qpos_fn`."""
    reward, earned = reward_of(robot), earned_of(robot)
    planner = jaxpets.plan(rollout, reward, search, terminal_fn=terminal_fn)
    track = robot.qpos_fn
    assert track is not None

    def start(choice: RewardChoice, key: Array) -> World:
        env = robot.env
        if robot.task_reset is not None:
            state = robot.task_reset(choice.task, key)
        else:
            state = env.reset(key)
        qpos = _drawn(state, track(state.obs[None])[0])
        return World(state, planner.init(), jnp.int32(0), qpos)

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

    def step(
        choice: RewardChoice, push: Array, world: World, plan: Plan
    ) -> tuple[World, Array, Array]:
        before = _pushed(world.env, push)
        state = robot.env.step(before, plan.action)
        choice = bound(choice, state.constants)
        reward = earned(choice, world.env.obs, plan.action, state.obs)
        steps = track(jnp.stack([world.env.obs, state.obs]))
        qpos = _drawn(state, world.qpos + steps[1] - steps[0])
        ends = robot.env.terminal_fn
        ended = jnp.zeros((), bool) if ends is None else ends(state.obs)
        return World(state, plan.planner, world.number + 1, qpos), reward, ended

    shape = jax.eval_shape(robot.env.reset, jax.random.key(0))
    size = shape.physics.qvel.shape[0] if hasattr(shape.physics, "qvel") else 0
    return Core(start, plan, step, size, horizon)


def _drawn(state: jaxpets.EnvState, tracked: Array) -> Array:
    """Returns positions as physics has them, or else as observations tell."""
    known = getattr(state.physics, "qpos", tracked)
    return jnp.asarray(known, jnp.float32)


def _pushed(state: jaxpets.EnvState, push: Array) -> jaxpets.EnvState:
    if not hasattr(state.physics, "qvel"):
        return state
    physics = state.physics._replace(qvel=state.physics.qvel + push)
    return state._replace(physics=physics)
