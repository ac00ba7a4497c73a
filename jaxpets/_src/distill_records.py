"""What distilling is made of: its numbers, and the records it passes."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from jaxpets._src.actor_critic_records import ActorCriticParams, Guided
from jaxpets._src.checks import check_count, check_scalar, keep_checked
from jaxpets._src.types import Dataset, Planner, PlanParams, RewardFn


@dataclasses.dataclass(frozen=True)
class DistillConfig:
    """How a planner is distilled. Numbers but sizes may be traced.

    Attributes:
      hidden_size: width of the networks' two layers.
      num_trials: imagined side by side, at least.
      horizon: steps that they are imagined for per call, every one of them planned.
      capacity: plans that are kept to learn from, at least; the oldest are replaced.
      num_updates: gradient steps per call.
      batch_size: plans per gradient step.
      planned: share of the trials in which the planner acts, of a member's trials
        rounded up; in the others the policy does, so that the planner is asked about
        the states that the policy leads to.
      noise: standard deviation of the noise on imagined actions, in half widths of the
        box; every trial draws its share of it.
      restart: chance that an imagined trial begins anew, per step.
    """

    hidden_size: int = 256
    num_trials: int = 64
    horizon: int = 50
    capacity: int = 200_000
    num_updates: int = 2000
    batch_size: int = 256
    planned: float | Array = 0.25
    noise: float | Array = 0.3
    restart: float | Array = 0.01

    def __post_init__(self) -> None:
        for name in ("hidden_size", "num_trials", "horizon", "capacity", "num_updates",
                     "batch_size"):  # fmt: skip
            keep_checked(self, name, check_count)
        keep_checked(self, "planned", check_scalar, 0.0, 1.0)
        keep_checked(self, "noise", check_scalar, 0.0)
        keep_checked(self, "restart", check_scalar, 0.0, 1.0)


class Plans(NamedTuple):
    """What the planner said, in arrays of fixed size.

    Attributes:
      seen: `[C, F + G]`, what the networks saw where it was asked.
      action: `[C, A]`, its action in half widths of the box.
      value: `[C]`, in the reward's unit.
      counts: `[C]` float32, 0 of a plan that is not to be learned from, else 1.
    """

    seen: Array
    action: Array
    value: Array
    counts: Array


class DistillState(NamedTuple):
    """What distilling goes on from.

    Attributes:
      params: the networks.
      opt_state: of them.
      obs: `[E, B, D]`, where imagined trials are.
      rewards: `[E, B, ...]`, their reward data.
      planning: `[E, B, ...]`, the planner's state in each.
      plans: to learn from.
      size: `[]` int32, how many of them there are.
      cursor: `[]` int32, where the next ones go.
    """

    params: ActorCriticParams
    opt_state: Any
    obs: Array
    rewards: Any
    planning: Any
    plans: Plans
    size: Array
    cursor: Array


class DistillMetrics(NamedTuple):
    """How far the policy is from the planner.

    Attributes:
      error: `[]`, between the actions of the two in the states of this call, before it
        learned from them: root of the mean square, in half widths of the box.
      value: `[]`, what the planner expects there, in the reward's unit.
      num_skipped: `[]` int32, gradient steps that were dropped as not finite.
    """

    error: Array
    value: Array
    num_skipped: Array


class Distiller(NamedTuple):
    """Pure functions of a policy that is learned from a planner.

    Attributes:
      init: `(PlanParams, key, dataset) -> DistillState`.
      step: `(PlanParams, key, state, dataset) -> (state, DistillMetrics)`.
      policy: a Planner that acts by the policy alone; its `PlanParams.reward` is
        Guided, its value the one learned, and the model is not read.
      planner: that is asked; if it was built from the policy, its `PlanParams.reward`
        is Guided.
      reward_fn: the reward, for `plan` with Guided data.
      value_fn: what the planner would expect, for `plan` with Guided data.
    """

    init: Callable[[PlanParams, Array, Dataset], DistillState]
    step: Callable[
        [PlanParams, Array, DistillState, Dataset],
        tuple[DistillState, DistillMetrics],
    ]
    policy: Planner
    planner: Planner
    reward_fn: RewardFn
    value_fn: Callable[[Guided, Array], Array]
