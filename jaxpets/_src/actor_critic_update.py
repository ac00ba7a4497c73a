"""One gradient step of an actor and two critics on imagined trials."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.action_box import ActionBox
from jaxpets._src.actor_critic_networks import Networks
from jaxpets._src.actor_critic_records import (
    ActorCriticConfig,
    ActorCriticParams,
    ActorCriticState,
)
from jaxpets._src.guards import guarded_step
from jaxpets._src.imagined_trials import Imagined
from jaxpets._src.optimizer import Optimizer
from jaxpets._src.symlog import symexp, symlog

# Keeps the actor's outputs where its tanh has a slope.
_ACTION_DECAY = 1e-4
# Deviation of the noise on the actions that targets are made of, cut at twice as much:
# TD3 (Fujimoto et al., 2018).
_SMOOTHING = 0.1

# `(state, key, goal [E, B, G], steps [K, E, B]) -> (state, value [], skipped [])`.
UpdateFn = Callable[
    [ActorCriticState, Array, Array, Imagined], tuple[ActorCriticState, Array, Array]
]


def build_update(
    networks: Networks, optimizer: Optimizer, config: ActorCriticConfig, box: ActionBox
) -> UpdateFn:
    """Builds the step; see `actor_critic` for what it minimises."""

    def targets_of(
        state: ActorCriticState, key: Array, goal: Array, steps: Imagined
    ) -> Array:
        params = state.params
        seen = networks.see(params, goal, steps.next_obs)
        action = jnp.tanh(networks.propose(params.actor, seen))
        noise = jax.random.truncated_normal(key, -2.0, 2.0, action.shape, jnp.float32)
        action = jnp.clip(action + _SMOOTHING * noise, -1.0, 1.0)
        judged = networks.judge(state.targets, seen, action)
        first, second = symexp(judged, params.squash)
        after = (first + second) / 2 - config.pessimism * jnp.abs(first - second) / 2
        returns = lambda_returns(
            params.scale * steps.reward, after, steps.goes_on, steps.counts,
            discount=config.discount, trace=config.trace,
        )  # fmt: skip
        bound = params.scale / (1.0 - config.discount)
        returns = jnp.clip(returns, bound * state.low, bound * state.high)
        return symlog(returns, params.squash)

    def loss(
        trained: tuple[Any, Any], params: ActorCriticParams, goal: Array,
        steps: Imagined, targets: Array,
    ) -> tuple[Array, Array]:  # fmt: skip
        actor, critics = trained
        seen = networks.see(params, goal, steps.obs)
        taken = (steps.action - box.center) / box.half_width
        error = networks.judge(critics, seen, taken) - targets
        proposed = networks.propose(actor, seen)
        # The critics as they were: what the actor wants must not change them.
        judged = networks.judge(params.critics, seen, jnp.tanh(proposed))
        decay = _ACTION_DECAY * jnp.mean(proposed**2, axis=-1)
        weight = steps.counts.astype(jnp.float32)
        weight /= jnp.maximum(jnp.sum(weight), 1.0)
        total = jnp.sum(error**2, axis=0) - judged.mean(0) + decay
        value = symexp(judged, params.squash).mean(0)
        return jnp.sum(weight * total), jnp.sum(weight * value)

    def update(
        state: ActorCriticState, key: Array, goal: Array, steps: Imagined
    ) -> tuple[ActorCriticState, Array, Array]:
        params = state.params
        targets = targets_of(state, key, goal, steps)
        old = (params.actor, params.critics)
        (_, value), grads = jax.value_and_grad(loss, has_aux=True)(
            old, params, goal, steps, targets
        )
        (actor, critics), opt_state, good = guarded_step(
            optimizer.update, grads, old, state.opt_state
        )

        def follow(slow: Array, fast: Array) -> Array:
            return slow + config.target_rate * (fast - slow)

        state = state._replace(
            params=params._replace(actor=actor, critics=critics),
            targets=jax.tree.map(follow, state.targets, critics),
            opt_state=opt_state,
        )
        return state, value / params.scale, ~good

    return update


def lambda_returns(
    reward: Array,
    after: Array,
    goes_on: Array,
    counts: Array,
    *,
    discount: float | Array,
    trace: float | Array,
) -> Array:
    """Returns `G_t = r_t + discount ((1 - trace) V_t + trace G_t+1)`, `[K, ...]`.

    V_t is what follows step t, and G where the horizon ends; nothing follows the end of
    a trial.

    Args:
      reward: `[K, ...]`.
      after: `[K, ...]`, V.
      goes_on: `[K, ...]` bool, whether the trial does.
      counts: `[K, ...]` bool; of a step that does not, nothing but V is read.
      discount: per step.
      trace: lambda.
    """

    def back(later: Array, step: tuple[Array, ...]) -> tuple[Array, Array]:
        reward, after, goes_on, counts = step
        mixed = (1.0 - trace) * after + trace * later
        found = reward + discount * jnp.where(goes_on, mixed, 0.0)
        # A step that is not finite stays where it was: V is what follows from there.
        return jnp.where(counts, found, after), found

    steps = (reward, after, goes_on, counts)
    _, returns = jax.lax.scan(back, after[-1], steps, reverse=True)
    return returns
