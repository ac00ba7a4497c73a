"""An environment and a planner, stepped together in one scan."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_count,
    check_key,
    check_like,
    check_record,
)
from jaxpets._src.types import (
    Env,
    EnvState,
    Planner,
    PlanOutput,
    PlanParams,
    Transition,
)


class UnrollState(NamedTuple):
    """Where a trial stands; a trial may be unrolled in parts.

    Attributes:
      env: the environment's state.
      planner: the planner's state.
      step: `[]` int32, environment steps since the reset.
    """

    env: EnvState
    planner: Any
    step: Array


def start_trial(env: Env, planner: Planner, key: Array) -> UnrollState:
    """Resets the environment and the planner for a new trial.

    Args:
      env: where to act.
      planner: how to act.
      key: consumed by the reset.

    Returns:
      The state from which `unroll` goes on.

    Raises:
      TypeError, ValueError: if an argument, or what `env.reset` returns, is not what
        it should be.
    """
    check_record("env", env, Env)
    check_record("planner", planner, Planner)
    check_key("key", key)
    return UnrollState(reset(env, key), planner.init(), jnp.zeros((), jnp.int32))


def reset(env: Env, key: Array) -> EnvState:
    """Returns what `env.reset` does, if that is an EnvState."""
    state = env.reset(key)
    check_record("env.reset's result", state, EnvState)
    check_array("env.reset's result.obs", state.obs, ["D"])
    return state


def unroll(
    env: Env,
    planner: Planner,
    params: PlanParams,
    key: Array,
    state: UnrollState,
    *,
    length: int,
    observe_fn: Callable[[EnvState], Any] = lambda state: state.obs,
) -> tuple[UnrollState, Transition, PlanOutput]:
    """Runs the planner in the environment for T = `length` steps.

    Step t uses the key `fold_in(key, t)` with t counted from the reset, so a trial
    unrolled in parts with one key is the same trial. Where `env.terminal_fn` says that
    the trial has ended, environment and planner begin anew before they go on; no
    transition leads from an end to a new start.

    Args:
      env: where to act.
      planner: how to act.
      params: forwarded to the planner.
      key: consumed by the whole trial.
      state: from `start_trial`, or from the last part.
      length: T.
      observe_fn: what the planner gets to see; `lambda state: state` for a planner
        that imagines with the simulator, see `jaxpets.envs.env_rollout`.

    Returns:
      The state after T steps, the transitions `[T, ...]` and the plans `[T, ...]`.

    Raises:
      TypeError, ValueError: if an argument is not what it should be, or env.step
        returns another structure, shape or dtype than it takes.
    """
    check_record("env", env, Env)
    check_record("planner", planner, Planner)
    check_record("params", params, PlanParams)
    check_key("key", key)
    check_record("state", state, UnrollState)
    length = check_count("length", length)
    check_callable("observe_fn", observe_fn)

    def tick(
        state: UnrollState, _: None
    ) -> tuple[UnrollState, tuple[Transition, PlanOutput]]:
        plan_key = jax.random.fold_in(key, state.step)
        if env.terminal_fn is not None:
            plan_key, reset_key = jax.random.split(plan_key)
            state = _begun_anew(env, planner, reset_key, state)
        output, planner_state = planner.step(
            params, plan_key, state.planner, observe_fn(state.env)
        )
        env_state = env.step(state.env, output.action)
        check_like("env.step's result", env_state, state.env)
        transition = Transition(state.env.obs, output.action, env_state.obs)
        return UnrollState(env_state, planner_state, state.step + 1), (
            transition,
            output,
        )

    state, (transitions, outputs) = jax.lax.scan(tick, state, None, length=length)
    return state, transitions, outputs


def _begun_anew(
    env: Env, planner: Planner, key: Array, state: UnrollState
) -> UnrollState:
    """Returns the state, or one of a new start if the trial has ended in it."""
    assert env.terminal_fn is not None
    ended = env.terminal_fn(state.env.obs)
    if jnp.shape(ended) != () or jnp.result_type(ended) != jnp.bool_:
        got = f"{jnp.result_type(ended)}{list(jnp.shape(ended))}"
        raise ValueError(f"env.terminal_fn must return bool[], got {got}.")
    fresh = UnrollState(reset(env, key), planner.init(), state.step)
    return jax.tree.map(functools.partial(jnp.where, ended), fresh, state)
