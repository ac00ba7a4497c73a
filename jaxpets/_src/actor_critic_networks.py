"""What an actor and its critics say of a state, as pure functions."""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array

from jaxpets._src.action_box import ActionBox
from jaxpets._src.actor_critic_records import ActorCriticParams, Goals, Guided
from jaxpets._src.checks import (
    check_array,
    check_callable,
    check_functions,
    check_record,
)
from jaxpets._src.moments import moments
from jaxpets._src.network import Head
from jaxpets._src.symlog import symexp
from jaxpets._src.types import (
    Dataset,
    ModelSpace,
    Planner,
    PlanOutput,
    PlanParams,
    RewardFn,
)

# Whitened inputs are cut off here: imagination may leave the data.
CLIP = 10.0


class Networks(NamedTuple):
    """Functions of ActorCriticParams; `seen` is `[..., F + G]`, whitened.

    Attributes:
      init: `(key, goal [R, G], Dataset) -> ActorCriticParams`, with scale 1
        and no squash.
      see: `(params, goal [..., G], obs [..., D]) -> seen`.
      propose: `(actor, seen) -> [..., A]`; its tanh is an action in half widths.
      judge: `(critics, seen, action [..., A] in half widths) -> [2, ...]`, scaled
        and squashed.
      policy: see ActorCritic.
      value_fn: see ActorCritic.
    """

    init: Callable[[Array, Array, Dataset], ActorCriticParams]
    see: Callable[[ActorCriticParams, Array, Array], Array]
    propose: Callable[[Any, Array], Array]
    judge: Callable[[Any, Array, Array], Array]
    policy: Planner
    value_fn: Callable[[Guided, Array], Array]


def layers_of(params: ActorCriticParams) -> Any:
    """Returns the layers of an actor by Flax's names; raises TypeError for another."""
    check_record("params", params, ActorCriticParams)
    try:
        layers: Any = params.actor["params"]
        _ = layers["Dense_0"]["kernel"], layers["Dense_2"]["bias"]
    except (TypeError, KeyError) as error:
        kind = type(params.actor).__name__
        raise TypeError(
            f"params.actor must be parameters of an actor, got {kind}."
        ) from error
    return layers


def build_networks(
    hidden_size: int, space: ModelSpace, goals: Goals, box: ActionBox
) -> Networks:
    """Builds the functions; see `actor_critic` for the arguments.

    Raises:
      TypeError: if space or goals are something else; ValueError, when traced, if
        goals.features does not return what the params are for.
    """
    check_record("space", space, ModelSpace)
    check_functions("goals", goals, Goals)
    actor = Head(hidden_size, box.center.shape[0])
    critic = Head(hidden_size, 1)
    propose = cast(Callable[[Any, Array], Array], actor.apply)
    apply_critic = cast(Callable[[Any, Array], Array], critic.apply)
    init_critic = cast(Callable[[Array, Array], Any], critic.init)

    def init(key: Array, goal: Array, dataset: Dataset) -> ActorCriticParams:
        actor_key, critic_key = jax.random.split(key)
        of_obs = moments(space.features(dataset.data.obs), dataset.size)
        of_goal = moments(goal, jnp.asarray(goal.shape[0]))
        mean = jnp.concatenate([of_obs[0], of_goal[0]])
        std = jnp.concatenate([of_obs[1], of_goal[1]])
        both = jnp.concatenate([mean, box.center])
        critics = jax.vmap(init_critic, (0, None))(jax.random.split(critic_key), both)
        one = jnp.ones((), jnp.float32)
        return ActorCriticParams(
            actor.init(actor_key, mean), critics, mean, std, one, jnp.zeros_like(one)
        )

    def see(params: ActorCriticParams, goal: Array, obs: Array) -> Array:
        features = space.features(obs)
        size = params.mean.shape[0] - features.shape[-1]
        if goal.shape[-1:] != (size,):
            raise ValueError(
                f"goals.features must return [{size}], as where the policy was "
                f"learned, got {list(goal.shape[-1:])}; a policy of a family of tasks "
                "needs its goals."
            )
        goal = jnp.broadcast_to(goal, (*obs.shape[:-1], size))
        seen = jnp.concatenate([features, goal], axis=-1)
        return jnp.clip((seen - params.mean) / params.std, -CLIP, CLIP)

    def judge(critics: Any, seen: Array, action: Array) -> Array:
        inputs = jnp.concatenate([seen, action], axis=-1)
        return jax.vmap(apply_critic, (0, None))(critics, inputs)[..., 0]

    def decide(data: Guided, obs: Array) -> tuple[Array, Array]:
        check_record("params.reward", data, Guided)
        params = data.networks
        check_record("params.reward.networks", params, ActorCriticParams)
        seen = see(params, goals.features(data.reward), obs)
        action = jnp.tanh(propose(params.actor, seen))
        judged = symexp(judge(params.critics, seen, action), params.squash)
        value = jnp.mean(judged, axis=0) / params.scale
        return box.center + box.half_width * action, value

    def step(
        params: PlanParams, key: Array, state: tuple[()], obs: Array
    ) -> tuple[PlanOutput, tuple[()]]:
        del key
        check_array("obs", obs, [len(space.coordinates) or "D"])
        action, value = decide(params.reward, obs)
        return PlanOutput(action, action[None], value), state

    def value_fn(data: Guided, obs: Array) -> Array:
        return decide(data, obs)[1]

    policy = Planner(lambda: (), step)
    return Networks(init, see, propose, judge, policy, value_fn)


def guided_reward(reward_fn: RewardFn) -> RewardFn:
    """Builds a reward that reads its data from Guided, as a policy beside it does.

    Args:
      reward_fn: with data of its own.

    Returns:
      The same reward, whose data are `Guided.reward`. It raises a TypeError for what is
      not Guided.

    Raises:
      TypeError: if reward_fn is no function.
    """
    check_callable("reward_fn", reward_fn)

    def reward(data: Guided, obs: Array, action: Array, next_obs: Array) -> Array:
        check_record("params.reward", data, Guided)
        return reward_fn(data.reward, obs, action, next_obs)

    return reward
