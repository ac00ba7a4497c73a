"""What an actor and a critic are made of: their numbers, and the records they pass."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

from jaxpets._src.checks import check_count, check_scalar, keep_checked
from jaxpets._src.types import Dataset, Planner, PlanParams, RewardFn


@dataclasses.dataclass(frozen=True)
class ActorCriticConfig:
    """How a task is learned in imagination. Numbers but sizes may be traced.

    Attributes:
      hidden_size: width of both networks' two layers.
      num_updates: gradient steps per call.
      batch_size: imagined rows per gradient step, at least.
      horizon: steps that they are imagined for in one gradient step.
      discount: per step, below 1; a planner that ends its horizon with this critic
        takes the same.
      trace: lambda of the returns that the critic learns: 0 trusts the critic after one
        step, 1 only at the end of the horizon.
      noise: standard deviation of the noise on imagined actions, in half widths of the
        box; every row draws its share of it.
      restart: chance that an imagined trial begins anew at a state of the data. Half of
        the rows always do; the others go on from where the last gradient step left
        them, so that what the actor leads to is learned as well as what was seen.
      target_rate: share of the critics that their slow copies take over in a step.
      pessimism: 1 learns from the lesser of two critics, 0 from their mean.
      squash: above 0 critics learn `sign(v) log(1 + squash |v|) / log(1 + squash)` of a
        value v in units of the largest that rewards of the data allow. Some tasks of a
        family earn far less than others; so their values still tell actions apart. What
        is learned is then a mean of logarithms: where returns vary, less than the mean.
    """

    hidden_size: int = 256
    num_updates: int = 1000
    batch_size: int = 256
    horizon: int = 5
    discount: float | Array = 0.99
    trace: float | Array = 0.5
    noise: float | Array = 0.5
    restart: float | Array = 0.02
    target_rate: float | Array = 0.02
    pessimism: float | Array = 0.0
    squash: float | Array = 0.0

    def __post_init__(self) -> None:
        for name in ("hidden_size", "num_updates", "batch_size", "horizon"):
            keep_checked(self, name, check_count)
        for name in ("discount", "trace", "restart", "target_rate", "pessimism"):
            keep_checked(self, name, check_scalar, 0.0, 1.0)
        for name in ("noise", "squash"):
            keep_checked(self, name, check_scalar, 0.0)
        if not isinstance(self.discount, Tracer) and self.discount == 1.0:
            raise ValueError(f"discount must be below 1, got {self.discount}.")


class Goals(NamedTuple):
    """What differs between trials of one task, and what the networks see of it.

    By default all trials have the same reward, and there is nothing to see.

    Attributes:
      draw: `(reward data, key) -> reward data` of one imagined trial.
      features: `(reward data) -> [G]`, float32.
    """

    draw: Callable[[Any, Array], Any] = lambda data, key: data
    features: Callable[[Any], Array] = lambda data: jnp.zeros((0,), jnp.float32)


class ActorCriticParams(NamedTuple):
    """What acting and valuing need.

    Attributes:
      actor: Flax parameters.
      critics: Flax parameters of two critics; every leaf starts with 2.
      mean: `[F + G]`, of the features of observations and goals.
      std: `[F + G]`.
      scale: `[]`, what a value is multiplied by before the critics see it.
      squash: `[]`, and how far it is squashed then; see ActorCriticConfig.
    """

    actor: Any
    critics: Any
    mean: Array
    std: Array
    scale: Array
    squash: Array


class Guided(NamedTuple):
    """`PlanParams.reward` of a planner that is guided by an actor and a critic.

    Attributes:
      reward: the reward's data.
      networks: ActorCriticParams.
    """

    reward: Any
    networks: ActorCriticParams


class ActorCriticState(NamedTuple):
    """What training goes on from.

    Attributes:
      params: the networks.
      targets: slow copies of the critics.
      opt_state: of actor and critics.
      obs: `[E, B, D]`, where imagined trials are.
      rewards: `[E, B, ...]`, their reward data.
      low: `[]`, the least reward so far, at most 0.
      high: `[]`, the largest, at least 0.
    """

    params: ActorCriticParams
    targets: Any
    opt_state: Any
    obs: Array
    rewards: Any
    low: Array
    high: Array


class ActorCriticMetrics(NamedTuple):
    """Means over the gradient steps of a call.

    Attributes:
      value: `[]`, what the actor is worth in imagined states, in the reward's unit.
      reward: `[]`, per imagined step.
      num_skipped: `[]` int32, gradient steps that were dropped as not finite.
    """

    value: Array
    reward: Array
    num_skipped: Array


class ActorCritic(NamedTuple):
    """Pure functions of an actor and a critic.

    Attributes:
      init: `(PlanParams, key, dataset) -> ActorCriticState`.
      step: `(PlanParams, key, state, dataset) -> (state, ActorCriticMetrics)`.
      policy: a Planner that acts by the actor alone; its `PlanParams.reward` is Guided,
        its value what the critic says, and the model is not read.
      reward_fn: the reward, for `plan` with Guided data.
      value_fn: the critic, for `plan` with Guided data.
    """

    init: Callable[[PlanParams, Array, Dataset], ActorCriticState]
    step: Callable[
        [PlanParams, Array, ActorCriticState, Dataset],
        tuple[ActorCriticState, ActorCriticMetrics],
    ]
    policy: Planner
    reward_fn: RewardFn
    value_fn: Callable[[Guided, Array], Array]
