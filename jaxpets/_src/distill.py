"""A planner's decisions as a network: a policy for when there is no time to plan."""

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from jaxpets._src.action_box import action_box
from jaxpets._src.actor_critic_networks import build_networks, guided_reward
from jaxpets._src.actor_critic_records import Goals
from jaxpets._src.check_space import check_space_size
from jaxpets._src.checks import check_callable, check_count, check_record
from jaxpets._src.distill_records import (
    DistillConfig,
    Distiller,
    DistillMetrics,
    DistillState,
    Plans,
)
from jaxpets._src.distill_trials import build_trials
from jaxpets._src.distill_update import build_update
from jaxpets._src.imagined_trials import (
    check_imagined,
    imagine,
    over_trials,
    reward_range,
)
from jaxpets._src.optimizer import Optimizer, check_optimizer
from jaxpets._src.types import (
    Dataset,
    DynamicsFn,
    ModelSpace,
    Planner,
    PlanParams,
    RewardFn,
)

_NO_GOALS = Goals()


def distill(
    planner: Planner | Callable[[Planner, RewardFn], Planner],
    dynamics_fn: DynamicsFn,
    reward_fn: RewardFn,
    optimizer: Optimizer,
    config: DistillConfig,
    space: ModelSpace,
    *,
    obs_size: int,
    action_low: ArrayLike,
    action_high: ArrayLike,
    num_members: int = 1,
    goals: Goals = _NO_GOALS,
    terminal_fn: Callable[[Any, Array], Array] | None = None,
) -> Distiller:
    """Builds what learns to act as a planner would, for all tasks of a family at once.

    As in DAgger (Ross et al., 2011) the policy acts, the planner says at every step
    what it would do there, and the networks learn all that it has said so far. Here
    this happens in trials that a model imagines, as in `policies.actor_critic`: they
    begin in states of the data, keep their member (TS-infinity, section 3.2 of the
    paper), and each has a task of its own, which the networks see. In a share of them
    the planner itself acts. It goes on from its own last plan, as it does when it acts.
    The value that is learned beside is what the planner expects to earn over its
    horizon; two critics learn it, so that it can be asked for other actions, too.

    What the policy does in the world is best taken into the data between calls: then
    imagined trials begin where it leads to.

    Nothing is jitted. Seeds are mapped.

    Args:
      planner: whose decisions are learned; it reads `PlanParams`. Its actions are in
        the box. Or what builds it, `(policy, reward_fn) -> Planner`, from the policy
        and a reward whose data are Guided, as those of the planner then are: for
        `plan(propose_fn=policies.prior(policy, ...))`. A search that begins with what
        the policy would do finds what is better near it, and of several ways that are
        as good it takes the one that the policy knows, so that it can be learned.
      dynamics_fn: the model in which trials are imagined; reads `PlanParams.dynamics`,
        and gets actions `[E, B, A]`.
      reward_fn: of the planner; reads `PlanParams.reward` and is asked about single
        states, `[1, 1, D]`. Where it is not finite, an imagined trial ends.
      optimizer: of optax, for all networks; `optax.adam` at a rate that falls to a
        twentieth of 1e-3 over all gradient steps works well.
      config: sizes and numbers.
      space: what the networks see of an observation, `ModelSpace.features`.
      obs_size: D.
      action_low: `[A]`, finite.
      action_high: `[A]`, above action_low.
      num_members: E, of the model.
      goals: which task a trial has; `draw` gets `PlanParams.reward`, as all rows of a
        family, and what it returns is what the planner and reward_fn read.
      terminal_fn: `(reward data, obs [..., D]) -> bool [...]`: where a trial ends.

    Returns:
      A Distiller. Its functions raise TypeError or ValueError, when traced, for
      arguments of another kind or shape.

    Raises:
      TypeError, ValueError: if an argument is not what it should be, or space has
        another size than obs_size.
    """
    check_optimizer(optimizer)
    check_record("config", config, DistillConfig)
    check_space_size(space, obs_size)
    num_members = check_count("num_members", num_members)
    box = action_box(action_low, action_high)
    sizes = (obs_size, box.center.shape[0])
    networks = build_networks(config.hidden_size, space, goals, box)
    reward, is_guided = guided_reward(reward_fn), not isinstance(planner, Planner)
    if not isinstance(planner, Planner):
        check_callable("planner", planner)
        planner = planner(networks.policy, reward)
    check_record("planner", planner, Planner)
    learn = build_update(networks, optimizer, config.batch_size)
    rows = (num_members, -(-config.num_trials // num_members))
    num_trials = rows[0] * rows[1]
    # Whole imagined steps.
    capacity = -(-config.capacity // num_trials) * num_trials
    goals_of = over_trials(goals.features, rows)
    trials = build_trials(
        planner, networks, config, box, rows, goals, is_guided,
        imagine(dynamics_fn, reward_fn, terminal_fn, _given, 1),
    )  # fmt: skip

    def init(params: PlanParams, key: Array, dataset: Dataset) -> DistillState:
        check_imagined(params, key, dataset, *sizes)
        start_key, draw_key, network_key, plan_key = jax.random.split(key, 4)
        obs, rewards, planning = trials.fresh(params.reward, start_key, dataset)
        low, high = reward_range(
            reward_fn, goals.draw, params.reward, draw_key, dataset
        )
        goal = goals_of(rewards).reshape(num_trials, -1)
        found = networks.init(network_key, goal, dataset)
        keys = jax.random.split(plan_key, rows)
        plan = jax.eval_shape(trials.plan, params, found, keys, rewards, planning, obs)
        largest = plan[0].actions.shape[2] * jnp.maximum(high, -low)
        scale = 1.0 / jnp.where(largest > 0.0, largest, 1.0)
        found = found._replace(scale=scale)
        shapes = (found.mean.shape, box.center.shape, (), ())
        plans = Plans(*(jnp.zeros((capacity, *x), jnp.float32) for x in shapes))
        opt_state = optimizer.init(cast(Any, (found.actor, found.critics)))
        size, cursor = jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
        return DistillState(
            found, opt_state, obs, rewards, planning, plans, size, cursor
        )

    def step(
        params: PlanParams, key: Array, state: DistillState, dataset: Dataset
    ) -> tuple[DistillState, DistillMetrics]:
        check_imagined(params, key, dataset, *sizes)
        check_record("state", state, DistillState)
        noise_key, ask_key, learn_key = jax.random.split(key, 3)
        noise = config.noise * jax.random.uniform(noise_key, (*rows, 1), jnp.float32)
        ask_keys = jax.random.split(ask_key, config.horizon)
        asked = functools.partial(trials.ask, params, dataset, noise)
        state, found = jax.lax.scan(asked, state, ask_keys)
        square, value, number = (jnp.sum(x) for x in found)
        number = jnp.maximum(number, 1.0)
        learn_keys = jax.random.split(learn_key, config.num_updates)
        state, skipped = jax.lax.scan(learn, state, learn_keys)
        metrics = DistillMetrics(
            jnp.sqrt(square / number),
            value / number,
            jnp.sum(skipped, dtype=jnp.int32),
        )
        return state, metrics

    return Distiller(init, step, networks.policy, planner, reward, networks.value_fn)


def _given(action: Array, key: Array, rewards: Any, obs: Array) -> Array:
    """The policy of imagined trials whose actions are known already."""
    del key, rewards, obs
    return action
