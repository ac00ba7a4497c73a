"""An actor and a critic that learn a task in imagination, from states once seen."""

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxpets._src.action_box import action_box
from jaxpets._src.actor_critic_networks import build_networks, guided_reward
from jaxpets._src.actor_critic_records import (
    ActorCritic,
    ActorCriticConfig,
    ActorCriticMetrics,
    ActorCriticState,
    Goals,
)
from jaxpets._src.actor_critic_update import build_update
from jaxpets._src.check_space import check_space_size
from jaxpets._src.checks import (
    check_count,
    check_record,
)
from jaxpets._src.imagined_trials import (
    check_imagined,
    imagine,
    over_trials,
    renewed,
    reward_range,
    trial_starts,
)
from jaxpets._src.optimizer import Optimizer, check_optimizer
from jaxpets._src.types import (
    Dataset,
    DynamicsFn,
    ModelSpace,
    PlanParams,
    RewardFn,
)

_NO_GOALS = Goals()


def actor_critic(
    dynamics_fn: DynamicsFn,
    reward_fn: RewardFn,
    optimizer: Optimizer,
    config: ActorCriticConfig,
    space: ModelSpace,
    *,
    obs_size: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
    num_members: int = 1,
    goals: Goals = _NO_GOALS,
    terminal_fn: Callable[[Any, Array], Array] | None = None,
) -> ActorCritic:
    """Builds what learns a task from a model alone: no step is taken in the world.

    The paper plans no further than the horizon of its search. Where a reward is further
    away no plan finds it, so here a critic learns what comes after the horizon, as in
    POLO (Lowrey et al., 2018) and TD-MPC (Hansen et al., 2022), from trials that a
    model explored without a reward imagines. They start in states of the data, keep
    their member as TS-infinity does (section 3.2), and act by the actor, with noise.
    Two critics learn its lambda-returns; the actor climbs the mean of the critics, as
    in DDPG (Lillicrap et al., 2015). With `config.squash` both are of logarithms, as in
    DreamerV3 (Hafner et al., 2023).

    A value is at most the largest reward seen or imagined so far, for ever, and at
    least the smallest; returns beyond are clipped, so that no error feeds itself.

    Nothing is jitted. Tasks and seeds are mapped: `step` over tasks with
    `jax.vmap(step, (PlanParams(None, 0), 0, 0, None))`.

    Args:
      dynamics_fn: the model; reads `PlanParams.dynamics`, and gets actions `[E, B, A]`.
      reward_fn: reads `PlanParams.reward`. It is asked about single states,
        `[1, 1, D]`, so it cannot compare members.
      optimizer: of optax, for both networks; `optax.adam` at a rate that falls to a
        twentieth of 1e-3 over all gradient steps works well.
      config: sizes and numbers.
      space: what the networks see of an observation, `ModelSpace.features`.
      obs_size: D.
      action_low: `[A]`, finite.
      action_high: `[A]`, above action_low.
      num_members: E, of the model.
      goals: what differs between trials.
      terminal_fn: `(reward data, obs [..., D]) -> bool [...]`: where a trial ends.

    Returns:
      An ActorCritic. Its functions raise TypeError or ValueError, when traced, for
      arguments of another kind or shape.

    Raises:
      TypeError, ValueError: if an argument is not what it should be, or space has
        another size than obs_size.
    """
    check_optimizer(optimizer)
    check_record("config", config, ActorCriticConfig)
    check_space_size(space, obs_size)
    num_members = check_count("num_members", num_members)
    box = action_box(action_low, action_high)
    sizes = (obs_size, box.center.shape[0])
    networks = build_networks(config.hidden_size, space, goals, box)
    learn = build_update(networks, optimizer, config, box)
    rows = (num_members, -(-config.batch_size // num_members))
    goals_of = over_trials(goals.features, rows)

    def explore(policy: Any, key: Array, rewards: Any, obs: Array) -> Array:
        params, noise = policy
        seen = networks.see(params, goals_of(rewards), obs)
        action = jnp.tanh(networks.propose(params.actor, seen))
        action += noise * jax.random.normal(key, action.shape, jnp.float32)
        return box.center + box.half_width * jnp.clip(action, -1.0, 1.0)

    run = imagine(dynamics_fn, reward_fn, terminal_fn, explore, config.horizon)
    starts = trial_starts(goals.draw, rows)

    def init(params: PlanParams, key: Array, dataset: Dataset) -> ActorCriticState:
        check_imagined(params, key, dataset, *sizes)
        start_key, draw_key, network_key = jax.random.split(key, 3)
        obs, rewards = starts(params.reward, start_key, dataset)
        low, high = reward_range(
            reward_fn, goals.draw, params.reward, draw_key, dataset
        )
        largest = jnp.maximum(high, -low)
        scale = (1.0 - config.discount) / jnp.where(largest > 0.0, largest, 1.0)
        goal = goals_of(rewards).reshape(rows[0] * rows[1], -1)
        squash = jnp.asarray(config.squash, jnp.float32)
        found = networks.init(network_key, goal, dataset)
        found = found._replace(scale=scale, squash=squash)
        opt_state = optimizer.init(cast(Any, (found.actor, found.critics)))
        targets = jax.tree.map(jnp.copy, found.critics)  # all may be donated
        return ActorCriticState(found, targets, opt_state, obs, rewards, low, high)

    def update(
        params: PlanParams, dataset: Dataset, state: ActorCriticState, key: Array
    ) -> tuple[ActorCriticState, ActorCriticMetrics]:
        noise_key, run_key, learn_key, again_key, start_key = jax.random.split(key, 5)
        noise = config.noise * jax.random.uniform(noise_key, (*rows, 1), jnp.float32)
        policy = (state.params, noise)
        steps = run(params.dynamics, policy, run_key, state.rewards, state.obs)
        state = state._replace(
            low=jnp.minimum(state.low, jnp.min(steps.reward)),
            high=jnp.maximum(state.high, jnp.max(steps.reward)),
        )
        goal = goals_of(state.rewards)
        state, value, skipped = learn(state, learn_key, goal, steps)
        # Half of the trials are never far from the data; the others go on.
        again = jax.random.uniform(again_key, rows, jnp.float32) < config.restart
        again |= jnp.arange(rows[1]) < (rows[1] + 1) // 2
        again |= ~(steps.counts[-1] & steps.goes_on[-1])

        fresh = starts(params.reward, start_key, dataset)
        obs, rewards = renewed(again, fresh, (steps.next_obs[-1], state.rewards))
        metrics = ActorCriticMetrics(value, jnp.mean(steps.reward), skipped)
        return state._replace(obs=obs, rewards=rewards), metrics

    def step(
        params: PlanParams, key: Array, state: ActorCriticState, dataset: Dataset
    ) -> tuple[ActorCriticState, ActorCriticMetrics]:
        check_imagined(params, key, dataset, *sizes)
        check_record("state", state, ActorCriticState)
        keys = jax.random.split(key, config.num_updates)
        state, every = jax.lax.scan(
            functools.partial(update, params, dataset), state, keys
        )
        num_skipped = jnp.sum(every.num_skipped, dtype=jnp.int32)
        value, reward = jnp.mean(every.value), jnp.mean(every.reward)
        return state, ActorCriticMetrics(value, reward, num_skipped)

    reward = guided_reward(reward_fn)
    return ActorCritic(init, step, networks.policy, reward, networks.value_fn)
