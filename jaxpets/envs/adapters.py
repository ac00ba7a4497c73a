"""Bridges: environments of Brax come in, a simulator goes out as a planner's model."""

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_key, check_record, is_sequence
from jaxpets._src.types import Coordinate, Env, EnvState, RolloutFn

_KEPT = ("reward", "done")


class BraxEnv(Protocol):
    """What `from_brax` needs of an environment of Brax or MuJoCo Playground."""

    @property
    def action_size(self) -> int:
        """Number of actions, each in [-1, 1]."""
        ...

    def reset(self, rng: Array) -> Any:
        """Returns a state with a field `obs`."""
        ...

    def step(self, state: Any, action: Array) -> Any:
        """Returns the next state."""
        ...


def from_brax(env: BraxEnv, *, keep: Sequence[str] = ()) -> Env:
    """Adapts an environment of Brax or MuJoCo Playground with array observations.

    Its reward is of its own state, so what it earns and where it ends can be kept in
    one way only: as entries of the observation, which a model learns to predict. A
    planner's reward then reads `next_obs` at "reward"::

      env = from_brax(brax_env, keep=("reward", "done"))
      place = coordinates.index(env.coordinates, "reward")

    Args:
      env: a single, unwrapped environment, for example
        `brax.envs.get_environment("inverted_pendulum")`.
      keep: which of "reward" and "done" are observed behind what it observes itself,
        in this order; no network reads them. With "done", which is 0 or 1, an Env has
        a `terminal_fn`.

    Returns:
      An Env whose `EnvState.physics` is the Brax state. If anything is kept it has
      coordinates, of which the environment's own are called obs/0, obs/1 and so on,
      with the change as what is predicted.

    Raises:
      TypeError, ValueError: if env is none of theirs, `keep` has another word, or the
        observation is not a vector.
    """
    if not hasattr(env, "action_size"):
        kind = type(env).__name__
        raise TypeError(f"env must be of Brax, with an action_size, got {kind}.")
    kept = _checked_keep(keep)
    one = jnp.ones((env.action_size,), jnp.float32)

    def wrap(state: Any) -> EnvState:
        if not hasattr(state.obs, "ndim") or state.obs.ndim != 1:
            shape = jax.tree.map(jnp.shape, state.obs)
            raise ValueError(f"env must observe one vector, got {shape}.")
        # Brax mixes weak types into its state, which would trace every step twice.
        state = jax.tree.map(_strong, state)
        parts = [state.obs, *(getattr(state, name)[None] for name in kept)]
        obs = jnp.concatenate([part.astype(jnp.float32) for part in parts])
        return EnvState(obs, state)

    def reset(key: Array) -> EnvState:
        check_key("key", key)
        with jax.numpy_dtype_promotion("standard"):
            return wrap(env.reset(jax.random.key_data(key)))

    def step(state: EnvState, action: Array) -> EnvState:
        with jax.numpy_dtype_promotion("standard"):
            return wrap(env.step(state.physics, action))

    adapted = Env(reset, step, action_low=-one, action_high=one)
    if not kept:
        return adapted
    size = jax.eval_shape(lambda: reset(jax.random.key(0))).obs.shape[0] - len(kept)
    rows = [Coordinate(f"obs/{i}") for i in range(size)]
    rows += [Coordinate(name, "absolute", is_input=False) for name in kept]
    adapted = adapted._replace(coordinates=tuple(rows))
    return adapted._replace(terminal_fn=_is_done) if "done" in kept else adapted


def _is_done(obs: Array) -> Array:
    return obs[..., -1] > 0.5


def _checked_keep(keep: Sequence[str]) -> list[str]:
    """Returns what is kept in the order in which it is observed."""
    if not is_sequence(keep) or not all(name in _KEPT for name in keep):
        raise ValueError(f'keep must be among ("reward", "done"), got {keep!r}.')
    return [name for name in _KEPT if name in keep]


def _strong(x: Any) -> Array:
    return jnp.asarray(x, jnp.result_type(x))


def env_rollout(env: Env) -> RolloutFn:
    """Builds a rollout that imagines with the simulator itself.

    The planner then takes an EnvState for its `obs`, and `PlanParams.dynamics` is (),
    which gives model-predictive control with the true dynamics.

    Args:
      env: the simulator; it must be deterministic given its state.

    Returns:
      A RolloutFn with one member and one particle, `[N, H+1, 1, 1, D]`.

    Raises:
      TypeError: if env is no Env; from the rollout, if its start is no EnvState.
    """
    check_record("env", env, Env)

    def rollout(params: Any, key: Array, obs: EnvState, actions: Array) -> Array:
        check_key("key", key)
        check_record("obs", obs, EnvState)
        del params

        def imagine(sequence: Array) -> Array:
            def step(state: EnvState, action: Array) -> tuple[EnvState, Array]:
                state = env.step(state, action)
                return state, state.obs

            _, path = jax.lax.scan(step, obs, sequence)
            return jnp.concatenate([obs.obs[None], path])

        return jax.vmap(imagine)(actions)[:, :, None, None]

    return rollout
