"""Trials that a policy imagines, with a planner that says what it would do in them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.action_box import ActionBox
from jaxpets._src.actor_critic_networks import Networks
from jaxpets._src.actor_critic_records import ActorCriticParams, Goals, Guided
from jaxpets._src.distill_records import DistillConfig, DistillState, Plans
from jaxpets._src.distill_update import keep
from jaxpets._src.elites import WORST_VALUE
from jaxpets._src.imagined_trials import (
    Imagined,
    over_trials,
    renewed,
    trial_starts,
)
from jaxpets._src.types import Dataset, Planner, PlanOutput, PlanParams

_OWN: Any = 0  # the axis of what every trial has
_SHARED: Any = None


class Asked(NamedTuple):
    """Sums over the plans of one step of all trials that can be learned from.

    Attributes:
      square: `[]`, of the mean square between the policy's action and the planner's.
      value: `[]`, of what the planner expects.
      number: `[]`, how many there are.
    """

    square: Array
    value: Array
    number: Array


class Trials(NamedTuple):
    """Functions of trials `[E, B]`.

    Attributes:
      fresh: `(reward data, key, dataset) -> (obs, rewards, planning)` where they begin.
      plan: `(PlanParams, networks, keys, rewards, planning, obs)`, as a planner's step.
      ask: `(PlanParams, dataset, noise [E, B, 1], state, key) -> (state, Asked)`: plans
        in all of them, and moves them by one step.
    """

    fresh: Callable[[Any, Array, Dataset], tuple[Array, Any, Any]]
    plan: Callable[..., tuple[PlanOutput, Any]]
    ask: Callable[
        [PlanParams, Dataset, Array, DistillState, Array], tuple[DistillState, Asked]
    ]


def build_trials(
    planner: Planner,
    networks: Networks,
    config: DistillConfig,
    box: ActionBox,
    rows: tuple[int, int],
    goals: Goals,
    is_guided: bool,
    move: Callable[[Any, Any, Array, Any, Array], Imagined],
) -> Trials:
    """Builds the functions; see `distill`.

    `is_guided` says that the planner reads Guided; `move` gets actions for a policy.
    """
    starts = trial_starts(goals.draw, rows)
    goals_of = over_trials(goals.features, rows)
    axes = Guided(_OWN, _SHARED) if is_guided else _OWN
    takes = (PlanParams(_SHARED, axes), 0, 0, 0)
    every = jax.vmap(jax.vmap(planner.step, takes), takes)

    def plan(
        params: PlanParams, networks: ActorCriticParams, keys: Array, rewards: Any,
        planning: Any, obs: Array,
    ) -> tuple[PlanOutput, Any]:  # fmt: skip
        data = Guided(rewards, networks) if is_guided else rewards
        return every(PlanParams(params.dynamics, data), keys, planning, obs)

    def fresh(data: Any, key: Array, dataset: Dataset) -> tuple[Array, Any, Any]:
        def everywhere(x: Array) -> Array:
            return jnp.broadcast_to(x, (*rows, *jnp.shape(x)))

        return *starts(data, key, dataset), jax.tree.map(everywhere, planner.init())

    def ask(
        params: PlanParams, dataset: Dataset, noise: Array, state: DistillState,
        key: Array,
    ) -> tuple[DistillState, Asked]:  # fmt: skip
        plan_key, noise_key, move_key, again_key, start_key = jax.random.split(key, 5)
        plan_keys = jax.random.split(plan_key, rows)
        said, planning = plan(
            params, state.params, plan_keys, state.rewards, state.planning, state.obs
        )
        wanted = (said.action - box.center) / box.half_width
        seen = networks.see(state.params, goals_of(state.rewards), state.obs)
        own = jnp.tanh(networks.propose(state.params.actor, seen))
        place = jnp.arange(rows[1], dtype=jnp.float32)[:, None] / rows[1]
        planned = place < config.planned
        action = jnp.where(planned, wanted, own)
        action += noise * jax.random.normal(noise_key, action.shape, jnp.float32)
        action = box.center + box.half_width * jnp.clip(action, -1.0, 1.0)
        steps = move(params.dynamics, action, move_key, state.rewards, state.obs)
        # A search all of whose candidates were rejected has nothing to teach.
        good = said.value > WORST_VALUE / 1e3
        counts = good.astype(jnp.float32)
        value = jnp.where(good, said.value, 0.0)
        # No weight of 0 would mask what is not finite.
        known, taught = (jnp.where(good[..., None], x, 0.0) for x in (seen, wanted))
        state = keep(state, Plans(known, taught, value, counts))
        again = jax.random.uniform(again_key, rows, jnp.float32) < config.restart
        again |= ~(steps.counts[0] & steps.goes_on[0])
        obs, rewards, planning = renewed(
            again,
            fresh(params.reward, start_key, dataset),
            (steps.next_obs[0], state.rewards, planning),
        )
        state = state._replace(obs=obs, rewards=rewards, planning=planning)
        square = jnp.where(good, jnp.mean((own - wanted) ** 2, -1), 0.0)
        return state, Asked(jnp.sum(square), jnp.sum(value), jnp.sum(counts))

    return Trials(fresh, plan, ask)
