"""Bridges: environments of Brax come in, a simulator goes out as a planner's model."""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.checks import check_key, check_record
from jaxpets._src.types import Env, EnvState, RolloutFn


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


def from_brax(env: BraxEnv) -> Env:
    """Adapts an environment of Brax or MuJoCo Playground with array observations.

    Its reward is left behind, and so is `done`: planning here has no termination.

    Args:
      env: a single, unwrapped environment, for example
        `brax.envs.get_environment("inverted_pendulum")`.

    Returns:
      An Env whose `EnvState.physics` is the Brax state.

    Raises:
      ValueError: if the observation is not a vector.
    """
    one = jnp.ones((env.action_size,), jnp.float32)

    def wrap(state: Any) -> EnvState:
        if not hasattr(state.obs, "ndim") or state.obs.ndim != 1:
            shape = jax.tree.map(jnp.shape, state.obs)
            raise ValueError(f"env must observe one vector, got {shape}.")
        # Brax mixes weak types into its state, which would trace every step twice.
        state = jax.tree.map(_strong, state)
        return EnvState(state.obs.astype(jnp.float32), state)

    def reset(key: Array) -> EnvState:
        check_key("key", key)
        with jax.numpy_dtype_promotion("standard"):
            return wrap(env.reset(jax.random.key_data(key)))

    def step(state: EnvState, action: Array) -> EnvState:
        with jax.numpy_dtype_promotion("standard"):
            return wrap(env.step(state.physics, action))

    return Env(reset, step, action_low=-one, action_high=one)


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
